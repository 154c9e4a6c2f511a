"""The DEM held against theory, published experiments and itself."""
