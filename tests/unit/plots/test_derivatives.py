"""Figure of derivatives: changes and their bands."""

import numpy as np
import pytest
import xarray as xr

from mitransient_lidar.plots.derivatives import plot_derivatives

TIME = 1400.0 + np.arange(5)


def derivatives(pixels):
    """Return a waveform of 2 W in each pixel with a derivative of 0.5 +- 0.1 W m, by a parameter of 0.4 1/m."""
    power = np.full((pixels, 5), 2.0)
    slopes = np.full((1, pixels, 5), 0.5)
    return xr.Dataset(
        {
            "waveform": (("pixel", "time"), power),
            "waveform_derivative": (("parameter", "pixel", "time"), slopes),
            "waveform_derivative_stderr": (("parameter", "pixel", "time"), 0.2 * slopes),
        },
        {
            "time": TIME,
            "parameter": ["attenuation"],
            "parameter_value": ("parameter", [0.4]),
            "parameter_units": ("parameter", ["1/m"]),
        },
    )


@pytest.mark.parametrize(("pixels", "title"), [(1, "bands: standard errors"), (4, "bands: upper bounds of standard")])
def test_errors_of_pixels_add_up(pixels, title):
    """Pixels share photons. In quadrature, four would have half of this error."""
    figure = plot_derivatives(derivatives(pixels))
    ax = figure.axes[1]
    # 0.4 / 2 * (0.5 +- 0.1), of any number of equal pixels.
    np.testing.assert_allclose(ax.lines[1].get_ydata(), 0.1)
    band = ax.collections[0].get_paths()[0].vertices[:, 1]
    assert (band.min(), band.max()) == pytest.approx((0.08, 0.12))
    assert title in figure.get_suptitle()
