"""Maps: grids of heights, and coordinate systems."""
