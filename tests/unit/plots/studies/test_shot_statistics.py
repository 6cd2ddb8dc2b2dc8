"""Figure of echoes against slopes, and its correlations."""

import math

import numpy as np
import pytest
import xarray as xr

from mitransient_lidar.core.errors import UserError
from mitransient_lidar.plots.studies.shot_statistics import plot_shot_statistics
from mitransient_lidar.studies.shot_statistics import depth_bias, slope_correlations

# At 20 degrees in air: cosine 0.966877 in water, and 0.106257 m of depth in a nanosecond.
METRES_PER_NS = 0.299792458 / (2 * 1.364) * math.sqrt(1 - (math.sin(math.radians(20)) / 1.34) ** 2)
LEVEL_NS = 2 * 5 * 1.364 / 0.299792458 / math.sqrt(1 - (math.sin(math.radians(20)) / 1.34) ** 2)


@pytest.fixture
def shots():
    """Echoes that depend on the slopes alone: separation, strength and depth along, red and green across."""
    along, across = np.random.default_rng(3).normal(0, 0.05, (2, 40))
    separation, sideways = -20 * along, 8 * across
    over = ("shot", "pixel")
    surface = 1420 + np.stack([separation - sideways / 2, separation + sideways / 2, 0 * along, 0 * along], axis=1)
    bottom = 1420 + LEVEL_NS + np.repeat((3 * along / METRES_PER_NS)[:, np.newaxis], 4, axis=1)
    bottom[7, 2] = np.nan
    data = {"surface_time": surface, "bottom_time": bottom}
    data["surface_peak"] = np.repeat(0.25 * 10 ** (-4 + 5 * along)[:, np.newaxis], 4, axis=1)
    attributes = {"scene": "made", "scene.bottom_depth": "5", "off_nadir_deg": 20.0, "surface_time_ns": 1420.0}
    return xr.Dataset(
        {name: (over, values) for name, values in data.items()}
        | {"slope_along": ("shot", along), "slope_across": ("shot", across)},
        {"pixel": ["red", "green", "blue", "black"]},
        attributes | {"altitude": 200.0, "refractive_index": 1.34, "group_index": 1.364},
    )


def test_panels_show_effects_against_slopes(shots):
    along, across = shots["slope_along"].values, shots["slope_across"].values
    expected = {
        "surface echo (log10 W)": (along, -4 + 5 * along),
        "far pair after near pair (ns)": (along, -20 * along),
        "green after red (ns)": (across, 8 * across),
        "bottom too deep (m)": (along, 3 * along),
    }
    figure = plot_shot_statistics(shots)
    assert [ax.get_ylabel() for ax in figure.axes] == list(expected)
    for ax, (slope, value) in zip(figure.axes, expected.values(), strict=True):
        known = np.ones(40, dtype=bool)
        if ax.get_ylabel() == "bottom too deep (m)":
            known[7] = False
        x, y = ax.lines[0].get_data()
        np.testing.assert_allclose(x, np.degrees(np.arctan(slope)))
        np.testing.assert_allclose(y[known], value[known], atol=1e-9)
        assert np.isnan(y[~known]).all()
    signs = [ax.get_title() for ax in figure.axes]
    assert signs == [
        f"correlation {sign}1.00, {count} shots" for sign, count in zip("+-++", (40, 40, 40, 39), strict=True)
    ]
    line = figure.axes[3].lines[1]
    np.testing.assert_allclose(line.get_ydata()[0], depth_bias(np.array(along.min()), 5.0, math.radians(20), 1.34))
    assert figure.get_suptitle() == "made: 40 shots"


def test_correlations_are_those_of_the_panels(shots):
    found = slope_correlations(shots)
    assert list(found) == ["strength", "separation", "sideways", "depth"]
    np.testing.assert_allclose(list(found.values()), [1, -1, 1, 1])


def test_other_pixels_are_rejected(shots, tmp_path):
    with pytest.raises(UserError, match="must be the 2x2 of red, green, blue and black"):
        plot_shot_statistics(shots.assign_coords(pixel=["a", "b", "c", "d"]), tmp_path / "a.png")
    assert not list(tmp_path.iterdir())
