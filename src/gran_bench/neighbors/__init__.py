"""Who is close to whom: a KD-tree to be read and trusted, a cell list for speed, with the same answer."""

from gran_bench.neighbors.cells import bin_cells, cell_neighbors, list_pairs
from gran_bench.neighbors.tree import IndexArray, check_period, nearest_image, tree_pairs
