"""Figures of errors and uncertainties of depths: what is drawn where."""

import numpy as np
import pytest
import xarray as xr

from mitransient_lidar.analysis.depth_uncertainty import SURVEY_ORDERS
from mitransient_lidar.plots.studies.depth_bias import plot_depth_bias
from mitransient_lidar.plots.studies.depth_uncertainty import plot_orders, plot_uncertainty

WINDS, WATERS, DEPTHS = [1.0, 5.0], ["III", "3C", "7C", "9C"], [2.0, 6.0]


@pytest.fixture
def uncertainty():
    """TVU that differs in every cell; the bottom of the last water is lost at the larger depth."""
    shape = (2, len(WINDS), len(WATERS), len(DEPTHS))
    tvu = 0.1 + 0.05 * np.arange(np.prod(shape)).reshape(shape) / 10
    order = np.arange(np.prod(shape)).reshape(shape) % 5
    tvu[:, :, -1, -1], order[:, :, -1, -1] = np.nan, -1
    dims = ("correction", "wind_speed", "water", "depth")
    coords = {"correction": ["none", "table"], "wind_speed": WINDS, "water": WATERS, "depth": DEPTHS}
    scalars = {"altitude": 300.0, "off_nadir_deg": 20.0}
    data = {"tvu": (dims, tvu), "order": (dims, order), "found": (dims[1:], np.ones(shape[1:]))}
    return xr.Dataset(data, {**coords, **scalars}, {"instrument": "made"})


@pytest.mark.slow
def test_uncertainty_is_drawn_by_water_beside_the_orders(uncertainty):
    figure = plot_uncertainty(uncertainty)
    panels = [ax for ax in figure.axes if ax.get_title()]
    assert [ax.get_title() for ax in panels] == [f"Jerlov {water}" for water in WATERS]
    for ax, water in zip(panels, WATERS, strict=True):
        lines = ax.lines[len(SURVEY_ORDERS) :]
        for number, wind in enumerate(WINDS):
            drawn = uncertainty["tvu"].sel(water=water, wind_speed=wind)
            np.testing.assert_array_equal(lines[2 * number].get_ydata(), drawn.sel(correction="table"))
            np.testing.assert_array_equal(lines[2 * number + 1].get_ydata(), drawn.sel(correction="none"))
        assert ax.lines[1].get_ydata()[0] == 0.25
    assert figure.legends[0].get_texts()[1].get_text() == "5 m/s"
    uncertainty["tvu"][:] = np.nan
    assert plot_uncertainty(uncertainty).axes[0].get_ylim()[1] > 0.25


@pytest.mark.slow
def test_orders_are_drawn_by_depth_with_lost_bottoms_apart(uncertainty):
    figure = plot_orders(uncertainty)
    for number, depth in enumerate(DEPTHS):
        image = figure.axes[number].images[0].get_array()
        expected = uncertainty["order"].sel(correction="table", depth=depth).transpose("water", "wind_speed").values
        np.testing.assert_array_equal(image, np.where(expected < 0, 5, expected))
    uncertainty["found"][0, 0] = np.nan
    left_out = np.ma.getmaskarray(plot_orders(uncertainty).axes[0].images[0].get_array())
    np.testing.assert_array_equal(left_out, (np.arange(8) == 0).reshape(4, 2))
    labels = [text.get_text() for text in figure.axes[-1].get_yticklabels()]
    assert labels == ["exclusive", "special", "1a/1b", "2", "none", "no depth"]


@pytest.mark.slow
def test_bias_is_drawn_against_the_angle():
    dims = ("off_nadir_deg", "wind_speed", "water", "depth", "estimator", "pixel")
    bias = np.linspace(-0.2, 0.1, 3 * 2 * 2).reshape(3, 1, 1, 2, 2, 1)
    coords = {"off_nadir_deg": [0.0, 20.0, 40.0], "wind_speed": [0.0], "water": ["1C"], "depth": DEPTHS}
    coords |= {"ripples": ("wind_speed", [6.0]), "estimator": ["leading_edge", "peak"], "pixel": ["single"]}
    data = {"bias": (dims, bias), "spread": (dims, np.full(bias.shape, 0.01))}
    figure = plot_depth_bias(xr.Dataset(data, coords, {"instrument": "made", "receiver": "ideal"}))
    first, second = figure.axes
    assert first.get_title() == "level sea, ripples of 6 m/s, Jerlov 1C, 2 m"
    curve = second.containers[1].lines[0]
    np.testing.assert_array_equal(curve.get_xdata(), coords["off_nadir_deg"])
    np.testing.assert_allclose(curve.get_ydata(), 100 * bias[:, 0, 0, 1, 1, 0])
    assert [text.get_text() for text in figure.legends[0].get_texts()] == ["leading edge", "peak"]
