"""Learned surrogates that step particles a frame at a time."""
