"""The contact network: a learned solver of contacts."""
