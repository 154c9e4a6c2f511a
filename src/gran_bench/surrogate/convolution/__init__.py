"""Continuous convolutions: the article's network and its radial relative."""
