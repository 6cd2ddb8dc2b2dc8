"""Waveforms [W] of a lake at nadir: surface, column, target and bottom, as results and as records of a receiver."""

import numpy as np
import xarray as xr
from scipy.stats import exponnorm, norm

from mitransient_lidar import results
from mitransient_lidar.physics.lidar.pulse import FWHM_PER_SIGMA
from mitransient_lidar.physics.lidar.time_axis import TimeAxis
from mitransient_lidar.results.geometry import LinesOfSight

DT, BINS, START = 0.5, 320, 1380.0
TIME = START + (np.arange(BINS) + 0.5) * DT
EDGES = START + np.arange(BINS + 1) * DT
SIGMA = 5.0 / FWHM_PER_SIGMA
DECAY = 0.035  # of the column [1/ns]
# At nadir from 200 m with n = n_g = 1.34: no spread over the footprint, and 0.1119 m of water a nanosecond.
SURFACE = 2e9 * 212.84 / 299792458
PER_NS = 0.299792458 / (2 * 1.34)
ATTRIBUTES = {"altitude": 212.84, "off_nadir_deg": 0.0, "refractive_index": 1.34, "group_index": 1.34}
ATTRIBUTES |= {"pulse_fwhm_ns": 5.0, "response_time_ns": 0.0, "surface_time_ns": SURFACE, "layout": "2x2"}
#: Times of the surface in the pixels of `result` [ns], against the mean.
SHIFTS = np.array([2.3, 2.1, -1.8, -2.2])


def echo(arrival, energy):
    """Mean power [W] in each bin of an ideal echo of an energy [J]."""
    return energy / (DT * 1e-9) * np.diff(norm.cdf(EDGES, arrival, SIGMA))


def column(start, end, level):
    def onset(at):
        return level / DECAY * exponnorm.pdf(TIME, 1 / (DECAY * SIGMA), loc=at, scale=SIGMA)

    return onset(start) - np.exp(-DECAY * (end - start)) * onset(end)


def waveform(surface=SURFACE, bottom=70.0, target=0.0):
    found = echo(surface, 2e-13) + column(surface, surface + bottom, 3e-5) + echo(surface + bottom, 6e-13)
    return found + (echo(surface + 40, target) if target else 0)


def result(values=None, grid=None, **attributes):
    values = np.stack([waveform(SURFACE + shift) for shift in SHIFTS]) if values is None else values
    count = len(values)
    return results.build(
        values * DT * 1e-9,
        0 * values,
        values,
        0 * values,
        time=TimeAxis(START, DT, BINS),
        pixel_names=["red", "green", "blue", "black"][:count],
        pixel_centres_mrad=np.arange(2.0 * count).reshape(count, 2),
        grid=grid,
        attributes={**ATTRIBUTES, **attributes},
    )


def recorded(clean, shots, noise, seed=1, offset=0.3):
    """Shots of a receiver that turns 1 W into 1e5 V, with an offset."""
    rng = np.random.default_rng(seed)
    signal = offset + 1e5 * clean + noise * rng.normal(size=(shots, *clean.shape))
    base = result(clean)
    return xr.Dataset(
        {"signal": (("shot", "pixel", "time"), signal, {"units": "V"})},
        {**{name: base.coords[name] for name in ("pixel", "angle_x", "angle_y", "time")}, "shot": np.arange(shots)},
        base.attrs,
    )


def lit(dataset, shares):
    """Return a result of pixels that look straight down, with shares of the beam."""
    zeros = np.zeros(len(shares))
    values = (zeros, zeros, zeros, zeros + SURFACE, zeros + 0.1, zeros + PER_NS, np.array(shares))
    return dataset.assign_coords(LinesOfSight(*values).coordinates(("pixel",), (len(shares),)))


def in_series(*shots):
    """Return results as a series with a truth of each shot."""
    joined = xr.concat(shots, "shot", combine_attrs="override").assign_coords(shot=np.arange(len(shots)))
    return joined.assign_coords(true_bottom_depth=("shot", 5.0 + np.arange(len(shots))))
