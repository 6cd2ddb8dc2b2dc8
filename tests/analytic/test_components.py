"""Light by origin, by order of scattering and by turns: parts, whole and closed forms."""

import numpy as np
import pytest
from oracles.beam_average import echo_energies
from oracles.phase import henyey_greenstein
from significance import largest_z

import mitransient_lidar
from mitransient_lidar import results
from mitransient_lidar.core.errors import UserError
from mitransient_lidar.physics.lidar.level_sea import LidarSystem
from mitransient_lidar.physics.water.layers import WaterColumn
from mitransient_lidar.rendering.render import render_again
from mitransient_lidar.studies.light_classes import scattering
from mitransient_lidar.transport.paths.passes import PathClasses

INTEGRATORS = ["lidar_merging", "lidar_volpath"]
ORIGINS = ["surface", "water", "target", "bottom"]
#: Few paths, for what holds to the bit.
FEW = {"type": "lidar_merging", "paths_per_pass": 2**12, "photons_per_pass": 2**12}


@pytest.fixture(scope="module")
def parts():
    return mitransient_lidar.render("fig13_2x2", passes=2, seed=5, integrator=FEW, components=True)


@pytest.mark.slow
@pytest.mark.parametrize("name", ["impulse_response", "waveform"])
def test_parts_sum_to_the_whole_to_the_bit(parts, name):
    assert parts["origin"].values.tolist() == ORIGINS
    assert parts[f"{name}_by_origin"].dims == ("origin", "pixel", "time")
    np.testing.assert_array_equal(parts[f"{name}_by_origin"].sum("origin"), parts[name])
    assert (parts[f"{name}_by_origin_stderr"].max(("pixel", "time")) > 0).all()


@pytest.mark.slow
def test_whole_is_that_without_components(parts):
    whole = mitransient_lidar.render("fig13_2x2", passes=2, seed=5, integrator=FEW)
    for name in ("impulse_response", "impulse_response_stderr", "waveform", "waveform_stderr"):
        np.testing.assert_allclose(parts[name], whole[name], rtol=1e-12, atol=1e-12 * float(whole[name].max()))


@pytest.mark.slow
def test_parts_survive_a_netcdf_file_and_a_second_render(parts, tmp_path):
    results.save(parts, tmp_path / "parts.nc")
    np.testing.assert_array_equal(
        results.open(tmp_path / "parts.nc")["waveform_by_origin"], parts["waveform_by_origin"]
    )
    again = render_again(tmp_path / "parts.nc")
    np.testing.assert_array_equal(again["waveform_by_origin_stderr"], parts["waveform_by_origin_stderr"])


def test_too_many_solids_are_refused():
    with pytest.raises(UserError, match="the scene has 31 solids; allowed are at most 30"):
        PathClasses.by_origin([None] * 31)


@pytest.mark.slow
@pytest.mark.parametrize("integrator", ["lidar_volpath", pytest.param("lidar_merging", marks=pytest.mark.long)])
def test_each_part_has_its_closed_form(lidar_scene, z_score, integrator):
    """Ripples seen from above, water that scatters so little that no light is scattered twice, and a grey bottom."""
    scattering, variance, pose = 1e-4, 1e-3, {"off_nadir_deg": 0.0}
    volpath = integrator == "lidar_volpath"
    paths = {"paths_per_pass": 2**16} if volpath else {"paths_per_pass": 2**14, "photons_per_pass": 2**13}
    water = {"attenuation": 0.1, "scattering": scattering, "backscattering": 2e-6, "phase_function": "hg"}
    scene = lidar_scene(
        integrator={"type": integrator, **paths},
        tx=pose,
        rx={"layout": "1x1", **pose},
        film={"time_start_ns": 1310.0, "bin_count": 170},
        sea={"slope_variance": str(variance)},
        water={**water, "phase_g": 0.6},
    )
    renderer = scene.integrator().prepare(scene, scene.sensors()[0]).by_origin()
    count = 16
    passes = [renderer.render_pass(seed).histogram.energy().sum(axis=-1) for seed in range(count)]
    column = WaterColumn.from_text(0, 0.1, scattering, 0)
    backward = float(henyey_greenstein(np.pi, 0.6))
    lidar = LidarSystem(200.0, 0.0, 1.34, 1.34, energy=5e-3 * 0.81 * 0.9, aperture_area=0.025)
    half = 15e-3
    echo = echo_energies(
        lidar, 5e-3, column, backward, 8.0, 0.1, (variance / 2, variance / 2), lambda x, y: x**2 + y**2 <= half**2
    )
    z, error = z_score(np.array(passes), np.array([echo.surface, echo.column, echo.bottom]))
    # The path tracer scatters one path in a thousand.
    limits = np.array([0.002, 0.15, 0.004] if volpath else [0.004, 0.008, 0.008])
    assert np.all(error < limits), error
    # The closed form neglects that ripples bend light.
    assert np.all(np.abs(z) * error < largest_z(count, 3) * error + 1e-3), (z, error)


PARAMS = {"bin_width_ns": 2, "bin_count": 75, "surface_size": 200}
FEW_PATHS = {"type": "lidar_merging", "paths_per_pass": 2**13, "photons_per_pass": 2**13}


@pytest.fixture(scope="module")
def orders():
    return scattering("fig09_2x2", PARAMS, orders=3, passes=2, seed=4, integrator=FEW_PATHS)


@pytest.mark.long
def test_orders_sum_to_the_whole(orders):
    """The classes split the same paths: same seed, same energy in every bin but for rounding of the sums."""
    whole = mitransient_lidar.render("fig09_2x2", params=PARAMS, passes=2, seed=4, integrator=FEW_PATHS)
    total = orders["impulse_response"].sum(("reversals", "order")).values
    np.testing.assert_allclose(total, whole["impulse_response"].values, rtol=1e-6, atol=1e-6 * total.max())


@pytest.mark.slow
def test_unscattered_light_is_reversed_once(orders):
    direct = orders["impulse_response"].sel(order=0).sum(("pixel", "time"))
    assert direct.sel(reversals="several") < 1e-3 * direct.sel(reversals="one")


VOLPATH = {"type": "lidar_volpath", "paths_per_pass": 2**13}


@pytest.mark.slow
def test_single_scattering_is_that_of_paths_with_one_event(lidar_scene, passes):
    """`lidar_volpath` with max_scatterings stops the paths instead of sorting them."""
    one = {"layout": "1x1"}
    scene = lidar_scene(integrator=VOLPATH, rx=one)
    renderer = scene.integrator().prepare(scene, scene.sensors()[0], classes=PathClasses(3))
    sorted_energy = np.array([renderer.render_pass(seed).histogram.energy() for seed in range(2)]).reshape(2, 2, 4, -1)
    for most in (0, 1, 2):
        limited = passes(lidar_scene(integrator={**VOLPATH, "max_scatterings": most}, rx=one), 2)[:, 0]
        kept = sorted_energy[:, :, : most + 1].sum(axis=(1, 2))
        np.testing.assert_allclose(kept.sum(axis=1), limited.sum(axis=1), rtol=1e-6)
