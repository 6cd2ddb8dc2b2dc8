"""Sequences of gates: each pulse belongs to one image, and passes sample the pulses without bias."""

import numpy as np
import pytest

from mitransient_lidar.core.errors import UserError
from mitransient_lidar.physics.lidar.gate_train import GateSequence

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
    with pytest.raises(UserError, match="pulse_rate_hz = 0 must be greater than 0"):
        GateSequence(1, 1, 1, 0.0)
