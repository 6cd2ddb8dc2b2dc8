"""Datasets of results, and their files."""

from mitransient_lidar.results.dataset import (
    add_batches,
    add_components,
    add_derivatives,
    build,
    build_series,
    open,
    pixel_coordinates,
    provenance,
    record_dims,
    save,
    time_axis,
)

__all__ = [
    "add_batches",
    "add_components",
    "add_derivatives",
    "build",
    "build_series",
    "open",
    "pixel_coordinates",
    "provenance",
    "record_dims",
    "save",
    "time_axis",
]
