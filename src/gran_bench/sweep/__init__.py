"""What a sweep keeps and says: a small file a run, a table of its choices, a figure of each axis, what failed."""
