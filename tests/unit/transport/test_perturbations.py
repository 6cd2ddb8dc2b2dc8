"""Sums of perturbations along segments, at scattering events and at solids, and their channels in histograms."""

import mitsuba as mi
import numpy as np
import pytest

from mitransient_lidar.core.constants import C0
from mitransient_lidar.physics.lidar.time_axis import TimeAxis
from mitransient_lidar.physics.water.layers import WaterColumn
from mitransient_lidar.physics.water.phase_table import DEFAULT_COUNT, DEFAULT_LOG_S0
from mitransient_lidar.transport.paths.histogram import TransientHistogram
from mitransient_lidar.transport.perturbations import LayerChange, Perturbation, Perturbations, joined

TOPS = (0.0, 1.5, 4.0)
EDGES = (-np.inf, 1.5, 4.0, np.inf)


def lengths(depth, downward, length):
    """Return the lengths of segments in three layers, from perturbations of one per metre."""
    layers = [LayerChange(*EDGES[number : number + 2], per_metre=1.0) for number in range(3)]
    changes = Perturbations([Perturbation((layer,)) for layer in layers])
    values = (mi.Float(np.asarray(value, np.float32)) for value in (depth, downward, length))
    return np.array(changes.along(changes.start(), *values))


def test_lengths_in_layers_add_up():
    """Random segments, in all directions and level ones: parts of `WaterColumn`, and their sum, the length."""
    rng = np.random.default_rng(1)
    depth, downward, length = rng.uniform(-0.5, 6, 4000), rng.uniform(-1, 1, 4000), rng.uniform(0, 8, 4000)
    downward[:500] = 0.0
    depth[:3], downward[-3:] = TOPS, (1.0, -1.0, 1e-7)
    found = lengths(depth, downward, length)
    np.testing.assert_allclose(found.sum(axis=0), length, rtol=1e-6)
    for number in range(3):
        alone = np.eye(3)[number]
        column = WaterColumn(np.array(TOPS), alone, np.zeros(3), np.zeros(3))
        wanted = column.optical_depth(depth, depth + downward * length, length)
        clear = np.abs(downward) > 1e-3
        np.testing.assert_allclose(found[number][clear], wanted[clear], atol=2e-4)


def test_events_count_where_their_layer_is():
    """A table of ln s is looked up linearly; a share of the event counts where bubbles scatter, too."""
    nodes = DEFAULT_LOG_S0 * np.linspace(1, 0, DEFAULT_COUNT)
    changes = Perturbations([Perturbation((LayerChange(1.5, 4.0, per_event=2.0, by_angle=nodes),))])
    angle = np.array([1e-4, 0.03, 1.0, np.pi, 1.0, 1.0])
    depth = np.array([2.0, 2.0, 2.0, 2.0, 1.0, 4.0])
    after = mi.Vector3f(np.sin(angle).astype(np.float32), 0, np.cos(angle).astype(np.float32))
    found = changes.at_event(changes.start(), mi.Float(depth), mi.Vector3f(0, 0, 1), after)
    wanted = np.where(depth == 2.0, 2 + 2 * np.log(np.sin(angle / 2)), 0)
    np.testing.assert_allclose(found[0], wanted, rtol=1e-3, atol=1e-6)
    half = changes.at_event(changes.start(), mi.Float(depth), mi.Vector3f(0, 0, 1), after, share=mi.Float(0.5))
    np.testing.assert_allclose(half[0], 0.5 * wanted, rtol=1e-3, atol=1e-6)


def test_channels_are_derivatives():
    changes = Perturbations([Perturbation(), Perturbation()])
    sums = joined([mi.Float(-1.5), mi.Float(0.5)], [mi.Float(0.5), mi.Float(1.5)])
    np.testing.assert_allclose([one[0] for one in changes.channels(mi.Float(3.0), sums)], [-3.0, 6.0], rtol=1e-6)


def test_histograms_sum_perturbations_of_both_signs():
    """Derivatives of large and small energies, and of both signs, beside the energies."""
    axis, emitted = TimeAxis(0.0, 2e9 / C0, 4), 1.0
    changes = Perturbations([Perturbation(), Perturbation()])
    sums = TransientHistogram(axis, (2,), emitted, perturbations=changes)
    energy = np.float32([1e-3, 2e-3, 1e-17, 1e-3])
    slope = np.float32([-4.0, 1.0, -7.0, 2.0])
    place = mi.Float(1, 1, 3, 5)
    sums.add(mi.UInt32(1), place, mi.Float(energy), mi.Bool(True), [mi.Float(slope), mi.Float(-slope)])
    np.testing.assert_allclose(sums.energy()[1], [3e-3, 1e-17, 1e-3, 0], rtol=1e-5)
    found = sums.perturbed()
    assert found.shape == (2, 2, 4)
    np.testing.assert_allclose(found[0, 1], [-2e-3, -7e-17, 2e-3, 0], rtol=1e-5)
    np.testing.assert_array_equal(found[1], -found[0])
    assert not found[:, 0].any()


def test_a_derivative_that_is_not_finite_is_reported():
    changes = Perturbations([Perturbation()])
    sums = TransientHistogram(TimeAxis(0.0, 2e9 / C0, 2), (1,), 1.0, perturbations=changes)
    sums.add(mi.UInt32(0), mi.Float(1.0), mi.Float(1e-3), mi.Bool(True), [mi.Float(np.inf)])
    assert np.isnan(sums.perturbed()[0, 0, 0])
    assert sums.energy()[0, 0] == pytest.approx(1e-3)
