"""Spread of the light at depth: what it refuses, what comes out, the figure and the command."""

import mitsuba as mi
import numpy as np
import pytest
from rows import refuses
from significance import largest_z

from mitransient_lidar.studies.light_classes import scattering

QUICK = {"passes": 2, "photons": 4096}


@refuses(
    ({}, {"depths": [3, 8.5]}, "depths = 8.5 m must not lie below the bottom, at 8 m"),
    ({}, {"params": {"bottom_depth": 3}}, "params = ['bottom_depth'] need an XML scene"),
    ({"without": ("sea", "bottom")}, {}, "the scene has no water: give its surface a layered_water"),
    ({"without": ("rx",)}, {}, "sensor: the scene has none"),
)
def test_what_is_refused(change, options, lidar_scene):
    receiver = {"type": "multipixel_receiver", "film": {"type": "time_gated_film"}}
    dry = {"tx": {"type": "lidar_transmitter"}, "rx": receiver, "plate": {"type": "rectangle"}}
    given = {name: part for name, part in dry.items() if name not in change["without"]} if change else lidar_scene()
    scattering(given, **{"depths": 2.0, **QUICK, **options})


@pytest.mark.slow
def test_only_what_is_wider_than_the_beam_is_a_bottom(lidar_scene):
    plate = {"type": "rectangle", "to_world": mi.ScalarTransform4f().translate([2, 0, -4]).scale(0.75)}
    scene = lidar_scene(bottom=None, extra={"target": plate})
    found = scattering(scene, depths=6.0, **QUICK)
    without = scattering(lidar_scene(bottom=None), depths=6.0, **QUICK)
    assert 0.1 < float(found["transmitted"].item()) < 0.9 * float(without["transmitted"].item())


@pytest.mark.slow
def test_result():
    spread = scattering("fig09_1x1", {"bottom_depth": 8}, depths=[8, 2.0, 2.0], **QUICK)
    assert spread["depth"].values.tolist() == [2, 8]
    for name, values in spread.data_vars.items():
        assert values.attrs["units"] in ("1", "m", "ns")
        assert np.isfinite(values).all(), name
        if not name.endswith("_stderr"):
            assert (spread[f"{name}_stderr"] > 0).any(), name
    for name in ("within_radius", "within_shift", "within_delay"):
        assert (np.diff(spread[name].values, axis=1) >= 0).all()
        assert (spread[name].values[:, -1] > 0.99).all()
    assert (spread["radius_50"] < spread["radius_90"]).all()
    # Down the slant, 14.788 degrees in the water, through the sea's transmittance of 0.9787; waves change them little.
    slant = np.array([2, 8]) / np.cos(np.radians(14.788))
    np.testing.assert_allclose(spread["unscattered"], 0.9787 * np.exp(-0.3 * slant), rtol=0.05)
    np.testing.assert_allclose(spread["centroid_x"], slant * np.sin(np.radians(14.788)), atol=0.15)
    wanted = {"scene": "fig09_1x1", "seed": 0, "passes": 2, "photons_per_pass": 4096, "scene.bottom_depth": "8"}
    assert wanted.items() <= spread.attrs.items()
    assert spread.attrs["uniform_down_to"] == np.inf


@pytest.mark.slow
@pytest.mark.parametrize("off_nadir", [0.0, 30.0])
def test_share_in_view(lidar_scene, off_nadir):
    # Receiver and laser at one point, no scattering, no ripples to speak of: at every depth the view holds of the
    # Gaussian beam what it holds of it in the air, 1 - exp(-r^2/2) within r standard deviations.
    pose = {"off_nadir_deg": off_nadir}
    scene = lidar_scene(
        tx={**pose, "divergence_mrad": 10.0},
        rx={**pose, "field_of_view_mrad": 12.0, "layout": "2x2"},
        sea={"slope_variance": "2e-5"},
        water={"attenuation": 0.1, "scattering": 0.0, "backscattering": 0.0},
    )
    found = scattering(scene, depths=[1.0, 7.0], passes=4, photons=2**14)
    # Photons count as if they were drawn one by one; 0.2 % for the ripples.
    share = 1 - np.exp(-0.5 * 1.2**2)
    error = np.sqrt(share * (1 - share) / (4 * 2**14))
    assert np.abs(found["in_view"] - share).max() < 0.002 + largest_z(10**6, 2) * error
    # Light that is not scattered is neither shifted nor late.
    assert not found["shift_rms"].any()
    assert not found["delay_mean"].any()
    np.testing.assert_allclose(found["transmitted"], found["unscattered"])


def test_beam_outside_the_surface_is_reported(lidar_scene, caplog):
    scene = lidar_scene(sea={"spectrum": "flat", "size": 2.0}, bottom=4.0)
    found = scattering(scene, depths=2.0, **QUICK)
    # Standard deviations of the footprint are 1.064 m across and 1.132 m along, erf(1/(sqrt(2) sigma)) in the patch.
    assert found.attrs["beam_outside_surface"] == pytest.approx(1 - 0.6526 * 0.6230, abs=0.01)
    assert "passes outside it and is left out" in caplog.text
