"""Derivatives by central differences against closed forms, and against renders on other random numbers."""

import itertools

import numpy as np
import pytest
import significance

from mitransient_lidar.core.constants import C0
from mitransient_lidar.rendering.differences import Differences
from mitransient_lidar.rendering.passes import pass_seed
from mitransient_lidar.rendering.session import choose_integrator, open_scene

pytestmark = pytest.mark.slow

LEVEL = {"spectrum": "flat", "surface_size": 1000, "layout": "1x1"}
SMALL = {"type": "lidar_merging", "paths_per_pass": 2**13, "photons_per_pass": 2**13}
PASSES = 16
#: Seeds of renders to compare with, other than those of the derivatives.
OTHERS = 1000


def slopes(name, params, steps=None):
    """Return derivatives of the energy [J per unit], a row for each pass, and the session."""
    session = open_scene("table1", {**LEVEL, **params})
    found = Differences(session, choose_integrator(session.scene, SMALL), [name], steps=steps)
    sums = [np.zeros(())]
    for number in range(PASSES):
        found.add_pass(pass_seed(0, number))
        sums.append(found.passes * found.impulse_response[0])
    return np.array([after - before for before, after in itertools.pairwise(sums)]).sum(axis=1), session


def energies(session, seed=OTHERS):
    """Return energies [J], a row for each pass, with the time bins of a session."""
    renderer = choose_integrator(session.scene, SMALL).prepare(session.scene, session.sensor)
    passes = (renderer.render_pass(pass_seed(seed, number)) for number in range(PASSES))
    return np.array([one.histogram.energy().sum(axis=0) for one in passes])


def in_bins(samples, bins=8):
    """Return sums over neighbouring bins, as many as there are whole ones."""
    count = samples.shape[1] // bins
    return samples[:, : count * bins].reshape(len(samples), count, bins).sum(axis=2)


@pytest.mark.long
def test_bottom_reflectance_against_the_scene_without_its_light():
    """Light that meets a dark bottom is in proportion to its reflectance."""
    dark = 0.02
    found, session = slopes("bottom_reflectance", {"bottom_reflectance": dark})
    bare = open_scene("table1", {**LEVEL, "bottom_reflectance": 0})
    bare.share_record(session.sensor.film().axis)
    wanted = (energies(session) - energies(bare, OTHERS + 1)) / dark
    echo = slice(*np.flatnonzero(found.mean(axis=0) > 0.01 * found.mean(axis=0).max())[[0, -1]])
    significance.assert_same(in_bins(found[:, echo]), in_bins(wanted[:, echo]), error=0.02, bias=0.002)


@pytest.mark.long
def test_attenuation_of_water_that_only_absorbs():
    """Light that reaches the bottom at nadir and returns loses exp(-2 c d); all ways are longer by at most 0.1 %."""
    depth, view = 8.0, {"off_nadir_deg": 0, "field_of_view_mrad": 30, "slope_variance": 2e-5}
    water = {"scattering": 0, "backscattering": 0, "bottom_depth": depth}
    found, session = slopes("attenuation", {**water, **view})
    surface = 2 * 200.0 / (C0 * 1e-9)
    bottom = session.sensor.film().axis.centres_ns > surface + depth * 2 / (C0 * 1e-9)
    wanted = -2 * depth * energies(session)[:, bottom].sum(axis=1)
    significance.assert_same(-found[:, bottom].sum(axis=1)[:, None], -wanted[:, None], error=0.02, bias=0.002)
    # No echo of the surface depends on the water.
    assert not found[:, ~bottom].any()


def test_bottom_depth_moves_its_echo_in_time():
    """The mean time of the echo grows by 2 n / (c cos(angle in water)); the sum over all ways changes it by 0.5 %."""
    water = {"scattering": 0, "backscattering": 0}
    found, session = slopes("bottom_depth", water)
    axis = session.sensor.film().axis
    record = energies(session)
    bottom = axis.centres_ns > 2 * 200.0 / np.cos(np.deg2rad(20)) / (C0 * 1e-9) + 30.0
    energy, times = record[:, bottom].mean(axis=0), axis.centres_ns[bottom]
    mean = energy @ times / energy.sum()
    moved = found[:, bottom] @ (times - mean) / energy.sum()
    cosine = np.sqrt(1 - (np.sin(np.deg2rad(20)) / 1.34) ** 2)
    significance.assert_equal(moved[:, None], [2 * 1.364 / (C0 * 1e-9) / cosine], error=0.02, bias=0.01)
