"""Photon transfer curve: variance against mean of frames, from which the gain and the read-out noise follow.

J. R. Janesick, Photon Transfer (SPIE, 2007), doi:10.1117/3.725073.
"""

from __future__ import annotations

from typing import NamedTuple

import numpy as np
import xarray as xr

from mitransient_lidar.core.errors import UserError
from mitransient_lidar.core.validation import FloatArray, integer

_SATURATION = 1e-6  # largest probability of a saturated frame


class PhotonTransfer(NamedTuple):
    """Frame variance against frame mean at light levels, and the line through them."""

    mean: FloatArray  #: Mean of the pixels at each level, less their levels without light [DN], shape (level,).
    variance: FloatArray  #: Mean variance over the frames [DN^2], shape (level,).
    variance_stderr: FloatArray  #: Its standard error from the spread of the pixels [DN^2], shape (level,).
    electrons_per_dn: float  #: Inverse slope: electrons per DN, with a gain over the gain times the excess noise.
    electrons_per_dn_stderr: float  #: Its standard error.
    dark_deviation: float  #: Root of the variance without light [DN]: read-out, rounding and dark events.
    dark_deviation_stderr: float  #: Its standard error [DN].


def photon_transfer(recorded: xr.Dataset, levels: int = 20) -> PhotonTransfer:
    """Return the photon transfer of frames from `analysis.receiver.detect_waveforms`, without saturated pixels.

    Pixels are sorted into levels by their mean in the first half of the frames; means and variances come from the
    second half, as sorting would bias the first. The relation is a line where each pixel has its own light: with an
    intensifier, for light that changes little over its blur; in a photon counter, for few counts.

    Frames have ``signal``, ``saturation`` and ``dark_level``; there are 2 to 1000 levels, each with as many pixels and
    gates. Raises `UserError` for fewer than 4 frames, or 2 pixels and gates a level that are not saturated.
    """
    number, frames = integer("levels", levels, 2, 1000), recorded.sizes.get("frame", 0)
    if frames < 4:
        raise UserError(f"the dataset has {frames} frames, but photon transfer needs at least 4")
    # Those that may saturate would lose their highest frames.
    saturates = recorded["saturation"].max([dim for dim in recorded["saturation"].dims if dim == "frame"])
    used = (saturates < _SATURATION).values
    light = (recorded["signal"].astype(np.float64) - recorded["dark_level"]).transpose("frame", *saturates.dims)
    if (count := int(used.sum())) < 2 * number:
        raise UserError(f"levels = {number} needs {2 * number} pixels and gates that do not saturate, not {count}")
    first, second = np.split(light.values[:, used], [frames // 2])
    order = np.array_split(np.argsort(first.mean(axis=0)), number)
    mean, variance = second.mean(axis=0), second.var(axis=0, ddof=1)
    level, spread, error, size = np.array(
        [(mean[one].mean(), variance[one].mean(), variance[one].std(ddof=1) / one.size**0.5, one.size) for one in order]
    ).T
    # An error of the mean moves a level along the line.
    slope = (spread[-1] - spread[0]) / max(level[-1] - level[0], 1e-9)
    weights = 1 / np.maximum(np.hypot(error, slope * np.sqrt(spread / (len(second) * size))), 1e-9)
    line, covariance = np.polyfit(level, spread, 1, w=weights, cov="unscaled")
    slope_error, dark_error = np.sqrt(np.diag(covariance))
    dark = float(np.sqrt(max(line[1], 0)))
    inverse, its_error = 1 / float(line[0]), float(slope_error / line[0] ** 2)
    return PhotonTransfer(
        level, spread, error, inverse, its_error, dark, float(dark_error) / (2 * dark) if dark else np.inf
    )
