"""Figure of orders of scattering: curves by order, and the share of several reversals."""

import numpy as np
import xarray as xr

from mitransient_lidar.plots.studies.scattering_orders import plot_scattering_orders


def test_orders_add_up_and_the_last_one_holds_the_rest():
    power = np.random.default_rng(2).uniform(1e-7, 1e-6, (4, 2, 3, 50))
    result = xr.Dataset(
        {"waveform": (("pixel", "reversals", "order", "time"), power)},
        {"reversals": ["one", "several"], "order": np.arange(3), "time": 1400.0 + np.arange(50)},
        {"scene": "made"},
    )
    figure = plot_scattering_orders(result)
    upper, lower = figure.axes
    assert [text.get_text() for text in upper.get_legend().get_texts()] == ["all", "0", "1", "≥ 2"]
    np.testing.assert_allclose(upper.lines[0].get_ydata(), power.sum(axis=(0, 1, 2)))
    for order in range(3):
        np.testing.assert_allclose(upper.lines[1 + order].get_ydata(), power[:, :, order].sum(axis=(0, 1)))
    assert len({str(line.get_color()) for line in upper.lines}) == 4
    expected = 100 * power[:, 1].sum(axis=(0, 1)) / power.sum(axis=(0, 1, 2))
    np.testing.assert_allclose(lower.lines[0].get_ydata(), expected)
    assert (upper.get_yscale(), upper.get_ylabel()) == ("log", "received power (W)")
    assert (lower.get_ylabel(), lower.get_ylim()[0]) == ("several\nreversals (%)", 0)
    assert upper.get_title() == "made"


def test_times_without_light_have_no_share():
    power = np.zeros((1, 2, 2, 4))
    power[..., 1] = 1e-6
    dims = ("pixel", "reversals", "order", "time")
    result = xr.Dataset(
        {"waveform": (dims, power)}, {"reversals": ["one", "several"], "order": [0, 1], "time": np.arange(4)}
    )
    _, lower = plot_scattering_orders(result).axes
    np.testing.assert_array_equal(lower.lines[0].get_data(), [[1], [50]])
