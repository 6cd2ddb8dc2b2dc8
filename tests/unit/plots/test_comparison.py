"""Figure of a comparison: both results, and their differences."""

import numpy as np
import pytest
from matplotlib.colors import to_hex

from mitransient_lidar import results
from mitransient_lidar.analysis.comparison import compare
from mitransient_lidar.physics.lidar.time_axis import TimeAxis
from mitransient_lidar.plots.comparison import plot_comparison

DECAY = 1e-3 * np.exp(-np.arange(60) / 20) * np.array([[1.0], [0.5]])  # W, two pixels


def result(factor, **attributes):
    error = 0.02 * DECAY
    return results.build(
        1e-9 * factor * DECAY,
        1e-9 * error,
        factor * DECAY,
        error,
        time=TimeAxis(0.0, 1.0, 60),
        pixel_names=["near", "far"],
        pixel_centres_mrad=[(1, 0), (-1, 0)],
        attributes={"passes": 50, "scene": "made", **attributes},
    )


@pytest.mark.parametrize(
    ("attributes", "labels"),
    [
        ([{"integrator": "one", "seed": 1}, {"integrator": "one", "seed": 2}], ["seed 1", "seed 2"]),
        ([{"instrument": "a"}, {"instrument": "b"}], ["a", "b"]),
        ([{}, {}], ["first result", "second result"]),
    ],
)
def test_legends_name_what_differs(attributes, labels):
    first, second = (result(1.0, **one) for one in attributes)
    figure = plot_comparison(first, second, compare(first, second))
    assert [text.get_text() for text in figure.axes[0].get_legend().get_texts()] == labels


def test_curves_bands_and_differences():
    first, second = result(1.0, integrator="one"), result(1.1, integrator="two")
    outcome = compare(first, second)
    figure = plot_comparison(first, second, outcome)
    upper, lower = figure.axes
    assert [line.get_linestyle() for line in upper.lines] == ["-", "-", "--", "--"]
    for line, values in zip(upper.lines, [*DECAY, *(1.1 * DECAY)], strict=True):
        np.testing.assert_allclose(line.get_ydata(), values)
    colours = [to_hex(line.get_color()) for line in upper.lines]
    assert colours[:2] == colours[2:]
    assert colours[0] != colours[1]
    # Bands of two standard errors of 2 %.
    assert upper.collections[0].get_paths()[0].vertices[:, 1].max() == pytest.approx(1.04e-3)
    assert [text.get_text() for text in upper.get_legend().get_texts()] == ["one", "two"]
    assert upper.get_yscale() == "log"
    np.testing.assert_allclose([line.get_ydata() for line in lower.lines[:2]], outcome.z)
    assert [line.get_ydata()[0] for line in lower.lines[2:]] == pytest.approx([-outcome.limit, outcome.limit])
    low, high = lower.get_ylim()
    assert low < -outcome.largest
    assert high > outcome.largest
    assert lower.get_ylabel() == "difference\n(standard errors)"
    assert figure.get_suptitle().startswith(f"made: 120 bins, rms {outcome.rms:.2f} and largest {outcome.largest:.1f}")


def test_many_pixels_are_drawn_as_their_sum():
    """A curve of each of 64x64 pixels once took minutes."""
    power = np.repeat(DECAY[:1], 100, axis=0)
    first, second = (
        results.build(
            1e-9 * scale * power, 2e-11 * power, scale * power, 0.02 * power, time=TimeAxis(0.0, 1.0, 60),
            pixel_names=[f"{number}" for number in range(100)],
            pixel_centres_mrad=[(number, 0) for number in range(100)],
            attributes={"passes": 50},
        )
        for scale in (1.0, 1.1)
    )  # fmt: skip
    # What one of them lacks is left out of both.
    first["waveform"][7] = np.nan
    outcome = compare(first, second)
    upper, lower = plot_comparison(first, second, outcome).axes
    np.testing.assert_allclose([line.get_ydata() for line in upper.lines], [99 * power[0], 1.1 * 99 * power[0]])
    # Pixels share light, so that the error of the sum is unknown.
    np.testing.assert_allclose(np.ptp(upper.collections[0].get_paths()[0].vertices[:, 1]), np.ptp(99 * power[0]))
    (ranges,) = lower.collections
    np.testing.assert_allclose([path.vertices[0, 1] for path in ranges.get_paths()], np.nanmin(outcome.z, axis=0))
