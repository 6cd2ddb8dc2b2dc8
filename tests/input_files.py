"""Files that users give to the package: for every kind, how to write a good one, and what a user does with it."""

from __future__ import annotations

import functools
import resource
import shutil
from collections.abc import Callable
from pathlib import Path
from typing import Any, NamedTuple

import numpy as np
from array_inputs import height_map, image, load_map, mesh, read_image

import mitransient_lidar
from mitransient_lidar import results
from mitransient_lidar.analysis.gates.cut import cut_gates
from mitransient_lidar.analysis.information.measured import measured
from mitransient_lidar.analysis.receiver import detect_waveforms
from mitransient_lidar.analysis.retrieval.retrieve import retrieve
from mitransient_lidar.analysis.waveforms.depth_correction import corrections_for
from mitransient_lidar.analysis.waveforms.echo_table import extract
from mitransient_lidar.campaigns.design import Campaign
from mitransient_lidar.campaigns.runs import RunRenderer
from mitransient_lidar.campaigns.store import Store, open_campaign, reporting_damage
from mitransient_lidar.campaigns.sweep import campaign as run_campaign
from mitransient_lidar.campaigns.sweep import describe_campaign
from mitransient_lidar.core.errors import UserError
from mitransient_lidar.core.files import read_text
from mitransient_lidar.core.formats.documents import check_keys, parse_toml, required, table
from mitransient_lidar.flights.poses.mounting import Mounting, pulse_poses
from mitransient_lidar.flights.poses.platforms import platform_of
from mitransient_lidar.flights.poses.scanner import Scanner
from mitransient_lidar.loading import scenes, variants
from mitransient_lidar.loading.catalogue import copy_scene, folder_of_scenes
from mitransient_lidar.physics.lidar.gate_train import GateTrain
from mitransient_lidar.physics.receiver.receiver_files import receiver
from mitransient_lidar.plots.campaigns import plot_campaign
from mitransient_lidar.plots.gates.images import plot_gates
from mitransient_lidar.plots.waveforms import plot_waveforms
from mitransient_lidar.rendering.again import describe_result
from mitransient_lidar.rendering.render import render_again
from mitransient_lidar.transport.scene_parts import find_lidar_scene


class Kind(NamedTuple):
    """A kind of file: what writes a good one into a folder, what a user does with it, and how it is damaged.

    `format` is ``bytes``, ``text``, ``attributes`` (of a NetCDF file) or ``extremes`` (of parameters of a scene).
    """

    make: Callable[[Path], Path]
    read: Callable[[Path], object]
    format: str = "bytes"


def shot() -> Any:
    params = {"layout": "2x2", "time_start_ns": 1400, "bin_count": 150, "spectrum": "flat"}
    return mitransient_lidar.render("table1", params=params, passes=4)


def saved(dataset: Callable[[], Any], name: str) -> Callable[[Path], Path]:
    def make(folder: Path) -> Path:
        results.save(dataset(), folder / name)
        return folder / name

    return make


def written(name: str, text: str) -> Callable[[Path], Path]:
    return lambda folder: (folder / name).write_text(text) and folder / name


def series() -> Any:
    return mitransient_lidar.render_shots("table1", params={"layout": "2x2"}, count=3, passes=2)


def gates() -> Any:
    return mitransient_lidar.render("gated_waves", passes=2)


def analyse(path: Path) -> None:
    """Use a result as the commands waveforms, retrieve and plot do."""
    # Reading takes as long as each use.
    opened = functools.cache(lambda: results.open(path))
    _each(
        lambda: extract(results.open(path), ["gaussian", "leading_edge"]),
        lambda: retrieve(opened()),
        lambda: plot_waveforms(opened()),
    )


def use_again(path: Path) -> None:
    """Use a result as a scene, and cut gates and a record of a receiver from it."""
    _each(
        lambda: describe_result(path),
        lambda: render_again(path, passes=2),
        lambda: cut_gates(results.open(path), GateTrain(start_ns=1420.0, width_ns=10.0, step_ns=10.0, count=3)),
        lambda: detect_waveforms(results.open(path), "apd"),
    )


def _each(*uses: Callable[[], object]) -> None:
    """Call all; raise a refusal at the end."""
    refusal = None
    for use in uses:
        try:
            use()
        except UserError as error:
            refusal = error
    if refusal is not None:
        raise refusal


def scene(folder: Path) -> Path:
    return copy_scene("fig13_2x2", folder / "scene.xml")


def load(path: Path) -> None:
    """Load a scene, and plan the record of its lidar."""
    session = scenes.open_scene(path, None)
    find_lidar_scene(session.scene, session.sensor)


def small_scene(folder: Path) -> Path:
    """Write the default scene, with few paths a pass."""
    path = copy_scene("table1", folder / "scene.xml")
    counts = "".join(f'<integer name="{one}_per_pass" value="8192"/>' for one in ("paths", "photons"))
    whole, text = '<integrator type="lidar_merging"/>', path.read_text()
    assert whole in text
    path.write_text(text.replace(whole, f"{whole[:-2]}>{counts}</integrator>"))
    return path


def render_small(path: Path) -> None:
    """Render a scene within 3 GB, half of which large arrays may take, and check that its light is finite."""
    resource.setrlimit(resource.RLIMIT_DATA, (3 * 10**9, resource.getrlimit(resource.RLIMIT_DATA)[1]))
    result = mitransient_lidar.render(path, passes=2)
    for name, array in result.data_vars.items():
        assert np.isfinite(array.values).all(), f"{name} is not finite"


def scene_parts(folder: Path) -> Path:
    """Write a scene of three files in a folder, of which one includes the next."""
    parts = folder / "parts"
    parts.mkdir()
    scene(parts)
    text = (parts / "scene.xml").read_text()
    first, last = text.index("<sensor"), text.index("</sensor>") + len("</sensor>")
    (parts / "scene.xml").write_text(f'{text[:first]}<include filename="sensor.xml"/>{text[last:]}')
    (parts / "sensor.xml").write_text('<scene version="3.0.0"><include filename="receiver.xml"/></scene>')
    (parts / "receiver.xml").write_text(f'<scene version="3.0.0">{text[first:last]}</scene>')
    return parts


def load_part(kind: str, **parameters: Any) -> Callable[[Path], None]:
    """Return what loads an object of Mitsuba's in a scene, whose parameters may be FILE."""

    def read(path: Path) -> None:

        def filled(part: dict[str, Any]) -> dict[str, Any]:
            values = {name: filled(one) if isinstance(one, dict) else one for name, one in part.items()}
            return {name: str(path) if value == "FILE" else value for name, value in values.items()}

        scenes.open_scene({"type": "scene", "part": filled({"type": kind, **parameters})})

    return read


_SPECTRUM = "".join(f"{wavelength} {0.1 + wavelength / 1e4:.4f}\n" for wavelength in range(400, 700, 20))


_CAMPAIGN = """scene = "table1"
target_error = 0.3
keep = ["waveform", "truth"]
receiver = "apd"
gain = 2.0
[fixed]
layout = "2x2"
bin_count = 160
[parameters]
bottom_depth = { low = 2.0, high = 20.0, scale = "log" }
attenuation = [0.1, 0.2]
scattering = "0.8 * attenuation * min(bottom_depth, 1) ** 2"
[design]
kind = "sobol"
count = 16
seed = 3
"""


def plan(path: Path) -> None:
    campaign = Campaign.read(path)
    RunRenderer.of(campaign, campaign.table())


def table_of_runs(folder: Path) -> Path:
    (folder / "runs.csv").write_text("attenuation,bottom_depth,layout\n0.2,4.5,2x2\n0.3,5,1x1\n0.35,5.5,2x2\n")
    return folder / "runs.csv"


def plan_table(path: Path) -> None:
    given = {"scene": "table1", "design": {"file": path.name}, "fixed": {"time_start_ns": 1400, "bin_count": 200}}
    campaign = Campaign.of_file(given, path.parent)
    RunRenderer.of(campaign, campaign.table())


def store(folder: Path) -> Path:
    fixed = {"spectrum": "flat", "layout": "1x1", "time_start_ns": 1380, "bin_count": 160}
    given = {
        **{"scene": "table1", "target_error": 0.5, "keep": ["waveform", "echoes", "truth"], "fixed": fixed},
        **{"parameters": {"bottom_depth": {"low": 2.0, "high": 9.0}}, "design": {"count": 6}},
    }
    run_campaign(given, folder / "store.zarr", workers=1, shard_size=3)
    return folder / "store.zarr"


def read_store(path: Path) -> None:
    """Read everything that a store holds, as far as it is not damaged, and draw it."""

    def draw() -> None:
        with reporting_damage(path):
            plot_campaign(open_campaign(path))

    _each(lambda: describe_campaign(path), draw, lambda: Store(path).renderer(), lambda: Store(path).mend())


_PLAN = """[platform]
kind = "lines"
start = [10.0, 20.0]
heading_deg = 30.0
speed = 60.0
height = 300.0
length = 120.0
count = 3
spacing = 20.0
noise = { roll_deg = 0.8, pitch_deg = 0.5, correlation_s = 4.0, seed = 1 }
[scanner]
kind = "raster"
along_deg = [-10.0, 10.0]
across_deg = [-20.0, 20.0]
lines = 5
points = 7
rate_hz = 2.0
pixels = "platform"
[mounting]
pitch_deg = 3.0
lever_arm = [0.3, 1.2, -0.5]
"""


def fly(path: Path) -> None:
    tables = ("platform", "scanner", "mounting")
    given = parse_toml(read_text(path), path)
    check_keys("a flight", given, tables)
    platform, scanner, mounting = (table(name, required("a flight", given, name)) for name in tables)
    trajectory = platform_of(platform).trajectory(path.parent)
    times = trajectory.pulse_times(10.0)[:1000]
    pulse_poses(trajectory, Mounting.of(mounting), Scanner.of_table(scanner), times)


def sbet(folder: Path) -> Path:
    data = np.zeros((9, 17))
    data[:, 0], data[:, 3] = 345600 + np.arange(9) / 200, 350.0
    data[:, 1:3] = np.radians([60.0, 15.0]) + 1e-7 * np.arange(9)[:, None]
    data[:, 9] = 0.3
    data.astype("<f8").tofile(folder / "a.sbet")
    return folder / "a.sbet"


def follow(**platform: Any) -> Callable[[Path], None]:
    """Return what reads a trajectory from a file, and interpolates it."""

    def read(path: Path) -> None:
        trajectory = platform_of({"file": path.name, **platform}).trajectory(path.parent)
        trajectory.at(np.linspace(*trajectory.lines[0], 50))

    return read


_TRAJECTORY = '#HEADER: "t", "roll", "pitch", "yaw", "x", "y", "z"\n' + "".join(
    f"{0.5 * i}, {i % 3}, 2.5, {10 * i}, {30 * i}, 20, 300\n" for i in range(12)
)

_PROFILE = """depth (m),attenuation (1/m),scattering (1/m)
0,0.2,0.1
2,0.25,0.12
4.5,0.3,0.2
8,nan,0.2
12,0.3,0.2
"""


def load_plugin(**parameters: str) -> Callable[[Path], None]:
    def read(path: Path) -> None:
        # After the package, which sets the path of LLVM.
        import mitsuba as mi

        variants.set_variant()
        with scenes.as_user_error():
            mi.load_dict({name: str(path) if value == "FILE" else value for name, value in parameters.items()})

    return read


def shipped(name: str) -> Callable[[Path], Path]:
    return lambda folder: Path(shutil.copy(folder_of_scenes() / "instruments" / name, folder / name))


_MEASURED = "time_ns,red,red_stderr\n" + "".join(f"{i},{1 + i % 5},{0.1 + 0.01 * i:.2f}\n" for i in range(30))
_PULSE = "time_ns,power\n" + "".join(f"{0.5 * i},{np.exp(-((i - 10) ** 2) / 20):.5f}\n" for i in range(21))
_PHASE = "angle (deg),phase function\n" + "".join(f"{i},{1 / (1 + i):.6f}\n" for i in range(0, 181, 5))

KINDS = {
    "scene": Kind(scene, load, "text"),
    "scene_parts": Kind(scene_parts, lambda path: load(path / "scene.xml"), "text"),
    "parameters": Kind(small_scene, render_small, "extremes"),
    "mesh.ply": Kind(mesh("a.ply"), load_part("ply", filename="FILE"), "text"),
    "mesh_binary.ply": Kind(mesh("a_binary.ply"), load_part("ply", filename="FILE")),
    "mesh.obj": Kind(mesh("a.obj"), load_part("obj", filename="FILE"), "text"),
    "texture": Kind(image(".png"), load_part("diffuse", reflectance={"type": "bitmap", "filename": "FILE"})),
    "spectrum": Kind(
        written("a.spd", _SPECTRUM), load_part("diffuse", reflectance={"type": "spectrum", "filename": "FILE"}), "text"
    ),
    "result_nc": Kind(saved(shot, "a.nc"), analyse),
    "result_exr": Kind(saved(shot, "a.exr"), analyse),
    "result_attributes": Kind(saved(shot, "a.nc"), analyse, "attributes"),
    "result_again": Kind(saved(shot, "a.nc"), use_again, "attributes"),
    "series_attributes": Kind(saved(series, "a.nc"), analyse, "attributes"),
    "gates_exr": Kind(saved(gates, "a_gates.exr"), lambda path: plot_gates(results.open(path))),
    "gates_attributes": Kind(saved(gates, "a_gates.nc"), lambda path: plot_gates(results.open(path)), "attributes"),
    "campaign": Kind(written("a.toml", _CAMPAIGN), plan, "text"),
    "flight": Kind(written("a.toml", _PLAN), fly, "text"),
    "trajectory": Kind(written("a.trj", _TRAJECTORY), follow(kind="csv"), "text"),
    "trajectory_sbet": Kind(sbet, follow(kind="sbet", epsg=32633)),
    "table_of_runs": Kind(table_of_runs, plan_table, "text"),
    "store": Kind(store, read_store),
    **{
        f"map{suffix}": Kind(height_map(suffix), load_map) for suffix in (".npy", ".npz", ".exr", ".nc", ".tif", ".bag")
    },
    "map.xyz": Kind(height_map(".xyz"), load_map, "text"),
    "map.asc": Kind(height_map(".asc"), load_map, "text"),
    "profile": Kind(written("a.csv", _PROFILE), load_plugin(type="layered_water", profile="FILE"), "text"),
    "phase_function": Kind(written("a.csv", _PHASE), load_plugin(type="measured_phase", filename="FILE"), "text"),
    "pulse": Kind(written("a.csv", _PULSE), load_plugin(type="lidar_transmitter", pulse_file="FILE"), "text"),
    "receiver": Kind(shipped("leica_hawkeye4x_deep.toml"), lambda path: receiver(str(path)), "text"),
    "corrections": Kind(shipped("leica_hawkeye4x_deep_depths.nc"), lambda path: corrections_for("", path)),
    "measured": Kind(written("a.csv", _MEASURED), measured, "text"),
    **{f"image{suffix}": Kind(image(suffix), read_image) for suffix in (".png", ".npy", ".exr")},
}
