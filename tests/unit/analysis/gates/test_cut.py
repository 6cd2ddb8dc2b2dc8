"""Gate stacks cut from results: energies, standard errors, labels and invalid input."""

import logging
from itertools import pairwise

import numpy as np
import pytest
from oracles.gates import transmission
from rows import each_row, refuses
from scipy.integrate import quad
from scipy.stats import norm
from small_results import made

from mitransient_lidar.analysis.gates import cut as gating
from mitransient_lidar.core.errors import UserError
from mitransient_lidar.physics.lidar.gate_train import GateShape, GateTrain
from mitransient_lidar.physics.lidar.pulse import Pulse
from mitransient_lidar.physics.lidar.time_axis import TimeAxis
from mitransient_lidar.results import gate_stack

START, WIDTH, BINS = 1400.0, 0.5, 240
GEOMETRY = {"scene": "fig09", "altitude": 200.0, "surface_time_ns": 1420.0, "refractive_index": 1.34}
GEOMETRY |= {"group_index": 1.364, "off_nadir_deg": 20.0, "passes": 16}


def power(t):
    """Received power [W]: a surface echo, a column and a bottom echo."""
    t = np.asarray(t, dtype=np.float64)
    surface = 3e-5 * np.exp(-0.5 * ((t - 1420) / 2.1) ** 2)
    column = 1e-5 * np.exp(-(t - 1420) / 40) / (1 + np.exp(-(t - 1420) / 1.5))
    return surface + column + 4e-6 * np.exp(-0.5 * ((t - 1490) / 2.1) ** 2)


def record(scale=(1.0, 2.0, 0.5), grid=None, relative=0.02, attributes=None, values=None):
    """A result whose bins hold the exact means of `power`."""
    edges = START + WIDTH * np.arange(BINS + 1)
    mean = [quad(power, low, high)[0] / WIDTH for low, high in pairwise(edges)]
    waveform = np.outer(scale, mean) if values is None else values
    places = {"centres": np.arange(2.0 * len(waveform)).reshape(-1, 2), "grid": grid}
    about = GEOMETRY if attributes is None else attributes
    return made(waveform, relative * np.abs(waveform), start=START, step=WIDTH, **places, **about)


@each_row(
    GateTrain(1412.0, 10.0, 5.0, 17),
    GateTrain(1412.3, 7.77, 3.1, 20),
    GateTrain(1412.3, 8.0, 3.1, 20, 2.5, 4.0),
    GateTrain.measured(GateShape.sampled([0, 2, 6, 12], [0, 0.9, 0.7, 0]), 1415.0, 4.0, 15),
)
def test_gates_integrate_the_waveform(train):
    stack = gating.cut_gates(record(), train)
    assert stack["gate_energy"].dims == ("pixel", "gate")
    for gate in range(0, train.count, 4):
        low, high = train.spans_ns[gate]
        points = np.unique(np.r_[train.starts_ns[gate], train.starts_ns[gate] + train.width_ns, 1420, 1490])
        inside = {"points": [p for p in points if low < p < high], "limit": 400}
        opened = lambda t, gate=gate: float(power(t) * transmission(train.shape, t - train.starts_ns[gate]))  # noqa: E731
        joules = 1e-9 * quad(opened, low, high, **inside)[0]
        # Within a bin with a sharp edge, the record has only the mean: 0.5 ns of a 5 ns echo.
        np.testing.assert_allclose(stack["gate_energy"][:, gate], np.array([1, 2, 0.5]) * joules, rtol=4e-3)
        if train.width_ns == 10:
            np.testing.assert_allclose(stack["gate_energy"][:, gate], np.array([1, 2, 0.5]) * joules, rtol=1e-7)


def test_contiguous_sharp_gates_sum_to_the_record():
    dataset = record()
    # 24 gates of 5 ns from 1400 to 1520 ns, and 160 of 0.75 ns, which cut bins
    for train in (GateTrain(1400.0, 5.0, 5.0, 24), GateTrain(1400.0, 0.75, 0.75, 160)):
        total = dataset["waveform"].sum("time") * WIDTH * 1e-9
        np.testing.assert_allclose(gating.cut_gates(dataset, train)["gate_energy"].sum("gate"), total, rtol=1e-12)


def test_pulses_add_up_and_errors_without_inflation_are_upper_bounds(caplog):
    train = {"start_ns": 1420.0, "width_ns": 5.0, "step_ns": 5.0, "count": 4}
    with caplog.at_level(logging.INFO, logger="mitransient_lidar"):
        one, many = (gating.cut_gates(record(relative=0.03), GateTrain(**train, pulses=n)) for n in (1, 1000))
    np.testing.assert_allclose(many["gate_energy"], 1000 * one["gate_energy"], rtol=1e-12)
    assert many.attrs["pulses"] == 1000
    for stack in (one, many):
        np.testing.assert_allclose(stack["gate_energy_stderr"], 0.03 * stack["gate_energy"], rtol=1e-12)
    assert "upper bounds" in caplog.text


def test_error_is_inflated_as_measured_in_the_render():
    inflation = {"error_inflation_bins": [1, 2, 4, 8, 16], "error_inflation": [1.0, 1.3, 1.8, 2.2, 2.4]}
    flat = record(values=np.full((1, BINS), 1e-5), relative=0.1, attributes=GEOMETRY | inflation)
    one_bin = 1e-6 * WIDTH * 1e-9

    def error(width, start=1450.0, dataset=flat):
        """Error of one gate over that of one bin."""
        return gating.cut_gates(dataset, GateTrain(start, width, width, 1))["gate_energy_stderr"].item() / one_bin

    assert error(0.5) == pytest.approx(1)
    assert error(2.0) == pytest.approx(2 * 1.8)
    # In the logarithm, 6 bins lie log2(1.5) = 0.58 of the way from 4 to 8.
    assert error(3.0) == pytest.approx(np.sqrt(6) * (1.8 + 0.4 * np.log2(1.5)))
    # Beyond what was measured: 32 bins at most as badly as sqrt(2) more
    assert error(16.0) == pytest.approx(np.sqrt(32) * 2.4 * np.sqrt(2))
    # Three quarters of a bin and a quarter of the next count as 1/(0.75^2 + 0.25^2) = 1.6 bins.
    assert error(0.5, start=1450.125) == pytest.approx(np.sqrt(0.625) * (1 + 0.3 * np.log2(1.6)))
    # Never more than the sum of the errors
    exaggerated = flat.assign_attrs(error_inflation=[1.0, 5.0, 5.0, 5.0, 5.0])
    assert error(2.0, dataset=exaggerated) == pytest.approx(4)


def test_stack_is_labelled():
    train = GateTrain(1418.0, 6.0, 3.0, 5, 1.0, 2.0, pulses=3)
    dataset = record(scale=np.ones(6), grid=(2, 3))
    stack = gating.cut_gates(dataset, train)
    assert stack["gate_energy"].dims == ("row", "column", "gate")
    assert set(stack.data_vars) == {"gate_energy", "gate_energy_stderr"}
    assert "time" not in stack.coords
    np.testing.assert_array_equal(stack["angle_x"], dataset["angle_x"])
    np.testing.assert_array_equal(stack["gate"], np.arange(5))
    np.testing.assert_array_equal(stack["gate_start"], [1418, 1421, 1424, 1427, 1430])
    np.testing.assert_array_equal(stack["gate_width"], np.full(5, 6.0))
    # Gate 0 has its middle at 1421 ns, and the mean sea level is at 1419.886 ns on the axis; 1 ns is
    # c0/(2 n_g) cos(asin(sin 20/1.34)) = 0.106252 m.
    np.testing.assert_allclose(stack["gate_depth"], 0.106252 * (1.11407 + 3 * np.arange(5)), rtol=1e-4)
    expected = {"gate_rise_ns": 1.0, "gate_fall_ns": 2.0, "gate_step_ns": 3.0, "pulses": 3, "scene": "fig09"}
    assert expected.items() <= stack.attrs.items()
    assert stack.attrs["history"].startswith(dataset.attrs["history"])


def test_nan_stays_in_its_gates():
    dataset = record()
    dataset["waveform"][1, 40] = np.nan  # 1420 to 1420.5 ns
    stack = gating.cut_gates(dataset, GateTrain(1415.0, 5.0, 5.0, 4))
    np.testing.assert_array_equal(np.isnan(stack["gate_energy"][1]), [False, True, False, False])
    assert np.isfinite(stack["gate_energy"][0]).all()


@refuses(
    (GateTrain(1402.0, 5.0, 5.0, 3), r"before the surface: .* closes at 1417\.0 ns.* arrives at 1420\.0 ns"),
    (GateTrain(1530.0, 5.0, 5.0, 3), r"gate 0 is open from 1530\.0 to 1535\.0 ns.* the record, 1400\.0 to 1520"),
    (GateTrain(1500.0, 5.0, 5.0, 5), r"gate 4 is open from 1520\.0 to 1525\.0"),
    (GateTrain(1399.9, 5.0, 5.0, 9), r"gate 0 is open from 1399\.9"),
    # Half heights within the record, the edge outside
    (GateTrain(1500.0, 5.0, 5.0, 4, 0.0, 2.0), r"gate 3 is open from 1515\.0 to 1521\.7"),
)
def test_trains_outside_the_record_are_rejected(train):
    gating.cut_gates(record(), train)


def test_train_before_a_record_of_unknown_surface():
    with pytest.raises(UserError, match=r"before the surface: .* the record starts at 1400\.0 ns"):
        gating.cut_gates(record(attributes={}), GateTrain(1380.0, 5.0, 5.0, 2))
    # Near pixels see the surface before the mean: their gates are welcome.
    early = record(attributes=GEOMETRY | {"window_start_ns": 1410.0})
    assert gating.cut_gates(early, GateTrain(1402.0, 5.0, 5.0, 3)).sizes["gate"] == 3


def test_train_from_options(tmp_path):
    train = gate_stack.train_from_options(GEOMETRY, start_ns=1430.0, width_ns=6.0, count=3, rise_ns=1.0, pulses=5)
    assert train == GateTrain(1430.0, 6.0, 6.0, 3, 1.0, 0.0, 5)
    deep = gate_stack.train_from_options(GEOMETRY, start_depth_m=0.106252 * 10, width_ns=6.0, step_ns=2.0, count=3)
    # The mean sea level on the axis is at 1419.886 ns, whatever the waves at `surface_time_ns`.
    assert deep.start_ns == pytest.approx(1429.886, abs=1e-3)
    assert deep.step_ns == 2.0
    # 2 m in water at a group index of 1.364, behind 212.836 m of air.
    far = gate_stack.train_from_options(GEOMETRY, start_range_m=200 / np.cos(np.radians(20)) + 2.0, width_ns=6.0)
    assert far.start_ns == pytest.approx(1419.886 + 2 * 2.0 * 1.364 / 0.299792458, abs=1e-3)
    wet = gate_stack.train_from_options(
        {"altitude": -3.0, "group_index": 1.364}, start_range_m=2.0, width_ns=6.0, jitter_ns=0.5
    )
    assert wet.start_ns == pytest.approx(2 * 2.0 * 1.364 / 0.299792458)
    empty = gate_stack.build_gates(*np.zeros((2, 1, 1)), wet, coords={"pixel": ["a"]}, attributes={})
    assert empty.attrs["gate_jitter_ns"] == 0.5
    path = tmp_path / "gate.txt"
    path.write_text("0 0\n1 1\n3 0\n")
    measured = gate_stack.train_from_options(GEOMETRY, start_ns=1430.0, profile_file=path, count=2)
    assert (measured.width_ns, measured.step_ns) == (pytest.approx(1.5), pytest.approx(1.5))
    stack = gating.cut_gates(record(), measured)
    np.testing.assert_allclose(stack.attrs["gate_profile_ns"], [-0.5, 0.5, 2.5])
    assert stack.attrs["gate_profile"] == [0.0, 1.0, 0.0]


def test_gates_narrower_than_bins_are_cut_with_a_warning_of_the_error(caplog):
    """The largest error that an echo of a Gaussian pulse can have, of those at 200 times in their bins."""
    train = GateTrain(1430.0, 1.0, 1.0, 30)
    pulse, width = Pulse.gaussian(5.0), 5.0
    axis = TimeAxis(1400.0, width, 24)
    lag, kernel = pulse.kernel(width)
    errors, largest = [], 0.0
    for arrival in np.linspace(1445.0, 1450.0, 200, endpoint=False):
        waveform = np.zeros(24)
        waveform[int((arrival - 1400.0) // width) + lag :][: kernel.size] = kernel / width
        rows = [train.gate_bins(gate, axis.start_ns, width, 24) for gate in range(30)]
        cut = [width * waveform[first : first + weights.size] @ weights for first, weights in rows]
        exact = np.diff(norm.cdf(np.append(train.starts_ns, 1460.0), arrival, 5.0 / 2.3548))
        errors.append(np.abs(cut - exact).max())
        largest = max(largest, exact.max())
    bound = train.cutting_error(pulse, 0.0, width)
    assert max(errors) / largest == pytest.approx(bound, rel=0.05)
    coarse = record().coarsen(time=10).mean()
    coarse.attrs |= {"pulse_fwhm_ns": 5.0, "bin_width_ns": 5.0}
    gating.cut_gates(coarse, train)
    assert f"than the bins of 5 ns: the energy of an echo may be wrong by up to {100 * bound:.0f} %" in caplog.text


@refuses(
    ({"width_ns": 5.0}, "one start: start_ns, start_depth_m or start_range_m"),
    ({"start_ns": 1.0, "start_depth_m": 1.0, "width_ns": 5.0}, "one start"),
    ({"start_ns": 1.0}, "one shape: either width_ns or a profile file"),
    ({"start_ns": 1.0, "width_ns": 5.0, "profile_file": "gate.txt"}, "one shape"),
    ({"start_ns": 1.0, "profile_file": "gate.txt", "rise_ns": 2.0}, "must be 0 with a profile"),
    ({"start_ns": 1.0, "profile_file": "missing.txt"}, r"cannot read missing\.txt: No such file"),
)
def test_options_that_do_not_go_together(options):
    gate_stack.train_from_options(GEOMETRY, **options)
