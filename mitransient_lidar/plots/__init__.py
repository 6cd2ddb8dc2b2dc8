"""Figures, animations, and the page that shows gates in a browser.

A function that draws a figure returns a `matplotlib.figure.Figure` that is independent of pyplot and needs no closing.
With a `path` it also writes a PNG, PDF or SVG file. File names with another suffix, and files that cannot be written,
raise `UserError`.
"""
