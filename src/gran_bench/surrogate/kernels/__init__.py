"""Kernel bases of the continuous convolution, and its fast path."""
