"""Measures and statements of the publication on waveforms whose answers are known; the command, and one figure."""

import csv
import math

import matplotlib.image
import numpy as np
import pytest
from command_line import run
from matplotlib.colors import to_rgb
from rows import each_row
from scipy.special import erf

import mitransient_lidar
from mitransient_lidar.plots import palette
from mitransient_lidar.plots.publication import figures as publication
from mitransient_lidar.studies.publication import statements as measures
from mitransient_lidar.studies.publication.statements import COLUMNS, Series, Statement, Waveform, write_statements

TIME = np.arange(0.125, 120, 0.25)


def gaussian(middle, sigma, height=1.0):
    return height * np.exp(-0.5 * ((TIME - middle) / sigma) ** 2)


@pytest.mark.parametrize(("sigma", "rate"), [(2.0, 0.0), (3.0, 0.1)])
def test_duration_of_a_smeared_step(sigma, rate):
    """A small step has the extremes of its curvature one standard deviation before and after, on any exponential."""
    step = 1 - 0.01 * 0.5 * (1 + erf((TIME - 60) / (math.sqrt(2) * sigma)))
    fall = Waveform(TIME, (step * np.exp(-rate * TIME))[None])
    start, stop = measures.change(fall, 0, 61.0)
    # Differences over 1 ns smear the curvature by a variance of 1/6 ns^2.
    assert stop - start == pytest.approx(2 * math.sqrt(sigma**2 + 1 / 6), rel=0.01)
    assert (start + stop) / 2 == pytest.approx(60, abs=0.05)
    assert measures.duration(fall, 0, 61.0) == stop - start


def test_what_a_waveform_does_not_show_is_nan():
    power = np.exp(-0.1 * TIME)
    power[200:] = 0
    assert np.isnan(measures.change(Waveform(TIME, power[None]), 0, 50.0)).all()
    assert np.isnan(measures.crossing(TIME, power, 2.0))


def test_width_and_rise_of_a_gaussian_echo():
    """Full width 2.3548 and rise 1.6869 standard deviations: sqrt(2 ln 10) - sqrt(2 ln(10 / 9))."""
    one = Waveform(TIME, gaussian(50.1, 3.0, 7.0)[None])
    assert measures.half_width(one, 0, (30, 70)) == pytest.approx(2.354820 * 3, rel=2e-3)
    rise = math.sqrt(2 * math.log(10)) - math.sqrt(2 * math.log(10 / 9))
    assert measures.rise_time(one, 0, (30, 70)) == pytest.approx(3 * rise, rel=2e-3)


def test_decay_of_an_exponential():
    """Four pixels of one decay; a ripple of amplitude 0.1 leaves a residual of 0.1 / sqrt(2)."""
    power = np.outer([1, 2, 3, 4], np.exp(-0.03 * TIME))
    assert measures.decay(Waveform(TIME, power), (20, 80)) == pytest.approx((0.03, 0.0), abs=1e-9)
    rippled = power * np.exp(0.1 * np.sin(2 * np.pi * TIME / 2))
    rate, rest = measures.decay(Waveform(TIME, rippled), (20, 80))
    assert rate == pytest.approx(0.03, abs=1e-3)
    assert rest == pytest.approx(0.1 / math.sqrt(2), rel=0.02)


def test_delay_and_ratio_of_two_echoes():
    """Far echoes 4 ns later; a target whose near pixels hold three quarters of its light."""
    power = np.stack([gaussian(54, 2), gaussian(56, 2), gaussian(50, 2), gaussian(52, 2)])
    assert measures.far_after_near(Waveform(TIME, power), (40, 70)) == pytest.approx(4, abs=0.01)
    parts = {"target": np.array([0.5, 0.5, 1, 2])[:, None] * gaussian(60, 2)}
    assert measures.near_share(Waveform(TIME, power, parts)) == pytest.approx(0.75)


def test_error_of_a_ratio_is_that_of_repeated_experiments():
    """The jackknife over eight renders against the spread of 400 experiments of eight renders each."""
    generator = np.random.default_rng(5)

    def experiment():
        return [Series(TIME[:3], m * (1 + 0.1 * generator.standard_normal((8, 1, 3)))) for m in (4.0, 1.0)]

    def ratio(a, b):
        return float(a.power.mean() / b.power.mean())

    found = np.array([measures.estimate(ratio, *experiment()) for _ in range(400)])
    assert found[:, 0].mean() == pytest.approx(4, abs=4 * found[:, 0].std() / 20 + 0.01)
    # The spread of 400 values is known to 1 / sqrt(800), the mean of their errors far better.
    z = (np.sqrt(np.mean(found[:, 1] ** 2)) / found[:, 0].std() - 1) * math.sqrt(800)
    assert abs(z) < 4


@each_row(
    *(("yes", 4.5, 0.1, None), ("yes", 4.5, 0.1, 0.6), ("partly", 4.5, 0.1, 0.2), ("partly", 5.15, 0.1, None)),
    *(("partly", 5.15, 0.1, 0.2), ("no", 6.0, 0.1, None), ("partly", 6.0, 0.1, 0.6), ("no", 3.0, 0.1, 0.4)),
    ("no", math.nan, 0.1, 0.4),
)
def test_whether_a_statement_holds(holds, value, error, share):
    assert Statement("fig10", "s", "q", "4 to 5", value, error, (4.0, 5.0), "w", share).holds == holds


def test_table_of_statements(tmp_path):
    one = Statement("fig10", "a, b", "q", "4 to 5", 4.2, 0.02, (4.0, 5.0), "place", 0.25, "8 places", "facets")
    write_statements([one], tmp_path / "statements.csv")
    with open(tmp_path / "statements.csv", newline="", encoding="utf-8") as file:
        header, row = csv.reader(file)
    assert tuple(header) == COLUMNS
    expected = ["fig10", "a, b", "q", "4 to 5", "4.2", "0.02", "partly", "0.25"]
    assert row == [*expected, "place; holds at 25 % of 8 places", "facets"]


def test_drawn_figures_need_no_render(tmp_path):
    done = run("figures", "fig08", "fig05", "-o", tmp_path, "-q")
    names = ("fig05.png", "fig08.png", "statements.csv")
    assert done.stdout.splitlines()[:3] == [str(tmp_path / name) for name in names]
    assert "14.79" in done.stdout
    assert not done.stderr
    picture = matplotlib.image.imread(tmp_path / "fig08.png")[..., :3]
    for colour in map(to_rgb, (palette.RED, palette.BLUE)):
        # Drawn with an opacity of 0.85 over white.
        drawn = 0.85 * np.array(colour) + 0.15
        assert (np.abs(picture - drawn).max(axis=-1) < 0.03).sum() > 1000


def test_an_interruption_keeps_the_figures_that_are_done(tmp_path, monkeypatch):
    def interrupt(_renders):
        raise KeyboardInterrupt

    broken = publication._FIGURES["fig12"]._replace(measure=interrupt)
    monkeypatch.setitem(publication._FIGURES, "fig12", broken)
    done = run("figures", "fig05", "fig12", "fig13", "-o", tmp_path, "-q")
    assert done.exit_code == 130
    assert "interrupted after 1 of 3 figures" in done.stderr
    assert sorted(path.name for path in tmp_path.iterdir()) == ["fig05.png", "statements.csv"]


@pytest.mark.slow
def test_a_rendered_figure(tmp_path):
    """Sphere at 9 m: its echo lies within half its size about its centre."""
    made = mitransient_lidar.figures(["fig02"], tmp_path, target_error=0.2)
    assert [path.name for path in made.files] == ["fig02.png", "statements.csv"]
    (statement,) = made.statements
    assert statement.holds == "yes"
    assert 8.5 < statement.value < 9.5
    assert 0 < statement.error < 0.2
