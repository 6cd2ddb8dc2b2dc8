"""Attenuation of the column signal of a result, as `fov_sweep` fits it to each of its passes."""

import numpy as np

from mitransient_lidar import results
from mitransient_lidar.analysis.retrieval.column_retrieval import BEAM_EDGE, ColumnBins
from mitransient_lidar.results.geometry import lidar_geometry


def effective_attenuation(dataset, min_depth, max_depth):
    """Return K and its standard error [1/m] between two depths on the axis [m], of the sum of the pixels."""
    edge = 0.5e-3 * min(BEAM_EDGE * dataset.attrs["divergence_mrad"], dataset.attrs["field_of_view_mrad"])
    geometry = lidar_geometry(dataset.attrs, surface="level")
    column = ColumnBins.between(geometry, edge, results.time_axis(dataset), min_depth, max_depth)
    bins = dataset.sizes["time"]
    energy = dataset["impulse_response"].values.reshape(-1, bins).sum(axis=0)[column.inside]
    stderr = np.linalg.norm(dataset["impulse_response_stderr"].values.reshape(-1, bins), axis=0)[column.inside]
    weights, error = column.weights(energy, stderr)
    return float(weights @ np.log(energy / column.gain)), error
