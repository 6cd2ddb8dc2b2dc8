"""Daylight: sun and sky, field-of-view sampling, and each pixel's radiance."""
