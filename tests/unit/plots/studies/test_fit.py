"""Figure of a fit: what is drawn where."""

import numpy as np
import pytest
from closed_form_waveform import TRUTH, closed_form, noisy

from mitransient_lidar.analysis.information.fits import WaveformFit
from mitransient_lidar.analysis.information.measured import measured
from mitransient_lidar.plots.studies.fit import plot_fit


@pytest.mark.slow
def test_waveforms_fit_and_residuals_are_drawn_by_pixel():
    pixels = ("a", "b")
    data = noisy(0.002, np.random.default_rng(1), pixels=pixels)
    fitted = WaveformFit(measured(data), lambda values: closed_form(values, pixels=pixels), TRUTH).run()
    figure = plot_fit(fitted)
    upper, lower = figure.axes
    assert [text.get_text() for text in upper.get_legend().get_texts()] == list(pixels)
    drawn = [line.get_ydata() for line in upper.lines if line.get_linestyle() == "-" and len(line.get_ydata()) == 160]
    np.testing.assert_array_equal(drawn, fitted["fitted"])
    points = [line.get_ydata() for line in lower.lines[:2]]
    np.testing.assert_array_equal(points, fitted["residual"])
    assert "attenuation 0." in figure.get_suptitle()
    assert upper.get_ylabel() == "waveform (W)"
