"""Detectors and electronics."""
