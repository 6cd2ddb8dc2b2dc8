"""A model behind an amplifier of unknown bandwidth, which is fitted with the other parameters."""

from __future__ import annotations

from collections.abc import Callable, Mapping

import numpy as np
import xarray as xr

from mitransient_lidar import results
from mitransient_lidar.core.validation import FloatArray
from mitransient_lidar.physics.receiver.electronics import Amplifier

BANDWIDTH = "bandwidth_mhz"
BANDWIDTH_START, BANDWIDTH_BOUNDS = 100.0, (1.0, 1e4)  # [MHz]
_STEP = 0.01  # relative one of the differences that give the derivative by the bandwidth


def behind_bandwidth(model: Callable[[Mapping[str, float]], xr.Dataset]) -> Callable[[Mapping[str, float]], xr.Dataset]:
    """Return a model of `fits.WaveformFit` whose light passes a single pole with the frequency ``bandwidth_mhz``.

    The half-power frequency is in MHz. The model has the derivative by it, and another one does not call `model` again.
    """
    last: list[tuple[dict[str, float], xr.Dataset]] = []

    def behind(values: Mapping[str, float]) -> xr.Dataset:
        others = {name: value for name, value in values.items() if name != BANDWIDTH}
        if not last or last[0][0] != others:
            last[:] = [(others, model(others))]
        light, bandwidth = last[0][1], values[BANDWIDTH]
        width = results.time_axis(light).bin_width_ns
        names = [name for name in light.data_vars if str(name).startswith("waveform") and "time" in light[name].dims]
        smoothed = light.assign({name: _behind(light[name], bandwidth, width) for name in names})
        ends = [_behind(light["waveform"], factor * bandwidth, width) for factor in (1 + _STEP, 1 - _STEP)]
        slope = ((ends[0] - ends[1]) / (2 * _STEP * bandwidth)).expand_dims(parameter=[BANDWIDTH])
        # A model without other free parameters has no derivatives.
        slopes = smoothed.get("waveform_derivative")
        if slopes is not None and "parameter_units" in slopes.coords:
            slope = slope.assign_coords(parameter_units=("parameter", ["MHz"]))
        both = [slope] if slopes is None else [slopes, slope]
        joined = xr.concat(both, "parameter", coords="minimal", compat="override", join="override")
        return smoothed.drop_dims("parameter", errors="ignore").assign(waveform_derivative=joined)

    return behind


def _behind(array: xr.DataArray, bandwidth_mhz: float, width_ns: float) -> xr.DataArray:
    """Return light in bins of a width [ns], dark before the first one, as samples behind a single pole."""
    first, weights = Amplifier(1.0, bandwidth_mhz=bandwidth_mhz).low_pass(width_ns).by_bin()
    values: FloatArray = array.transpose(..., "time").values
    from scipy.signal import oaconvolve

    shape = (1,) * (values.ndim - 1) + (-1,)
    smoothed = oaconvolve(values, weights.reshape(shape), axes=-1)[..., -first:][..., : values.shape[-1]]
    return array.transpose(..., "time").copy(data=np.asarray(smoothed))
