"""gran-bench: which method gives the granular-flow answer you can trust in the least time?"""

from gran_bench import cache_folders as cache_folders

__version__ = "0.1.0"
