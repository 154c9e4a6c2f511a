"""Compiled layers of the convolutions."""
