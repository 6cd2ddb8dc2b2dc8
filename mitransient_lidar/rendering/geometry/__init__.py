"""Shapes, beam and pixels of a loaded scene as arrays in its three dimensions."""
