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


class BehindBandwidth:
    """Model of `fits.WaveformFit` whose light passes a single pole with the half-power frequency ``bandwidth_mhz``.

    Another bandwidth does not call the model again.
    """

    def __init__(self, model: Callable[[Mapping[str, float]], xr.Dataset]) -> None:
        self.model = model
        self._last: tuple[dict[str, float], xr.Dataset] | None = None

    def __call__(self, values: Mapping[str, float]) -> xr.Dataset:
        """Return the model behind the bandwidth [MHz] of values, with the derivative by it."""
        others = {name: value for name, value in values.items() if name != BANDWIDTH}
        if self._last is None or self._last[0] != others:
            self._last = others, self.model(others)
        light, bandwidth = self._last[1], values[BANDWIDTH]
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


def _behind(array: xr.DataArray, bandwidth_mhz: float, width_ns: float) -> xr.DataArray:
    """Return light in bins of a width [ns], dark before the first one, as samples behind a single pole."""
    first, weights = Amplifier(1.0, bandwidth_mhz=bandwidth_mhz).low_pass(width_ns).by_bin()
    values: FloatArray = array.transpose(..., "time").values
    from scipy.signal import oaconvolve

    shape = (1,) * (values.ndim - 1) + (-1,)
    smoothed = oaconvolve(values, weights.reshape(shape), axes=-1)[..., -first:][..., : values.shape[-1]]
    return array.transpose(..., "time").copy(data=np.asarray(smoothed))
