"""Drawings of the figures of `studies.publication`."""
