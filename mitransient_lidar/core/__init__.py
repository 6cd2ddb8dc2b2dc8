"""Validation, errors, constants and files, for every layer."""
