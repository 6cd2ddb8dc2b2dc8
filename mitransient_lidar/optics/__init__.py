"""Physics of depth-sounding lidar in NumPy: water, phase functions, sea surface, refraction, pulses, lidar equation."""
