"""Figure of a sweep of the field of view: measured attenuation, limits and fit."""

import numpy as np
import pytest
import xarray as xr

from mitransient_lidar.plots.studies.fov_sweep import plot_fov_sweep

C, KD, A = 0.3, 0.17, 0.15


@pytest.mark.slow
def test_attenuation_lies_between_its_limits():
    fields = np.array([2.0, 10.0, 50.0])
    radius = 0.1 * fields  # 200 m from the surface
    k, error = np.array([0.28, 0.22, 0.18]), np.full(3, 0.005)
    found = xr.Dataset(
        {
            "effective_attenuation": ("field_of_view", k),
            "effective_attenuation_stderr": ("field_of_view", error),
            "scaled_radius": ("field_of_view", C * radius),
        },
        {"field_of_view": fields},
        {
            "scene": "made",
            "attenuation": C,
            "kd": KD,
            "a_plus_bb": 0.156,
            "absorption": A,
            "beam_radius": 1.0,
            "min_depth": 1.0,
            "max_depth": 5.0,
        },
    )
    figure = plot_fov_sweep(found)
    ax = figure.axes[0]
    labels = [text.get_text() for text in ax.get_legend().get_texts()]
    assert labels[:4] == ["c = 0.300 /m", "Kd = 0.170 /m", "a + bb = 0.156 /m", "a = 0.150 /m"]
    assert [line.get_ydata()[0] for line in ax.lines[:4]] == [C, KD, 0.156, A]
    scaled, fit = ax.lines[4].get_data()
    # D is twice the hypotenuse of the radii of field of view and beam.
    diameter = 2 * np.hypot(scaled / C, 1.0)
    np.testing.assert_allclose(fit, KD + (C - KD) * np.exp(-0.85 * C * diameter))
    (container,) = ax.containers
    line, _, (bars,) = container.lines
    np.testing.assert_allclose(line.get_data(), [C * radius, k])
    assert [np.ptp(segment[:, 1]) for segment in bars.get_segments()] == pytest.approx(2 * error)
    assert (ax.get_xscale(), ax.get_ylabel()) == ("log", "attenuation coefficient (1/m)")
    # The axis on top reads the field of view: 10 mrad at c R = 0.3.
    (top,) = ax.child_axes
    figure.draw_without_rendering()
    assert np.array(top.get_xlim()) == pytest.approx(np.array(ax.get_xlim()) * 10 / 0.3)
    assert top.get_xlabel() == "field of view (mrad)"
    assert [text.get_text().strip() for text in ax.texts] == ["c R$_b$ of the beam"]
    assert figure.get_suptitle() == "made: slope of the column signal from 1 to 5 m, b/c = 0.5"
