"""Surface echo of seas: the closed form for ripples on facets, whatever the mesh resolves."""

import mitsuba as mi
import numpy as np
import pytest
from oracles.beam_average import echo_energies
from oracles.two_scale import two_scale_ratio
from rows import each_case
from significance import largest_z

from mitransient_lidar.physics.lidar.level_sea import LidarSystem
from mitransient_lidar.physics.water.layers import WaterColumn

#: So high that one shot takes in a patch of 40 m: the mean over seas needs fewer of them.
HEIGHT = 2000.0
SEAS = 10


def surface_echoes(wind, angle, wave):
    """Return the received surface echoes [J] of some seas, and the variances of facets and ripples."""
    lidar = {"altitude": HEIGHT, "off_nadir_deg": angle}
    film = {"type": "time_gated_film", "time_start_ns": 12000.0, "bin_width_ns": 6000.0, "bin_count": 1}
    energies = []
    for seed in range(SEAS):
        sea = {"type": "ocean_surface", "wind_speed": wind, "cell_size": 0.25, "shortest_wave": wave}
        sea |= {"refined_size": 96.0, "surface_seed": seed}
        scene = mi.load_dict(
            {
                "type": "scene",
                "integrator": {"type": "lidar_volpath", "max_scatterings": 0, "paths_per_pass": 2**14},
                "tx": {"type": "lidar_transmitter", **lidar},
                "rx": {"type": "multipixel_receiver", **lidar, "field_of_view_mrad": 80.0, "layout": "1x1", "f": film},
                "sea": {**sea, "size": 400.0, "interior": {"type": "layered_water"}},
            }
        )
        energies.append(float(np.sum(mi.render(scene, seed=seed))))
    (surface,) = (shape.sea for shape in scene.shapes() if hasattr(shape, "sea"))
    return np.array(energies), surface.resolved_variance, surface.ripple_variance


@each_case(
    pytest.param(6.0, 20.0, marks=pytest.mark.slow),
    *(
        pytest.param(wind, angle, marks=pytest.mark.long)
        for wind, angle in ((3.0, 0.0), (3.0, 10.0), (3.0, 20.0), (6.0, 0.0), (10.0, 0.0), (10.0, 20.0))
    ),
)
def test_mean_surface_echo_is_that_of_the_slopes_that_the_sea_states(wind, angle):
    """Within 5 % of Gaussian slopes but in the tail at light wind, where ripples on facets are 20 % brighter.

    The same seas with waves of half the length have the same echo: slopes move from the ripples to the facets, and none
    is counted twice.
    """
    lidar = LidarSystem(HEIGHT, np.radians(angle), 1.34, 1.34, energy=5e-3 * 0.81 * 0.9, aperture_area=0.025)
    water = WaterColumn.from_text(0.0, 0.3, 0.15, 0.006)
    means = []
    for wave in (1.5, 0.75):
        energy, facets, ripples = surface_echoes(wind, angle, wave)
        total = tuple(np.add(facets, ripples))
        gaussian = echo_energies(lidar, 5e-3, water, 1e-3, 8.0, 0.1, total).surface
        ratio, error = energy.mean() / gaussian, energy.std(ddof=1) / np.sqrt(SEAS) / gaussian
        expected = two_scale_ratio(facets, ripples, np.radians(angle))
        # Averaging the ratio over the beam of 5 mrad and masking change it by a percent.
        assert abs(ratio - expected) < largest_z(SEAS) * error + 0.015, (ratio, expected, error)
        if not (wind == 3.0 and angle == 20.0):
            assert abs(ratio - 1) < 0.05 + largest_z(SEAS) * error
        means.append(energy)
    change = (means[1] - means[0]) / means[0].mean()
    assert abs(change.mean()) < 0.02 + largest_z(SEAS) * change.std(ddof=1) / np.sqrt(SEAS)
