"""Waveforms [W] of the lidar equation for shots of four pixels over a level sea, and results that hold them."""

import math

import numpy as np
import xarray as xr
from scipy.stats import exponnorm, norm

from mitransient_lidar import results
from mitransient_lidar.physics.lidar.pulse import FWHM_PER_SIGMA
from mitransient_lidar.physics.lidar.time_axis import TimeAxis

C0 = 0.299792458  # m/ns
N = 1.34
THETA = math.radians(20)
COS_WATER = math.sqrt(1 - (math.sin(THETA) / N) ** 2)
DT, START, BINS = 0.5, 1385.0, 400
EDGES = START + DT * np.arange(BINS + 1)
TIME = EDGES[:-1] + 0.5 * DT
SIGMA = 4.0 / FWHM_PER_SIGMA
SURFACE = 2 * 200 / math.cos(THETA) / C0
ANGLE_X = np.array([3.0, 3.0, -3.0, -3.0])
ANGLE_Y = np.array([-3.0, 3.0, -3.0, 3.0])
ENERGY = 5e-3 * 0.81 * 0.9 * 0.025  # pulse, optics, air, aperture [J m^2]
A, BB, RHO, DEPTH = 0.12, 0.008, 0.25, 8.0
ATTRIBUTES = {"altitude": 200.0, "off_nadir_deg": 20.0, "refractive_index": N, "group_index": N, "pulse_fwhm_ns": 4.0}
ATTRIBUTES |= {"pulse_energy_mj": 5.0, "aperture_area": 0.025, "field_of_view_mrad": 60.0, "divergence_mrad": 0.1}
ATTRIBUTES |= {"surface_time_ns": SURFACE, "surface_heights_m": [0.0, 0.0], "two_way_efficiency": 0.9**3}


def normal_transmittance():
    s = (math.cos(THETA) - N * COS_WATER) / (math.cos(THETA) + N * COS_WATER)
    p = (N * math.cos(THETA) - COS_WATER) / (N * math.cos(THETA) + COS_WATER)
    return 1 - 0.5 * (s**2 + p**2)


def solid_angle(path):
    """Per area of the aperture, from a path below a level sea."""
    reach = 200 / math.cos(THETA)
    ratio = COS_WATER / math.cos(THETA)
    return 1 / ((N * reach + path) * (N * reach * ratio + path / ratio))


def waveform(delay=0.0, share=0.25, glint=2e-13, factor=1.0, k=A + BB, depth=DEPTH):
    """A pixel's share of the power [W] over a level sea; a sea surface factor on all that has crossed it."""
    rate = C0 / N * k  # 1/ns
    path = depth / COS_WATER
    surface, bottom = SURFACE + delay, SURFACE + delay + 2 * N * path / C0
    through = factor * share * ENERGY * normal_transmittance() ** 2
    # 1.13 is the multiple scattering of the fixture `scattered_once`.
    level = through * solid_angle(0.0) * 1.13 * BB / (2 * np.pi) * C0 * 1e9 / (2 * N)
    echo = through * solid_angle(path) * RHO / np.pi * COS_WATER * math.exp(-2 * k * path)

    def onset(at):
        return level / rate * exponnorm.pdf(TIME, 1 / (rate * SIGMA), loc=at, scale=SIGMA)

    def pulse(at, energy):
        return energy / (DT * 1e-9) * np.diff(norm.cdf(EDGES, at, SIGMA))

    spreading = solid_angle(np.clip((TIME - surface) * C0 / (2 * N), 0, path)) / solid_angle(0.0)
    column = (onset(surface) - math.exp(-rate * (bottom - surface)) * onset(bottom)) * spreading
    return pulse(surface, share * glint) + column + pulse(bottom, echo)


def plane_delays(along, across):
    """Two-way delays [ns] of the pixels over a plane through the origin, from rays as vectors."""
    ray = np.array([math.sin(THETA), 0, -math.cos(THETA)]) + 1e-3 * (
        np.outer(ANGLE_X, [math.cos(THETA), 0, math.sin(THETA)]) + np.outer(ANGLE_Y, [0, 1, 0])
    )
    ray /= np.linalg.norm(ray, axis=1, keepdims=True)
    normal = np.array([-along, -across, 1])
    return -2 / C0 * (np.array([-200 * math.tan(THETA), 0, 200]) @ normal) / (ray @ normal) - SURFACE


def result(values=None, **attributes):
    values = np.stack([waveform(delay) for delay in plane_delays(0.0, 0.0)]) if values is None else values
    return results.build(
        values * DT * 1e-9,
        1e-4 * values * DT * 1e-9,
        values,
        1e-4 * values + 1e-9,
        time=TimeAxis(START, DT, BINS),
        pixel_names=["red", "green", "blue", "black"][: len(values)],
        pixel_centres_mrad=np.stack([ANGLE_X, ANGLE_Y], axis=1)[: len(values)],
        attributes={**ATTRIBUTES, **attributes},
    )


def on_axis(**changes):
    """Four pixels that all see the axis: what a bottom and a column are without the spread of arrivals."""
    return result(np.stack([waveform(**changes)] * 4))


LEVEL = xr.Dataset({"slope_along": 0.0, "slope_across": 0.0, "surface_range": 200 / math.cos(THETA)})
