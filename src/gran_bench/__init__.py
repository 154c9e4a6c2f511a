"""gran-bench: which method gives the granular-flow answer you can trust in the least time?"""

__version__ = "0.1.0"
