"""Pulse, gates, time bins, refraction, daylight, beam spread and the lidar equation."""
