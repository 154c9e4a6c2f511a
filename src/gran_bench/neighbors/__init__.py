"""Who is close to whom: a KD-tree to be read and trusted, a cell list for speed, with the same answer."""

from gran_bench.neighbors.cells import bin_cells, cell_neighbors, cell_pairs, list_pairs
from gran_bench.neighbors.tree import IndexArray, check_period, nearest_image, tree_neighbors, tree_pairs

__all__ = [
    "IndexArray",
    "bin_cells",
    "cell_neighbors",
    "cell_pairs",
    "check_period",
    "list_pairs",
    "nearest_image",
    "tree_neighbors",
    "tree_pairs",
]
