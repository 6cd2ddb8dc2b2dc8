"""All integrators: changes of loaded scenes, refused derivatives, and release of scenes from memory."""

import gc

import drjit as dr
import mitsuba as mi
import numpy as np
import pytest
from rows import each_case, must_refuse

import mitransient_lidar
from mitransient_lidar.core.errors import UserError
from mitransient_lidar.transport.daylight.renderer import DaylightScene
from mitransient_lidar.transport.scene import LidarScene

FEW = {"paths_per_pass": 1024}
INTEGRATORS = {"lidar_volpath": FEW, "lidar_merging": {**FEW, "photons_per_pass": 1024}}


def scene_with(lidar_scene, name, depth=8.0):
    automatic = {"time_start_ns": "auto", "bin_count": "auto"}
    return lidar_scene(integrator={"type": name, **INTEGRATORS[name]}, film=automatic, bottom=depth)


@each_case(pytest.param("lidar_volpath", marks=pytest.mark.slow), pytest.param("lidar_merging", marks=pytest.mark.long))
def test_an_edited_scene_is_laid_out_anew(name, lidar_scene):
    """A bottom moved from 8 m to 30 m gives the record of a scene that was built with it at 30 m, in every bit."""
    scene = scene_with(lidar_scene, name)
    before = np.array(mi.render(scene, seed=1))
    parameters = mi.traverse(scene)
    parameters["bottom.to_world"] = mi.ScalarTransform4f().translate([0, 0, -30]).scale(500)
    parameters.update()
    after = np.array(mi.render(scene, seed=1))
    np.testing.assert_array_equal(after, mi.render(scene_with(lidar_scene, name, 30.0), seed=1))
    assert after.shape[1] > 2 * before.shape[1]


def sea_after(lidar_scene, name, change, rendered):
    """Return a parameter of the sea that is changed before or after a scene is prepared, as a prepared scene has it."""
    scene = lidar_scene(sea={"spectrum": "elfouhaily", "slope_variance": "cox_munk", "cell_size": 0.5})
    if rendered:
        scene.integrator().prepare(scene, scene.sensors()[0])
    parameters = mi.traverse(scene)
    parameters[f"sea.{name}"] = change(parameters[f"sea.{name}"])
    parameters.update()
    scene.integrator().prepare(scene, scene.sensors()[0])
    return np.array(mi.traverse(scene)[f"sea.{name}"])


def test_edits_of_the_sea_act_before_the_first_render_too(lidar_scene):
    """The first render chooses the automatic mesh and its ripples, and edits before it were lost without a word."""
    found = [sea_after(lidar_scene, "bsdf.alpha_u.value", lambda _: 0.3, late) for late in (False, True)]
    assert found[0] == found[1] == np.float32(0.3)
    with pytest.raises(UserError, match="'sea': vertex_positions was changed before the mesh was fitted"):
        sea_after(lidar_scene, "vertex_positions", lambda value: value + 1, False)
    assert sea_after(lidar_scene, "vertex_positions", lambda value: value * 0 + 1, True).max() == 1


@pytest.mark.parametrize("bsdf", [None, {"type": "dielectric"}, {"type": "gram_charlier_dielectric", "int_ior": 1.4}])
def test_the_sea_has_the_index_of_its_water(lidar_scene, bsdf):
    """Light was bent by the index of the surface, and timed and connected by that of the water."""
    scene = lidar_scene(sea={} if bsdf is None else {"bsdf": bsdf})
    if bsdf is None:
        parameters = mi.traverse(scene)
        parameters["sea.bsdf.eta"] = 1.5
        parameters.update()
    with pytest.raises(UserError, match=r"'sea': its bsdf has the index eta = 1\.[45]\d*, and the water .* = 1\.34"):
        scene.integrator().prepare(scene, scene.sensors()[0])


def test_seeds_and_numbers_of_paths_are_checked(lidar_scene):
    scene = lidar_scene()
    for wrong in ({"seed": -1}, {"seed": 2**64}, {"spp": -5}):
        with pytest.raises(UserError, match=f"{next(iter(wrong))} = {next(iter(wrong.values()))} must lie between 0"):
            scene.integrator().render(scene, **wrong)
    # Mitsuba wraps what its integrators raise.
    with pytest.raises(RuntimeError) as found:
        mi.render(scene, spp=-5)
    assert "spp = -5 must lie between 0" in str(found.value.__cause__)


@pytest.mark.slow
@pytest.mark.parametrize("name", INTEGRATORS)
def test_gradients_are_refused(lidar_scene, name):
    scene = scene_with(lidar_scene, name)
    must_refuse(f"{name} passes no gradients", lambda: scene.integrator().render_forward(scene, None))
    parameters = mi.traverse(scene)
    key = "bottom.bsdf.reflectance.value"
    dr.enable_grad(parameters[key])
    parameters.update()
    energy = dr.sum(mi.render(scene, parameters, seed=1), axis=None)
    must_refuse(f"{name} passes no gradients", dr.backward, energy)


def living():
    gc.collect()
    return sum(isinstance(one, LidarScene | DaylightScene) for one in gc.get_objects())


@pytest.mark.slow
def test_refused_and_finished_renders_keep_no_scene():
    """Scenes that stay in memory are part of every later kernel."""
    before = living()
    options = {"integrator": {"type": "lidar_volpath", **FEW}, "passes": 2}
    for params in ({}, {"bin_count": 1}, {"bottom_depth": 0.1}):
        try:
            mitransient_lidar.render("table1", params=params, **options)
        except UserError:
            assert params
    assert living() == before
