"""Central differences: steps, refused parameters, and the scene that stays as it is."""

import mitsuba as mi
import numpy as np
import pytest
from rows import each_row, refuses

from mitransient_lidar.loading.scenes import choose_integrator, open_scene
from mitransient_lidar.physics.lidar.gate_train import GateTrain
from mitransient_lidar.rendering.derivatives import Differences, default_step

FEW = {"type": "lidar_merging", "paths_per_pass": 1024, "photons_per_pass": 1024}


@pytest.fixture(scope="module")
def level():
    """A level sea, and an integrator of few paths."""
    session = open_scene("fig15_2x2", {"spectrum": "flat", "surface_size": 1000})
    return session, choose_integrator(session.scene, FEW)


@pytest.mark.slow
def test_a_pass_is_the_difference_of_two_renders(level):
    """The energy of a pulse multiplies all light, so that its derivative is the record over the energy."""
    session, integrator = level
    found = Differences(session, integrator, ["pulse_energy_mj", "pulse_fwhm_ns"], steps={"pulse_energy_mj": 1.0})
    train = GateTrain(1430.0, 8.0, 5.0, 6)
    found.cut(train)
    found.add_pass(3)
    renderer = integrator.prepare(session.scene, session.sensor)
    energy = renderer.for_differences().render_pass(3).histogram.energy()
    quantum = np.abs(energy).max() * 1e-6
    assert found.light.energy.mean[0] == pytest.approx(energy / 5.0, rel=1e-4, abs=quantum)
    # The width of the pulse moves power in time, and no energy between ideal echoes.
    assert not found.light.energy.mean[1].any()
    assert found.light.power.mean[1].sum() == pytest.approx(0, abs=1e-3 * np.abs(found.light.power.mean[1]).sum())
    assert np.isnan(found.light.power.stderr).all()
    # Gates collect the power, also where a longer pulse moves it.
    axis = renderer.scene.axis
    for gate in range(train.count):
        first, weights = train.gate_bins(gate, axis.start_ns, axis.bin_width_ns, axis.bin_count)
        collected = 1e-9 * axis.bin_width_ns * found.light.power.mean[..., first : first + weights.size] @ weights
        largest = np.abs(found.gates.mean).max(axis=(1, 2))[:, None]
        assert np.all(np.abs(found.gates.mean[..., gate] - collected) < 0.01 * largest)
    found.add_pass(4, share=0.5)
    assert np.isfinite(found.light.power.stderr).all()


@each_row(
    ("bottom_depth", 2 * 1.34 / 0.299792458),
    ("altitude", 2 / 0.299792458),
    # Edges of layers by a tenth.
    ("layer_tops[1]", 1.34 / 0.299792458),
)
def test_steps_of_depths_shift_echoes_by_a_twentieth_of_the_pulse(name, shift_ns, level):
    session, integrator = level
    renderer = integrator.prepare(session.scene, session.sensor)
    assert default_step(name, 8.0, renderer) * shift_ns == pytest.approx(0.05 * 5.0)


def test_steps_off_nadir_shift_the_surface_as_much(level):
    session, integrator = level
    renderer = integrator.prepare(session.scene, session.sensor)
    step = np.deg2rad(default_step("off_nadir_deg", 20.0, renderer))
    ways = 200 / np.cos(np.deg2rad(20) + np.array([0, step]))
    assert np.diff(ways)[0] * 2 / 0.299792458 == pytest.approx(0.05 * 5.0, rel=2e-3)
    # At nadir the range does not depend on the angle.
    assert default_step("off_nadir_deg", 0.0, renderer) == 0.5


@each_row(
    ("divergence_mrad", 10, 1.0), ("target_x", 0, 0.05), ("attenuation[1]", 0.5, 0.005), ("wind_direction_deg", 0, 0.5)
)
def test_steps_of_others(name, value, step, level):
    session, integrator = level
    assert default_step(name, value, integrator.prepare(session.scene, session.sensor)) == pytest.approx(step)


@refuses(
    (["botom_depth"], {}, "'botom_depth' is not one of the scene: did you mean bottom_depth"),
    (["layout"], {}, "layout = '2x2' is not a number"),
    (["bin_width_ns"], {}, "bin_width_ns = 1 belongs to the record"),
    (["bottom_depth"], {"bottom_depth": 0.0}, "step of bottom_depth = 0 must be greater than 0"),
    (["bottom_depth"], {"bottom_depth": 7.0}, "bottom_depth = 8 needs values 7 below and above, and layer_tops ="),
)
def test_refused_parameters_and_steps(names, steps, level):
    Differences(*level, names, steps=steps)


def test_the_sea_of_a_changed_scene_has_the_same_cells_and_waves():
    session = open_scene("table1", {"surface_size": 1000})

    def vertices(scene):
        mesh = next(shape for shape in scene.shapes() if shape.is_medium_transition())
        return np.array(mesh.vertex_positions_buffer())

    own, same = (
        open_scene(session.source, {"divergence_mrad": 20}, model=model).scene for model in (None, session.scene)
    )
    assert np.array_equal(vertices(same), vertices(session.scene))
    assert not np.array_equal(vertices(own), vertices(session.scene))


def test_the_cells_of_a_changed_scene_are_the_same_and_know_its_solids():
    """The sphere has parts above each other, which patches tell apart by the shape itself."""
    session = open_scene("fig02_mine", {"spectrum": "flat", "surface_size": 1000})
    integrator = choose_integrator(session.scene, FEW)
    base = integrator.prepare(session.scene, session.sensor)
    moved = open_scene(session.source, {"target_depth": 8.9}, model=session.scene)
    renderer = integrator.prepare(moved.scene, moved.sensor, layout_of=base)
    layout = renderer.layout
    shift, points = (
        mi.Point4f(0.3, 0.7, 0.2, 0.6),
        mi.Point3f(mi.Float(0, 1, -2), mi.Float(0, 2, 1), mi.Float(-1, -5, -8)),
    )
    own, same = (one.cells.of_pass(shift).locate(points) for one in (base.layout, layout))
    assert np.array_equal(own.bucket, same.bucket)
    assert np.array_equal(own.volume, same.volume)
    assert (
        [shape.id() for shape in layout.patches.uneven]
        == [shape.id() for shape in base.layout.patches.uneven]
        == ["target"]
    )
    assert layout.patches.uneven[0] in moved.scene.shapes()


def test_cells_go_with_the_surfaces_and_the_beam_that_is_refracted():
    """A mean slope along the beam turns it by the angles of Snell's law about the normal of the inclined sea.

    Cells begin at the inclined sea and end at the bottom that has moved: in others, the derivative by the slope of the
    sea was up to 8 % too small in the first 10 ns of one pixel of `table1` and 18 % too large in the next.
    """
    session = open_scene("table1", {"spectrum": "flat", "surface_size": 1000})
    integrator = choose_integrator(session.scene, FEW)
    base = integrator.prepare(session.scene, session.sensor)
    moved = open_scene(session.source, {"surface_slope_x_deg": 2, "bottom_depth": 8.5}, model=session.scene)
    cells = integrator.prepare(moved.scene, moved.sensor, layout_of=base).layout.cells
    rings, x, y = cells.rings, mi.Float(-1.5, 0.2, 2), mi.Float(0.5, 0, -1)
    height, slope = cells.heights.surface_at(x, y)
    assert np.array(height) == pytest.approx(np.tan(np.deg2rad(2)) * np.array(x), abs=1e-4)
    assert np.array(slope.x) == pytest.approx(np.full(3, np.tan(np.deg2rad(2))), abs=1e-4)
    assert np.array(cells.heights.bed_at(x, y)) == pytest.approx(np.full(3, -8.5), abs=1e-4)
    tilt = np.deg2rad(2)
    # The normal turns towards the lidar, which is at -x.
    in_water = np.arcsin(np.sin(np.deg2rad(20) - tilt) / 1.34) + tilt
    wanted = np.tan(in_water), np.tan(np.arcsin(np.sin(np.deg2rad(20)) / 1.34))
    for layout, shear in zip((rings, base.layout.cells.rings), wanted, strict=True):
        assert [float(each[0]) for each in layout.shear] == pytest.approx([shear, 0], abs=1e-6)
        # On the axis 6 m below the point where the beam meets the sea.
        assert [float(each[0]) for each in layout.offset(mi.Float(6 * shear), mi.Float(0), mi.Float(6))] == (
            pytest.approx([0, 0], abs=2e-3)
        )
