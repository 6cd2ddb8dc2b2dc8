"""Histograms of energies and of their derivatives."""

import drjit as dr
import mitsuba as mi
import numpy as np
import pytest

from mitransient_lidar.core.constants import C0
from mitransient_lidar.core.errors import UserError
from mitransient_lidar.physics.lidar.gate_train import GateTrain
from mitransient_lidar.physics.lidar.pulse import Pulse
from mitransient_lidar.physics.lidar.time_axis import TimeAxis
from mitransient_lidar.physics.water.layers import WaterColumn
from mitransient_lidar.physics.water.phase_table import DEFAULT_COUNT, DEFAULT_LOG_S0
from mitransient_lidar.transport.paths.histogram import GateWeights, TransientHistogram
from mitransient_lidar.transport.perturbations import LayerChange, Perturbation, Perturbations, joined

#: Path length of light that arrives in the first bin [m].
FIRST = mi.Float(1390.1e-9 * C0)


def histogram(bins, shape=(1,), emitted=2.0**26):
    return TransientHistogram(TimeAxis(1390.0, 0.5, bins), shape, emitted)


def test_bins_are_half_open():
    """Bins of 2 m of path from 0, so that edges are exact: an edge belongs to the later bin."""
    axis = TimeAxis(0.0, 2e9 / C0, 4)
    sums = TransientHistogram(axis, (2,), 2.0**26)
    below = np.nextafter(np.float32([2, 8]), np.float32(0))
    lengths = mi.Float([0, 2, 4, below[0], below[1], 8, -1e-3, np.nan, np.inf])
    energies = mi.Float([1, 10, 100, 1000, 1e4, 1e5, 1e5, 1e5, 1e5])
    sums.add(mi.UInt32(1), lengths, energies, mi.Bool(True))
    np.testing.assert_array_equal(sums.energy(), [[0, 0, 0, 0], [1001, 10, 100, 1e4]])
    assert axis.path_end == pytest.approx(8)
    sums.clear()
    assert not sums.energy().any()


@pytest.mark.parametrize("width_ns", [1e-9, 1e-3, 1.0])
def test_weight_of_a_gate_of_any_width(width_ns):
    """A gate that is short against the pulse collects its width times the peak power, 0.939 / FWHM."""
    train, pulse = GateTrain(1400.0, width_ns, 10.0, 2), Pulse.gaussian(5.0)
    gates = GateWeights(train, train.response_weights(pulse))
    sums = TransientHistogram(TimeAxis(1390.0, 0.5, 40), (1,), 1.0, gates)
    sums.add(mi.UInt32(0), mi.Float((1400.0 + 0.5 * width_ns) * 1e-9 * C0), mi.Float(1.0), mi.Bool(True))
    peak = np.diff(pulse.cumulative([-0.5 * width_ns, 0.5 * width_ns]))[0] if width_ns > 1e-6 else width_ns * 0.187874
    assert sums.energy()[0, 0] == pytest.approx(peak, rel=1e-3)


def test_inactive_paths_leave_no_trace():
    sums = histogram(3)
    sums.add(mi.UInt32(0), FIRST, mi.Float(1.0, 2.0), mi.Bool(False, True))
    np.testing.assert_array_equal(sums.energy(), [[2, 0, 0]])


def test_sums_are_exact():
    """2^25 ones: a float32 sum stops at 2^24."""
    sums, count = histogram(2), 2**25
    sums.add(mi.UInt32(0), FIRST, dr.ones(mi.Float, count), mi.Bool(True))
    assert sums.energy()[0, 0] == count


def test_sums_do_not_depend_on_their_order():
    """A million energies over 14 decades, in two orders: equal bits, and accurate to single precision."""
    energies = np.float32(10.0 ** np.random.default_rng(3).uniform(-14, 0, 2**20))
    found = []
    for order in (energies, energies[::-1]):
        sums = histogram(2, emitted=1e6)
        sums.add(mi.UInt32(0), FIRST, mi.Float(order), mi.Bool(True))
        found.append(sums.energy()[0, 0])
    assert found[0] == found[1]
    assert found[0] == pytest.approx(energies.astype(np.float64).sum(), rel=1e-6)


def test_small_and_large_energies_are_summed_without_bias():
    """Coarse units alone would lose energies far below them, and a shift by half a unit would be significant."""
    cases = ((1.0, 1e-26), (1.0, 3e-19), (1.0, 1e-17), (1.0, 1e-6), (4.5e-3, 1e-22), (1e-12, 1e-20), (1e-12, 1e-33))
    for emitted, energy in cases:
        sums = histogram(1, emitted=emitted)
        spread = np.float32(energy * np.random.default_rng(1).uniform(0.5, 1.5, 2**16))
        sums.add(mi.UInt32(0), FIRST, mi.Float(spread), mi.Bool(True))
        # Energies of a few units end within one.
        rtol = 1e-5 + 0.02 * emitted * 2.0**-89 / energy
        np.testing.assert_allclose(sums.energy()[0, 0], spread.astype(np.float64).sum(), rtol=rtol)
        np.testing.assert_allclose(sums.rounded_energy()[0, 0], sums.energy()[0, 0], rtol=1e-6)


def test_energy_that_is_not_finite_marks_its_bin():
    sums = histogram(3, (2,), 1.0)
    times = mi.Float(1390.1e-9 * C0, 1390.1e-9 * C0, 1391.1e-9 * C0)
    sums.add(mi.UInt32(1), times, mi.Float(np.nan, 0.5, np.inf), mi.Bool(True))
    for energy in (sums.energy(), sums.rounded_energy()):
        np.testing.assert_array_equal(energy, [[0, 0, 0], [np.nan, 0, np.nan]])


def test_parts_have_the_bits_of_the_whole():
    """Coarse and fine sums, and what is not finite, of some of the pixels."""
    received = histogram(5, (7,))
    pixels, energies = np.arange(7, dtype=np.uint32), np.array([1, 1e-9, 3, np.nan, 1e-12, 0, 7], np.float32)
    received.add(mi.UInt32(pixels), dr.zeros(mi.Float, 7) + FIRST, mi.Float(energies), mi.Bool(True))
    whole = received.energy()
    for part in (slice(0, 3), slice(2, 7)):
        np.testing.assert_array_equal(received.energy_of(part), whole[part])
    assert np.isnan(whole[3]).any()
    assert whole[4].any()


def test_histogram_that_would_not_fit_is_refused():
    with pytest.raises(UserError, match=r"bin_count = 1000000 times 300 pixels must not exceed 268435456"):
        histogram(1_000_000, (300,))


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
