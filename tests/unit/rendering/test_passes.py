"""Passes until their number, the error or the time ends a render, and its options."""

import contextlib
import inspect
import re
import signal
from dataclasses import fields

import numpy as np
import pytest
from rows import each_row, must_refuse, refuses

import mitransient_lidar
from mitransient_lidar.core.errors import UserError
from mitransient_lidar.core.options import declared
from mitransient_lidar.rendering import passes
from mitransient_lidar.rendering.passes import SMALLEST_PASS_COUNT, Goal, Progress, RenderOptions, run_passes


class Clock:
    """Replaces the time; each pass takes the next of some times [s], the last one for ever."""

    def __init__(self, monkeypatch, *times):
        self.now, self.times, self.passes = 0.0, times, 0
        monkeypatch.setattr(passes.time, "perf_counter", lambda: self.now)

    def render_pass(self, number, seed):
        self.now += self.times[min(number, len(self.times) - 1)]
        self.passes = number + 1
        return 0.0

    def errors(self):
        """One bin of twenty has ten times the error, which falls with the square root of the passes."""
        return np.array([0.1] * 18 + [1.0] * 2) / np.sqrt(self.passes)


@pytest.mark.parametrize(("quantile", "expected"), [(None, 100), (0.5, SMALLEST_PASS_COUNT), (0.95, 100)])
def test_the_quantile_of_the_errors_ends_the_render(monkeypatch, quantile, expected):
    clock = Clock(monkeypatch, 1.0)
    goal = Goal.from_options(0.1, None, None, Goal(), quantile)
    log = run_passes(clock.render_pass, goal, seed=0, errors=clock.errors)
    assert log.count == expected
    assert log.error <= 0.1
    assert log.needed_s == 0


def test_no_error_is_an_accuracy():
    assert Goal(target_error=0.1).is_accurate(0.0)
    assert not Goal(target_error=0.1).is_accurate(None)
    assert not Goal(target_error=0.1).is_accurate(np.inf)


def test_the_time_ends_no_render_before_the_passes_that_it_needs(monkeypatch, caplog):
    clock = Clock(monkeypatch, 1.0)
    assert run_passes(clock.render_pass, Goal(passes=64, max_time=3.5), seed=0, smallest=16).count == 16
    assert "max_time = 3.5 s ended after 16 of 64 passes" in caplog.text
    caplog.clear()
    assert run_passes(clock.render_pass, Goal(passes=16, max_time=100), seed=0, smallest=16).count == 16
    assert not caplog.text


def test_the_forecast_is_that_of_the_passes_that_follow(monkeypatch, caplog):
    """The first pass compiles the kernels and takes 20 s, the others 2 s: 100 passes take 218 s."""
    clock, reports = Clock(monkeypatch, 20.0, 2.0), []
    goal = Goal.from_options(0.1, 60.0, None, Goal())
    log = run_passes(clock.render_pass, goal, seed=0, errors=clock.errors, progress=reports.append)
    assert [report.needed_passes for report in reports[1:3]] == [98, 97]
    assert [report.needed_s for report in reports[1:3]] == [196, 194]
    assert (log.count, log.elapsed_s, log.needed_s) == (21, 60, 158)
    assert "ended after 21 passes and 60 s, before target_error = 0.1" in caplog.text
    assert "95 % of the bins of lit pixels reached 0.218; the target takes about 100 passes and 218 s" in caplog.text


@each_row((1.0, 2), (8.0, 2), (9.0, 3), (10.9, 3), (40.0, 18))
def test_no_pass_begins_that_would_end_after_the_time(limit, expected, monkeypatch):
    """The first pass takes 5 s and the others 2 s; two passes are the least."""
    clock = Clock(monkeypatch, 5.0, 2.0)
    log = run_passes(clock.render_pass, Goal(max_time=limit), seed=0)
    assert log.count == expected
    assert log.elapsed_s <= max(limit, 7.0)


@pytest.mark.parametrize(("goal", "ended"), [(Goal(max_time=1e6), 8), (Goal(passes=3), 3)])
def test_empty_passes_end_with_an_error(monkeypatch, goal, ended):
    clock = Clock(monkeypatch, 1.0)

    def verify(count):
        raise UserError(f"no light in {count} passes")

    must_refuse(f"no light in {ended} passes", run_passes, clock.render_pass, goal, seed=0, verify=verify)
    assert clock.passes == ended


@refuses(
    ((None, None, 4, Goal(), 0.5), "target_quantile = 0.5 needs a target_error"),
    ((0.1, None, None, Goal(), float("nan")), "target_quantile = nan must be finite"),
)
def test_quantiles_out_of_range_are_refused(options):
    Goal.from_options(*options)


def test_the_progress_line_names_the_request_and_its_forecast():
    state = Progress(12, None, target_error=0.03, error=0.041, needed_passes=24, needed_s=12.0, remaining_s=12.0)
    assert str(state) == ("pass 12, 95 % of the bins of lit pixels within 4.1 %, target 3 % in 24 more passes, 12 s")
    state = Progress(2, 9, errors_of="gates", error=0.2, target_quantile=0.5, remaining_s=4.0)
    assert str(state) == "pass 2/9, 50 % of the gates (medians over lit pixels) within 20 %, ends in 4 s"
    state = passes.Progress(done=30, planned=90, unit="run", failed=2, rate=1.234, remaining_s=48.6)
    assert str(state) == "run 30/90, 2 failed, 1.23 a second, ends in 49 s"


@pytest.mark.parametrize(("at", "kept"), [(2, False), (4, True)])
def test_an_interruption_waits_for_its_pass_alone(monkeypatch, default_ctrl_c, at, kept):
    clock = Clock(monkeypatch, 1.0)

    def render_pass(number, seed):
        if number == at - 1:
            signal.raise_signal(signal.SIGINT)
        return clock.render_pass(number, seed)

    with contextlib.nullcontext() if kept else pytest.raises(KeyboardInterrupt):
        assert run_passes(render_pass, Goal(passes=9), seed=0, smallest=3).interrupted
    assert clock.passes == at


NAMES = [one.name for one in fields(RenderOptions)]


def test_render_has_all_options_and_documents_their_ranges():
    parameters = inspect.signature(mitransient_lidar.render).parameters
    assert set(NAMES) < set(parameters)
    parts = re.split(r"^(\w[\w, ]*)\n(?=    )", inspect.getdoc(mitransient_lidar.render), flags=re.MULTILINE)
    described = {name: text for names, text in zip(parts[1::2], parts[2::2], strict=True) for name in names.split(", ")}
    for name, (_, option) in declared(RenderOptions).items():
        assert option.range() in " ".join(described[name].split()), name


def test_values_at_the_ends_are_accepted_and_texts_are_numbers():
    for name, (_, option) in declared(RenderOptions).items():
        for value in () if option.low is None else {option.high if option.above else option.low, option.high} - {None}:
            error = {"target_error": 1.0} if name == "target_quantile" else {}
            assert getattr(RenderOptions(**{name: value}, **error), name) == value
    assert RenderOptions(max_time="5").max_time == 5.0
