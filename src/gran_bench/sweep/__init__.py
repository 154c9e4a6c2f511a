"""What a sweep keeps and says: a table of its runs and of its choices, a figure of each axis, what failed."""
