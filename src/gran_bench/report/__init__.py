"""The tables of `results/README.md`, and all pages renewed from their records."""
