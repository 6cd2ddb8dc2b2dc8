"""Solids without effect, instances, and rays through boxes."""

import mitsuba as mi
import numpy as np
import pytest
import significance
from rows import each_row, must_refuse

from mitransient_lidar.transport.probe import first_along
from mitransient_lidar.transport.scene_parts import find_lidar_scene
from mitransient_lidar.transport.solids import box_rays

CHECKS = {"type": "checkerboard", "color0": 0.0, "color1": 1.0}
MATCHED = {"int_ior": 1.34, "ext_ior": 1.34}
UNSEEN = {
    "null": {"type": "null"},
    "open_mask": {"type": "mask", "opacity": 0.0, "nested": {"type": "diffuse"}},
    "matched": {"type": "dielectric", **MATCHED},
    "matched_plate": {"type": "thindielectric", **MATCHED},
    "mixture": {"type": "blendbsdf", "weight": 0.5, "a": {"type": "null"}, "b": {"type": "null"}},
}
SEEN = {
    "mask": {"type": "mask", "opacity": 0.5, "nested": {"type": "diffuse"}},
    "pattern": {"type": "mask", "opacity": CHECKS, "nested": {"type": "diffuse"}},
    "glass": {"type": "dielectric"},
    "filter": {"type": "dielectric", **MATCHED, "specular_transmittance": 0.5},
}


def plates(bsdfs):
    """Return a plate of each BSDF, 0.5 m below each other, half in the beam."""
    places = (mi.ScalarTransform4f().translate([0.8, 0, -0.5 * (n + 1)]).scale(0.8) for n in range(len(bsdfs)))
    return {name: {"type": "rectangle", "to_world": next(places), "bsdf": bsdf} for name, bsdf in bsdfs.items()}


def test_solids_without_effect_are_left_out(lidar_scene):
    scene = lidar_scene(extra=plates(UNSEEN | SEEN))
    found = find_lidar_scene(scene, scene.sensors()[0])
    assert {solid.id() for solid in found.solids} == {*SEEN, "bottom"}
    assert len(scene.shapes()) == len(UNSEEN) + len(SEEN) + 2


@pytest.mark.parametrize("integrator", ["lidar_volpath", pytest.param("lidar_merging", marks=pytest.mark.slow)])
def test_solids_without_effect_change_no_light(lidar_scene, passes, integrator):
    """Cells of water that end at them would add 3 % to the water, and connections that they block be missing."""
    few = {"type": integrator, "paths_per_pass": 2**12}
    plain, veiled = (passes(lidar_scene(integrator=few, extra=extra), 1) for extra in ({}, plates(UNSEEN)))
    np.testing.assert_allclose(veiled, plain, rtol=1e-5, atol=1e-6 * plain.max())


@pytest.mark.slow
@pytest.mark.parametrize("integrator", ["lidar_volpath", "lidar_merging"])
def test_panes_that_reflect_nothing_change_no_light(lidar_scene, passes, integrator):
    """Paths cross them one by one, since their index is not quite that of the water."""
    bsdf = {"type": "thindielectric", "int_ior": 1.34001, "ext_ior": 1.34}
    panes = plates({f"pane_{number}": bsdf for number in range(4)})
    engine = {"type": integrator, "paths_per_pass": 2**14}
    # After the surface echo.
    column = (
        passes(lidar_scene(integrator=engine, extra=extra), 12, 100 * len(extra))[..., 50:] for extra in ({}, panes)
    )
    plain, veiled = (energy.reshape(12, 4, -1, 11).sum(axis=(1, 3)) for energy in column)
    significance.assert_same(veiled, plain, error=0.01, known=0.1)


@pytest.mark.parametrize("integrator", ["lidar_volpath", pytest.param("lidar_merging", marks=pytest.mark.slow)])
def test_instance_returns_the_light_of_what_it_repeats(lidar_scene, integrator):
    """Of two shapes of other BSDFs; the same random numbers."""
    bright = {"type": "diffuse", "reflectance": 0.8}
    parts = {"ball": {"type": "sphere", "radius": 0.5}, "top": {"type": "disk", "bsdf": bright}}
    move = mi.ScalarTransform4f().translate([0.2, 0.1, -5])
    parts["top"]["to_world"] = mi.ScalarTransform4f().translate([0, 0, 0.6]).scale(0.3)
    alone = {
        name: {**part, "to_world": move @ part.get("to_world", mi.ScalarTransform4f())} for name, part in parts.items()
    }
    instance = {"type": "instance", "group": {"type": "ref", "id": "group"}, "to_world": move}
    instanced = {"group": {"type": "shapegroup", **parts}, "reef": instance}
    energies = []
    for extra in (alone, instanced):
        scene = lidar_scene(integrator={"type": integrator, "paths_per_pass": 2**12}, extra=extra)
        renderer = scene.integrator().prepare(scene, scene.sensors()[0]).by_origin()
        energy = renderer.render_pass(0).histogram.energy().reshape(-1, renderer.classes.count, 160).sum(axis=(0, 2))
        energies.append(dict(zip(renderer.classes.names, energy, strict=True)))
    shapes, copy = energies
    shapes["reef"] = shapes.pop("ball") + shapes.pop("top")
    assert shapes.keys() == copy.keys()
    for name, energy in shapes.items():
        assert copy[name] == pytest.approx(energy, rel=0.01), name


@each_row(
    ({"type": "bumpmap", "texture": CHECKS, "nested": {"type": "diffuse"}}, r"BumpMap cannot be used"),
    ({"type": "diffuse", "reflectance": {"type": "blackbody", "temperature": 5000.0}}, "non-spectral"),
    ({"type": "diffuse", "reflectance": {"type": "mesh_attribute", "name": "vertex_a"}}, "no attribute 'vertex_a'"),
)
def test_bsdfs_that_cannot_be_evaluated_are_refused(bsdf, told, lidar_scene):
    scene = lidar_scene(extra={"ball": {"type": "sphere", "radius": 0.1, "bsdf": bsdf}})
    must_refuse(f"shape 'ball'.*{told}", lambda: find_lidar_scene(scene, scene.sensors()[0]))


def test_rays_meet_every_side_of_a_box():
    origins, directions = box_rays(np.array([0, 0, -1.0]), np.array([1.0, 2, 0]), 4)
    assert len(origins) == 6 * 4**2
    assert (np.abs(directions).sum(axis=1) == 1).all()
    # Along a flat box they would meet edges alone.
    assert len(box_rays(np.zeros(3), np.array([1.0, 2, 0]), 4)[0]) == 2 * 4**2


def test_lines_along_edges_meet_the_mesh(lidar_scene, tmp_path):
    """Some of them pass between both faces in single precision: a flight was refused, since its bottom had a gap."""
    side = np.linspace(-500, 500, 41)
    places = [f"v {x} {y} {-8 + 0.3 * np.sin(x)}" for y in side for x in side]
    corners = [41 * row + column + 1 for row in range(40) for column in range(40)]
    faces = [f"f {a} {a + 1} {a + 42}\nf {a} {a + 42} {a + 41}" for a in corners]
    (tmp_path / "reef.obj").write_text("\n".join(places + faces))
    scene = lidar_scene(extra={"reef": {"type": "obj", "filename": str(tmp_path / "reef.obj")}})
    found = find_lidar_scene(scene, scene.sensors()[0])
    reef = [solid for solid in found.solids if solid.id() == "reef"]
    rng = np.random.default_rng(significance.seed_shift)
    x, y = rng.uniform(-400, 400, 2**17), rng.normal(scale=1e-7, size=2**17)
    start, end = (np.stack([x + aside, y, np.full_like(x, z)], axis=1) for aside, z in ((-54, 200), (3, -10)))
    assert np.isfinite(first_along(found, [start, end], reef)).all()
