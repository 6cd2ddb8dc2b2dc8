"""Daylight: sun and sky, the radiance that each pixel sees, and how it is sampled."""
