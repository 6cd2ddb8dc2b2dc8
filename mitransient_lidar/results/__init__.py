"""Result datasets, and their files."""

from mitransient_lidar.results.attributes import provenance
from mitransient_lidar.results.dataset import (
    add_batches,
    add_components,
    add_derivatives,
    build,
    build_series,
    pixel_coordinates,
    record_dims,
    time_axis,
)
from mitransient_lidar.results.files import Given, dataset_of, open, save

__all__ = [
    "Given",
    "add_batches",
    "add_components",
    "add_derivatives",
    "build",
    "build_series",
    "dataset_of",
    "open",
    "pixel_coordinates",
    "provenance",
    "record_dims",
    "save",
    "time_axis",
]
