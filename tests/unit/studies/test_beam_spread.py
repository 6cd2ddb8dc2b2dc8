"""Spread of the light at depth: what it refuses, what comes out, the figure and the command."""

import re

import mitsuba as mi
import numpy as np
import pytest
import xarray as xr
from command_line import run
from significance import largest_z

from mitransient_lidar.core.errors import UserError
from mitransient_lidar.plots.studies.light import plot_beam_spread
from mitransient_lidar.studies.beam_spread import beam_spread, describe_spread
from mitransient_lidar.transport.plane_crossings import CrossingTracer
from mitransient_lidar.transport.scene_parts import find_lidar_scene

QUICK = {"passes": 2, "photons": 4096}


@pytest.fixture(scope="module")
def spread():
    """Spread in a shipped scene."""
    return beam_spread("fig09_1x1", {"bottom_depth": 8}, depths=[8, 2.0, 2.0], **QUICK)


@pytest.mark.parametrize(
    ("option", "message"),
    [
        ({"depths": [3, 8.5]}, "depths = 8.5 m must not lie below the bottom, at 8 m"),
        ({"params": {"bottom_depth": 3}}, "params = ['bottom_depth'] need an XML scene"),
    ],
)
def test_options_that_are_refused(lidar_scene, option, message):
    with pytest.raises(UserError, match=re.escape(message)):
        beam_spread(lidar_scene(), **{"depths": 2.0, **QUICK, **option})


def test_scenes_that_are_refused():
    receiver = {"type": "multipixel_receiver", "film": {"type": "time_gated_film"}}
    dry = {"tx": {"type": "lidar_transmitter"}, "rx": receiver, "plate": {"type": "rectangle"}}
    with pytest.raises(UserError, match=r"^the scene has no water: give its surface a layered_water"):
        beam_spread(dry, depths=2.0, **QUICK)
    del dry["rx"]
    with pytest.raises(UserError, match=r"^sensor: the scene has none"):
        beam_spread(dry, depths=2.0, **QUICK)


@pytest.mark.slow
def test_only_what_is_wider_than_the_beam_is_a_bottom(lidar_scene):
    plate = {"type": "rectangle", "to_world": mi.ScalarTransform4f().translate([2, 0, -4]).scale(0.75)}
    scene = lidar_scene(bottom=None, extra={"target": plate})
    found = beam_spread(scene, depths=6.0, **QUICK)
    without = beam_spread(lidar_scene(bottom=None), depths=6.0, **QUICK)
    assert 0.1 < float(found["transmitted"].item()) < 0.9 * float(without["transmitted"].item())


@pytest.mark.slow
def test_result(spread):
    assert spread["depth"].values.tolist() == [2, 8]
    assert spread["transmitted"].dims == ("depth",)
    assert spread["within_shift"].dims == ("depth", "radius")
    assert spread["within_delay"].dims == ("depth", "delay")
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
    attributes = spread.attrs
    assert (attributes["scene"], attributes["seed"], attributes["passes"], attributes["photons_per_pass"]) == (
        "fig09_1x1",
        0,
        2,
        4096,
    )
    assert attributes["scene.bottom_depth"] == "8"
    assert attributes["mitsuba_version"] == mi.__version__
    assert attributes["uniform_down_to"] == np.inf


@pytest.mark.slow
def test_light_at_the_bottom_is_light_just_above_it(lidar_scene):
    found = beam_spread(lidar_scene(), depths=[7.9, 8.0], **QUICK)
    above, at = found["transmitted"].values
    assert 0.97 < at / above < 1


@pytest.mark.slow
def test_seed_decides(lidar_scene):
    scene = lidar_scene()
    first, again, other = (beam_spread(scene, depths=5.0, seed=seed, **QUICK)["shift_rms"].item() for seed in (1, 1, 2))
    assert first == pytest.approx(again, rel=1e-12)
    assert first != pytest.approx(other, rel=1e-6)


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
    found = beam_spread(scene, depths=[1.0, 7.0], passes=4, photons=2**14)
    # Photons count as if they were drawn one by one; 0.2 % for the ripples.
    share = 1 - np.exp(-0.5 * 1.2**2)
    error = np.sqrt(share * (1 - share) / (4 * 2**14))
    assert np.abs(found["in_view"] - share).max() < 0.002 + largest_z(10**6, 2) * error
    # Light that is not scattered is neither shifted nor late.
    assert not found["shift_rms"].any()
    assert not found["delay_mean"].any()
    np.testing.assert_allclose(found["transmitted"], found["unscattered"])


@pytest.mark.slow
def test_depths_without_light_are_unknown(lidar_scene):
    # A plate that is wide enough to take all light, but not the bottom.
    plate = {"type": "rectangle", "to_world": mi.ScalarTransform4f().translate([0, 0, -2]).scale(400)}
    found = beam_spread(lidar_scene(extra={"plate": plate}), depths=[1.0, 4.0], **QUICK)
    assert found["transmitted"].values[1] == 0
    assert found["transmitted"].values[0] > 0.5
    assert np.isnan(found["radius_90"].values[1])
    assert np.isnan(found["within_delay"].values[1]).all()
    assert describe_spread(found)[2].split()[-1] == "-"
    texts = [text.get_text() for text in plot_beam_spread(found).axes[0].get_legend().get_texts()]
    assert texts[1] == "4 m: no light"


def test_beam_outside_the_surface_is_reported(lidar_scene, caplog):
    scene = lidar_scene(sea={"spectrum": "flat", "size": 2.0}, bottom=4.0)
    found = beam_spread(scene, depths=2.0, **QUICK)
    # Standard deviations of the footprint are 1.064 m across and 1.132 m along, erf(1/(sqrt(2) sigma)) in the patch.
    assert found.attrs["beam_outside_surface"] == pytest.approx(1 - 0.6526 * 0.6230, abs=0.01)
    assert "passes outside it and is left out" in caplog.text


@pytest.mark.slow
def test_more_room_gives_the_same_light(lidar_scene):
    scene = lidar_scene()
    system = find_lidar_scene(scene, scene.sensors()[0])
    tracers = [CrossingTracer(system, np.array([1.0, 3.0, 7.0]), 4096) for _ in range(2)]
    tracers[1]._legs = 0.1
    lights = [tracer.trace(4, 0)[0] for tracer in tracers]
    assert len(lights[0].plane) == len(lights[1].plane) > 4096
    assert lights[0].weight.sum() == pytest.approx(lights[1].weight.sum(), rel=1e-12)


@pytest.mark.slow
def test_figure(spread, tmp_path):
    path = tmp_path / "spread.png"
    figure = plot_beam_spread(spread, path)
    assert path.read_bytes().startswith(b"\x89PNG")
    for ax, name, coordinate in zip(
        figure.axes, ("within_radius", "within_shift", "within_delay"), ("radius", "radius", "delay"), strict=True
    ):
        lines = [line for line in ax.lines if line.get_linestyle() != "None"]
        for rank, line in enumerate(lines):
            np.testing.assert_allclose(line.get_data(), [spread[coordinate], spread[name][rank]])
        assert len(lines) == 2
    dots = [line.get_data() for line in figure.axes[0].lines if line.get_marker() == "o"]
    np.testing.assert_allclose([x for x, _ in dots], np.stack([spread["radius_50"], spread["radius_90"]], axis=-1))
    texts = [text.get_text() for text in figure.axes[0].get_legend().get_texts()]
    assert texts == [
        f"{depth} m: {100 * share:.3g} % in view" for depth, share in zip((2, 8), spread["in_view"].values, strict=True)
    ]
    with pytest.raises(UserError, match="must end in"):
        plot_beam_spread(spread, tmp_path / "spread.txt")


@pytest.mark.long
def test_command(tmp_path):
    target = tmp_path / "new" / "spread.png"
    result = run(
        "beam-spread", "fig09_1x1", "--depths", "5, 2", "-D", "bottom_depth=6", "--passes", 2, "--seed", 3, "-o", target
    )
    assert result.exit_code == 0, result.output
    lines = result.stdout.splitlines()
    assert lines[:2] == [str(target), str(target.with_suffix(".nc"))]
    assert lines[2].split()[:4] == ["depth", "(m)", "passes", "(%)"]
    assert [line.split()[0] for line in lines[3:]] == ["2", "5"]
    kept = xr.load_dataset(target.with_suffix(".nc"), engine="h5netcdf")
    assert kept.attrs["seed"] == 3
    assert kept.attrs["scene.bottom_depth"] == "6"
    assert f"{100 * kept['in_view'].values[0]:.1f}" in lines[3]


@pytest.mark.parametrize(
    ("arguments", "message"),
    [
        (["--depths", "2;5"], "--depths = '2;5' must hold numbers only"),
        (["--depths", "2,nan"], "depths holds nan"),
        (["--depths", "9"], "depths = 9 m must not lie below the bottom, at 8 m"),
        (["--depths", "2", "-o", "spread.txt"], "must end in .png, .pdf or .svg"),
        (["--depths", "2", "-D", "wind=3"], "parameter 'wind' is not one of scene fig09_1x1"),
    ],
)
def test_command_refuses(arguments, message, tmp_path, monkeypatch):
    monkeypatch.chdir(tmp_path)
    result = run("beam-spread", "fig09_1x1", *arguments)
    assert result.exit_code == 2
    assert result.stdout == ""
    # A progress bar may have come and gone before.
    assert message in result.stderr.replace("\n", " ")
    assert "Traceback" not in result.stderr
    assert not any(tmp_path.iterdir())
