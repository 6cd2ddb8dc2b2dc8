"""Merging of light from the laser with paths from the receiver."""
