"""Maps: height grids, and coordinate systems."""
