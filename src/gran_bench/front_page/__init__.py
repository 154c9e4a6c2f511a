"""The front page of the results: how accurate, how fast, what failed, when not to use a surrogate."""
