"""Physics of depth-sounding lidar in NumPy."""
