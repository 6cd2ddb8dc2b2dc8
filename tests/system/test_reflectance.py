"""Reflectances of a bottom estimated from rendered shots of many receivers and beams, within their stated errors."""

import math

import numpy as np
import pytest
import xarray as xr
from rows import each_case
from significance import largest_z

import mitransient_lidar
from mitransient_lidar.analysis.retrieval import retrieve
from mitransient_lidar.physics.water.water_types import water_of

RHO = 0.15
LEVEL = xr.Dataset({"slope_along": 0.0, "slope_across": 0.0, "surface_range": 200 / math.cos(math.radians(20))})
PENCIL = {"divergence_mrad": 1.0}
OFF_AXIS = {
    name: {
        **{"type": "pixel_fov", "pixel_name": name, "shape": "rectangle", "width_mrad": 8.0, "height_mrad": 8.0},
        **{"angle_x_mrad": 6.0 + x, "angle_y_mrad": 3.0 + y},
    }
    for name, x, y in (("a", 4.0, -4.0), ("b", 4.0, 4.0), ("c", -4.0, -4.0), ("d", -4.0, 4.0))
}


@pytest.fixture
def shot(lidar_scene):
    """Function that renders a shot of the table system through ripples of 3 m/s over a bottom of 0.15 at 8 m."""

    def render(tx=None, rx=None, water=None):
        scene = lidar_scene(
            integrator={"type": "lidar_merging", "paths_per_pass": 2**15, "photons_per_pass": 2**14},
            tx=tx,
            rx=rx,
            water=water or {"attenuation": 0.3, "scattering": 0.15, "backscattering": 0.006},
            sea={"slope_variance": "cox_munk", "wind_speed": 3.0},
            film={"time_start_ns": "auto", "bin_count": "auto"},
            rho=RHO,
        )
        return mitransient_lidar.render(scene, passes=4, seed=1)

    return render


@pytest.mark.slow
@each_case(
    pytest.param({}, {}, id="quarters", marks=pytest.mark.long),
    # Hexagons with gaps are obscured, too.
    pytest.param({}, {"obscuration": 0.3}, id="obscured", marks=pytest.mark.long),
    pytest.param({}, {"fill_factor": 0.5}, id="gaps", marks=pytest.mark.long),
    pytest.param({}, {"layout": "hex7"}, id="hexagons", marks=pytest.mark.long),
    pytest.param({}, {"layout": "hex19", "fill_factor": 0.5, "obscuration": 0.3}, id="hexagons with gaps"),
    pytest.param({}, OFF_AXIS, id="off axis", marks=pytest.mark.long),
    pytest.param(
        {"divergence_mrad": 16.0, "divergence_across_mrad": 4.0, "ellipse_deg": 30.0},
        {"field_of_view_mrad": 20.0},
        id="ellipse",
        marks=pytest.mark.long,
    ),
    pytest.param({"beam_profile": "top_hat"}, {}, id="top hat", marks=pytest.mark.long),
    pytest.param({"beam_profile": "top_hat"}, {"field_of_view_mrad": 8.0}, id="narrow", marks=pytest.mark.long),
)
def test_reflectance_within_its_error(tx, rx, shot):
    """Within one stated error, a sixth to a fifth of the reflectance.

    It is mostly that of the method. Of a whole aperture the second would be 0.096, without gaps the third 0.058,
    and with a Gaussian beam in the middle of the view that off axis 0.072.
    """
    found = retrieve.bottom(shot(tx, rx), LEVEL).sel(correction="level")
    value, error = float(found["reflectance"]), float(found["reflectance_stderr"])
    assert error < 0.25 * RHO
    assert abs(value - RHO) < error, (value, error)


@pytest.mark.slow
@pytest.mark.parametrize("jerlov", [pytest.param("1C", marks=pytest.mark.long), "5C"])
def test_forward_scattering_leaves_no_bias(jerlov, shot):
    """Limits are biases, and chance by the spreads from seed to seed, both measured in eight shots of 5C.

    If the light of the bottom decayed as that of the column does, 5C would have 0.11, 27 % less.
    """
    seen = shot(water={"jerlov": jerlov})
    found, water, true = retrieve.bottom(seen, LEVEL), retrieve.water(seen), water_of("jerlov", jerlov)
    z = largest_z(10**6, 5)
    np.testing.assert_allclose(found["reflectance"], RHO, rtol=0.01 + 0.042 * z)
    assert (found["reflectance_stderr"] < 0.2 * found["reflectance"]).all()
    assert float(water["absorption"]) == pytest.approx(true.absorption, rel=0.01 + 0.0145 * z)
    assert float(water["backscattering"]) == pytest.approx(true.backscattering, rel=0.035 + 0.02 * z)


@pytest.mark.long
@each_case(
    (30.0, {"attenuation": "0.9, 0.5", "scattering": "0.45, 0.25", "backscattering": "0.018, 0.010"}),
    pytest.param(
        10.0,
        {"attenuation": "0.6, 0.3", "scattering": "0.4, 0.15", "backscattering": "0.012, 0.006"},
        marks=pytest.mark.long,
    ),
)
def test_two_layers_leave_no_class_that_looks_sure(field_of_view, water, shot):
    """The exponential of the upper layer, continued to the bottom, would give 0.3 to 0.8 for 0.15."""
    seen = shot(PENCIL, {"field_of_view_mrad": field_of_view}, {"layer_tops": "0, 3", **water})
    found = retrieve.bottom(seen, LEVEL)
    value, error = (found[name].values for name in ("reflectance", "reflectance_stderr"))
    assert np.all(np.isnan(value) | (np.abs(value - RHO) < 1.5 * error)), (value, error)
    assert bool(found["reflectance_flags"] != 0) == np.isnan(value).all()
    assert not (found["class_probability"] > 0.95).any()
