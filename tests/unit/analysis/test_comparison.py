"""Agreement of two results: detection of known differences, and false alarms."""

import numpy as np
import pytest
from command_line import run
from rows import must_refuse
from scipy.stats import binom, norm
from significance import FALSE_ALARM, largest_z
from small_results import made

from mitransient_lidar import results
from mitransient_lidar.analysis import comparison
from mitransient_lidar.analysis.gates.cut import cut_gates
from mitransient_lidar.core.errors import UserError
from mitransient_lidar.physics.lidar.gate_train import GateShape, GateTrain
from mitransient_lidar.results.sum_errors import with_correlation

TRUE = np.exp(-np.arange(100) / 40) * np.array([[1.0], [0.5]])  # J, two pixels


def result(seed, passes=6, factor=1.0, relative=0.05, bins=100, **attributes):
    """Return the mean of normal passes and its standard error."""
    drawn = TRUE[:, :bins] * (factor + relative * np.random.default_rng(seed).normal(size=(passes, 2, bins)))
    mean, error = drawn.mean(axis=0), drawn.std(axis=0, ddof=1) / np.sqrt(passes)
    about = {"passes": passes, "integrator": "lidar_volpath", **attributes}
    places = {"names": ["near", "far"], "centres": [(1, 0), (-1, 0)]}
    return made(1e9 * mean, 1e9 * error, start=0.0, step=1.0, **places, **about)


@pytest.mark.slow
def test_false_alarm_rate_of_differences():
    """Over 200 pairs of few passes: taken for normal, Student's t would exceed the limit in a third of them."""
    pairs = [comparison.compare(result(2 * seed), result(2 * seed + 1)) for seed in range(200)]
    assert {pair.bin_count for pair in pairs} == {200}
    alarms = sum(not pair.agrees for pair in pairs)
    assert alarms <= binom.isf(FALSE_ALARM, len(pairs), 0.01)
    rms = np.array([pair.rms for pair in pairs])
    # A bin's error is never taken smaller than its neighbours': a little more than it is.
    known = largest_z(len(pairs)) * rms.std(ddof=1) / np.sqrt(len(pairs))
    assert 0.85 - known < rms.mean() < 1 + known


def test_a_difference_in_one_bin_or_in_all_is_found():
    first, second = result(1, passes=40), result(2, passes=40)
    second["impulse_response"][1, 30] += 8 * second["impulse_response_stderr"][1, 30] * np.sqrt(2)
    outcome = comparison.compare(first, second)
    assert not outcome.agrees
    assert np.unravel_index(np.nanargmax(np.abs(outcome.z)), outcome.z.shape) == (1, 30)
    assert outcome.z[1, 30] > 0
    everywhere = comparison.compare(result(1, passes=40), result(2, passes=40, factor=1.05))
    assert abs(everywhere.energy_ratio - 1.05) < largest_z(40) * everywhere.energy_ratio_stderr
    assert everywhere.energy_ratio_stderr < 0.002
    assert not everywhere.agrees


def test_the_error_of_the_energy_has_the_correlation_of_bins():
    """Errors that all bins of a pixel share add up; independent ones would be a tenth."""
    given = [result(seed, passes=40) for seed in (1, 2)]
    alone = comparison.compare(*given).energy_ratio_stderr
    shared = [with_correlation(one, one["time"].values, np.ones((100, 100))) for one in given]
    sums = [np.linalg.norm(one["waveform_stderr"].sum("time")) / one["waveform"].sum().item() for one in given]
    together = comparison.compare(*shared)
    assert together.energy_ratio_stderr == pytest.approx(np.hypot(*sums) * together.energy_ratio, rel=1e-6)
    assert together.energy_ratio_stderr > 5 * alone


def test_bins_outside_the_window_or_badly_known_do_not_count():
    window = {"window_start_ns": 20.0, "window_end_ns": 60.0}
    outcome = comparison.compare(result(1, **window), result(2, **window))
    assert outcome.bin_count == 80  # bins 20 to 59 with their centres within, of two pixels
    noisy = result(2)
    noisy["impulse_response_stderr"][0] = noisy["impulse_response"][0] * 0.4
    assert comparison.compare(result(1), noisy).bin_count == 100


def test_sidak_limit_has_the_significance():
    """Among 200 numbers; Bonferroni's is 0.2 % of z higher, no correction 1.3 lower."""
    limit = comparison.sidak_limit(200)
    assert (1 - 2 * norm.sf(limit)) ** 200 == pytest.approx(0.99, rel=1e-9)
    assert comparison.sidak_limit(1) == pytest.approx(norm.isf(0.005))


def test_results_that_cannot_be_compared_are_rejected():
    with pytest.raises(UserError, match="2 pixels x 100 bins and 2 pixels x 90 bins: they must have the same"):
        comparison.compare(result(1), result(2, bins=90))
    # As of an earlier version, which had the pixels of a layout from right to left.
    mirrored = result(2).assign_coords(angle_x=-result(2)["angle_x"])
    must_refuse("the results have pixels at different angles", comparison.compare, result(1), mirrored)
    with pytest.raises(UserError, match="0 and 6 passes: both must have at least 2"):
        comparison.compare(result(1, passes=6).assign_attrs(passes=0), result(2))
    unknown = result(1)
    unknown["impulse_response_stderr"][:] = unknown["impulse_response"]
    must_refuse("share no bin", comparison.compare, unknown, result(2))


def test_gates_alone_are_compared(tmp_path):
    """The same pixels and gates of other passes agree, and 3 % more light does not; with bins beside, too."""

    def gates(seed, factor=1.0):
        bins = result(seed, 64, factor, 0.02)
        train = GateTrain.measured(GateShape.edges(10.0), 5.0, 10.0, 9, 1)
        return cut_gates(bins, train), bins

    (first, bins), (second, _), (brighter, _) = gates(1), gates(2), gates(3, 1.03)
    assert comparison.compare(first, second).agrees
    assert comparison.compare(first, brighter).energy_ratio == pytest.approx(1.03, abs=0.005)
    assert not comparison.compare(first.merge(bins, combine_attrs="override"), brighter).agrees
    for name, one in (("a", first), ("b", second), ("c", brighter)):
        results.save(one, tmp_path / f"{name}.nc")
    assert "agree: 18 bins" in run("compare", tmp_path / "a.nc", tmp_path / "b.nc").stdout
    assert run("compare", tmp_path / "a.nc", tmp_path / "c.nc").exit_code == 1
    must_refuse("no variable gate_energy", comparison.compare, first, bins)
