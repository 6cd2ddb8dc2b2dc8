"""Figures of studies, one module for each."""
