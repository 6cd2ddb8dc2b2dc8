"""Validation, errors and constants that every layer uses."""
