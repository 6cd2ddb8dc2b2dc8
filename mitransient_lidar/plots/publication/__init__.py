"""Drawings for the figures in `studies.publication`."""
