"""Gates: their shapes, trains and sequences, and what they collect of bins."""

import numpy as np
import pytest
from oracles.gates import transmission
from rows import must_refuse
from scipy.integrate import quad
from scipy.stats import exponnorm, norm

from mitransient_lidar.physics.lidar.gate_train import GateSequence, GateShape, GateTrain
from mitransient_lidar.physics.lidar.pulse import Pulse

PROFILE = GateShape.sampled([100, 101, 103, 104, 107], [0, 0.8, 0.8, 0.4, 0])


def level_crossing(shape, level, low, high):
    """Bisect for the time at which the transmission passes a level."""
    rising = transmission(shape, high) > transmission(shape, low)
    for _ in range(60):
        middle = (low + high) / 2
        if (transmission(shape, middle) < level) == rising:
            low = middle
        else:
            high = middle
    return low


def test_edges_have_the_stated_times_and_half_heights():
    shape = GateShape.edges(12.0, 3.0, 5.0)
    first, last = shape.span_ns
    rise = [level_crossing(shape, level, first, 6.0) for level in (0.1, 0.5, 0.9)]
    fall = [level_crossing(shape, level, 6.0, last) for level in (0.9, 0.5, 0.1)]
    assert rise[1] == pytest.approx(0, abs=1e-12)
    assert fall[1] == pytest.approx(12, abs=1e-12)
    assert rise[2] - rise[0] == pytest.approx(3, abs=1e-9)
    assert fall[2] - fall[0] == pytest.approx(5, abs=1e-9)
    # A raised cosine is 1/(1 - 2 acos(0.8)/pi) = 1.694 times as long as its 10-90 % part.
    assert first == pytest.approx(-1.694 * 3 / 2, rel=1e-3)
    np.testing.assert_array_equal(transmission(shape, [first - 1e-9, 6.0, last + 1e-9]), [0, 1, 0])


def test_sharp_gates_are_half_open():
    shape = GateShape.edges(4.0)
    np.testing.assert_array_equal(transmission(shape, [-1e-12, 0, 4 - 1e-12, 4]), [0, 1, 1, 0])


def test_width_and_edges_of_measured_gates():
    # Half of the largest transmission, 0.4, is passed at 100.5 and last at 104; 10 % and 90 % are 0.08 and 0.72.
    assert PROFILE.width_ns == pytest.approx(3.5)
    assert PROFILE.rise_ns == pytest.approx(0.8)
    assert PROFILE.fall_ns == pytest.approx((104 + 3 * 0.8) - (103 + 0.2))
    assert transmission(PROFILE, 0.0) == pytest.approx(0.4)
    assert PROFILE.span_ns == (-0.5, 6.5)
    assert PROFILE.open_time(99.0) == pytest.approx(0.4 + 1.6 + 0.6 + 0.6)


@pytest.mark.parametrize("jitter", [0.2, 2.0, 20.0])
def test_jitter_makes_the_mean_of_gates_that_open_early_and_late(jitter):
    """A sharp gate becomes the difference of two normal distributions, with the same integral and mean start."""
    shape = GateShape.edges(8.0).jittered(jitter)
    t = np.linspace(-100, 100, 4001)
    expected = norm.cdf(t / jitter) - norm.cdf((t - 8.0) / jitter)
    # Means over cells of a thirty-second of the jitter.
    np.testing.assert_allclose(np.interp(t, shape.times_ns, shape.values, 0, 0), expected, atol=1e-4)
    assert shape.open_time(1e3) == pytest.approx(8.0, rel=1e-6)
    assert (shape.width_ns, shape.rise_ns, shape.jitter_ns) == (8.0, 0.0, jitter)
    assert GateTrain.measured(shape, 5.0, 2.0, 3).middles_ns.tolist() == [9.0, 11.0, 13.0]
    assert PROFILE.jittered(0.0) is PROFILE
    assert PROFILE.jittered(jitter).open_time(1e3) == pytest.approx(float(PROFILE.open_time(1e3)), rel=1e-6)


def test_profile_files(tmp_path):
    path = tmp_path / "gate.csv"
    path.write_text("# ns, transmission\n0, 0\n1 1\n\n3,0 # end\n")
    assert GateShape.from_file(path).width_ns == pytest.approx(1.5)
    path.write_text("gate [%]; t [ps]\n0; 0\n100; 1000\n0; 3000\n")
    assert GateShape.from_file(path).width_ns == pytest.approx(1.5)
    path.write_text("1 2 3\n4 5 6\n")
    must_refuse("line 1: '1 2 3' must be two numbers, time in ns and transmission", GateShape.from_file, path)


@pytest.mark.parametrize("shape", [GateShape.edges(7.0), GateShape.edges(7.0, 2.0, 6.0), PROFILE])
def test_open_time_is_the_integral_of_the_transmission(shape):
    first, last = shape.span_ns
    points = [p for p in (0.0, 0.5, shape.width_ns, 2.5, 3.5) if first < p < last]
    for t in np.linspace(first, last, 5)[1:]:
        inside = [p for p in points if p < t]
        expected = quad(lambda x: float(transmission(shape, x)), first, t, points=inside, limit=200)[0]
        assert float(shape.open_time(t)) == pytest.approx(expected, abs=1e-8)
    assert shape.open_time(first - 5) == 0
    assert shape.open_time(last + 5) == pytest.approx(float(shape.open_time(last)))


def test_gates_follow_each_other():
    train = GateTrain(1400.0, 10.0, 2.5, 5, 1.0, 2.0)
    np.testing.assert_array_equal(train.starts_ns, [1400, 1402.5, 1405, 1407.5, 1410])
    np.testing.assert_array_equal(train.middles_ns, train.starts_ns + 5)
    np.testing.assert_allclose(train.spans_ns - train.starts_ns[:, None], [train.shape.span_ns] * 5)
    for gate in range(5):
        # A gate too late or early by one step would be off by 5 bins.
        first, weights = train.gate_bins(gate, 1390.0, 0.5, 100)
        assert first == train.gate_bins(0, 1390.0, 0.5, 100)[0] + 5 * gate
        np.testing.assert_allclose(weights, train.gate_bins(0, 1390.0, 0.5, 100)[1], atol=1e-12)
    must_refuse("gate = 5 must lie between 0 and 4", train.gate_bins, 5, 1390.0, 0.5, 100)


@pytest.mark.parametrize("train", [GateTrain(1403.2, 7.0, 3.3, 4, 2.0, 4.0), GateTrain.measured(PROFILE, 1402, 1.7, 6)])
def test_weights_of_bins_are_exact_means(train):
    weights = np.zeros((60, train.count))
    for gate in range(train.count):
        first, column = train.gate_bins(gate, 1400.0, 0.5, 60)
        weights[first : first + column.size, gate] = column
    fine = transmission(train.shape, (1400 + 0.5 * (np.arange(60 * 500) + 0.5) / 500)[:, None] - train.starts_ns)
    # The midpoint rule with 500 points a bin is right to h^2 g''/24 and to h at a profile's steps of slope.
    np.testing.assert_allclose(weights, fine.reshape(60, 500, -1).mean(axis=1), atol=2e-5)
    np.testing.assert_allclose(0.5 * weights.sum(axis=0), float(train.shape.open_time(99.0)), rtol=1e-12)


def test_weights_of_sharp_gates_are_shares_of_bins():
    first, weights = GateTrain(1401.2, 2.0, 1.0, 1).gate_bins(0, 1400.0, 0.5, 320)
    assert first == 2
    np.testing.assert_allclose(weights, [0.6, 1, 1, 1, 0.4])
    # Only the part of a gate within the record counts, and none of a gate outside it.
    first, weights = GateTrain(1399.0, 2.0, 1.0, 1).gate_bins(0, 1400.0, 0.5, 320)
    assert (first, weights.tolist()) == (0, [1, 1])
    assert GateTrain(900.0, 2.0, 1.0, 1).gate_bins(0, 1400.0, 0.5, 320)[1].size == 0
    assert GateTrain(9000.0, 2.0, 1.0, 1).gate_bins(0, 1400.0, 0.5, 320)[1].size == 0


def weights_at(table, time_ns):
    return np.interp(time_ns, table.start_ns + table.step_ns * np.arange(table.values.size), table.values)


def test_response_of_a_sharp_gate_is_the_difference_of_two_distributions():
    train = GateTrain(1400.0, 8.0, 4.0, 3)
    table = train.response_weights(Pulse.gaussian(5.0), 2.0)
    t = np.linspace(1360, 1430, 701)
    sigma = 5 / 2.3548200450309493
    late = exponnorm(2.0 / sigma, scale=sigma)
    # An echo at t counts when pulse and response bring it between the edges. Added delays with the wrong sign, or a
    # table half a step off, would change this by 3e-3 or more.
    expected = late.cdf(1408 - t) - late.cdf(1400 - t)
    np.testing.assert_allclose(weights_at(table, t), expected, rtol=0, atol=2e-5)
    assert table.values[0] == table.values[-1] == 0
    # Light that arrives before the gate opens still counts, through the response.
    assert weights_at(table, 1395.0) > 0.1 > norm.sf(5 / sigma)


def test_response_of_a_gate_with_edges_agrees_with_quadrature():
    train = GateTrain(1400.0, 8.0, 4.0, 3, 2.0, 6.0)
    table = train.response_weights(Pulse.gaussian(3.0))
    sigma = 3 / 2.3548200450309493
    for t in (1396.0, 1399.0, 1403.0, 1406.5, 1411.0):
        expected = quad(
            lambda tau, t=t: norm.pdf(tau, scale=sigma) * float(transmission(train.shape, t + tau - train.start_ns)),
            -8 * sigma,
            8 * sigma,
            points=[1400 - t, 1408 - t],
            limit=200,
        )[0]
        assert weights_at(table, t) == pytest.approx(expected, abs=2e-5)
    # Its area is the open time, whatever the pulse.
    assert table.step_ns * table.values.sum() == pytest.approx(8.0, rel=1e-9)


def test_a_long_response_of_a_short_pulse_has_a_step_that_fits():
    train = GateTrain(1400.0, 8.0, 4.0, 3)
    assert train.response_weights(Pulse.gaussian(0.01), 50.0).values.size <= 2**18


GATES, PULSES, FRAMES = 5, 3, 4
ALL = np.meshgrid(np.arange(FRAMES), np.arange(GATES), np.arange(PULSES), indexing="ij")


@pytest.mark.parametrize("order", ["in_order", "interleaved", "random"])
def test_each_pulse_of_the_laser_belongs_to_one_image(order):
    sequence = GateSequence(GATES, PULSES, FRAMES, 100.0, order, seed=3)
    times = sequence.times(*ALL)
    np.testing.assert_allclose(np.sort(times, axis=None), np.arange(times.size) / 100.0, atol=1e-12)
    # Frame after frame.
    assert np.all(times[:-1].max(axis=(1, 2)) < times[1:].min(axis=(1, 2)))
    # Pulses of an image follow each other, or those of all other gates come between.
    apart = GATES if order == "interleaved" else 1
    np.testing.assert_allclose(np.diff(times, axis=2), apart / 100.0)
    in_turn = np.all(np.diff(times[:, :, 0], axis=1) > 0, axis=1)
    assert not in_turn.all() if order == "random" else in_turn.all()
    later = GateSequence(GATES, PULSES, FRAMES, 100.0, order, readout_s=0.5, seed=3).times(*ALL) - times
    readouts = ALL[0] if order == "interleaved" else ALL[0] * GATES + sequence.places[ALL[0], ALL[1]]
    np.testing.assert_allclose(later, 0.5 * readouts)


@pytest.mark.parametrize(("pulses", "passes"), [(1, 4), (5, 3), (7, 2), (2, 16)])
def test_passes_sample_all_pulses_alike(pulses, passes):
    """Over even numbers in [0, 1), every pulse is in the same share of all passes."""
    sequence, even = GateSequence(1, pulses, 1, 1.0), (np.arange(7000) + 0.5) / 7000
    drawn = np.concatenate([sequence.sampled_pulse(number, passes, even) for number in range(passes)])
    share = np.bincount(drawn, minlength=pulses) / drawn.size
    assert share == pytest.approx(1 / pulses, abs=1 / 7000)
    # Each pass has its own part of the pulses.
    spans = [np.ptp(sequence.sampled_pulse(number, passes, even)) for number in range(passes)]
    assert max(spans) <= pulses / passes + 1


def test_platform_goes_along_its_heading():
    sequence = GateSequence(1, 1, 1, 1.0, speed=2.0, heading_deg=90.0)
    np.testing.assert_allclose(sequence.displacements(np.array([0.0, 3.0])), [[0, 0], [6, 0]], atol=1e-12)
    must_refuse("pulse_rate_hz = 0 must be greater than 0", GateSequence, 1, 1, 1, 0.0)
