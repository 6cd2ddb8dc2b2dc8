"""A waveform in closed form with exact derivatives, in place of a render: an exponential column and a bottom pulse."""

import numpy as np
import xarray as xr

#: Parameters that the waveforms of tests were made with.
TRUTH = {"attenuation": 0.2, "scattering": 0.15, "bottom_reflectance": 0.1}
TIME = np.arange(0.0, 160.0)
BIN = {"time_start_ns": -0.5, "bin_width_ns": 1.0}
METRES_PER_NS, SURFACE_NS, DEPTH = 0.11, 30.0, 8.0
#: Centres of smooth edges and of the bottom pulse, their widths, and factors of column and bottom [W].
RISE_NS, WIDTH_NS, COLUMN, BOTTOM = 1.5, 2.1, 2.0, 40.0


def closed_form(values, time=TIME, pixels=("single",), factors=None, power=1.0):
    """Return a dataset with waveform and derivatives by the parameters of `TRUTH`; pixels differ by a factor."""
    c, b, rho = (values.get(name, TRUTH[name]) for name in TRUTH)
    z = np.maximum(time - SURFACE_NS, 0) * METRES_PER_NS
    end = SURFACE_NS + DEPTH / METRES_PER_NS
    edges = 1 / (1 + np.exp(-(time - SURFACE_NS) / RISE_NS)) / (1 + np.exp((time - end) / RISE_NS))
    column = COLUMN * b * np.exp(-2 * c * z) * edges
    bottom = BOTTOM * rho * np.exp(-2 * c * DEPTH - 0.5 * ((time - end) / WIDTH_NS) ** 2)
    slopes = np.array([-2 * z * column - 2 * DEPTH * bottom, column / b, bottom / rho])
    shares = power * np.linspace(1, 0.5, len(pixels))[:, None] if factors is None else np.asarray(factors)[:, None]
    data = {
        "waveform": (("pixel", "time"), shares * (column + bottom), {"units": "W"}),
        "waveform_derivative": (("parameter", "pixel", "time"), shares * slopes[:, None]),
    }
    coords = {"pixel": list(pixels), "time": time, "parameter": list(TRUTH)}
    coords["parameter_units"] = ("parameter", ["1/m", "1/m", "1"])
    return xr.Dataset(data, coords, {**BIN, "time_start_ns": time[0] - 0.5})


def noisy(deviation, random, time=TIME, **options):
    """Return a result with the true waveform, independent normal errors of one standard deviation, and this error."""
    true = closed_form(TRUTH, time, **options)["waveform"]
    data = {"waveform": true + random.normal(0, deviation, true.shape)}
    data["waveform_stderr"] = xr.full_like(true, deviation)
    return xr.Dataset(data, attrs={**BIN, "time_start_ns": time[0] - 0.5})
