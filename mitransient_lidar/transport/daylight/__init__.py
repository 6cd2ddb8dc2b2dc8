"""Daylight: sun and sky, sampling of the field of view, and the radiance of each pixel."""
