"""One experiment: who it is, its stages, what it leaves."""
