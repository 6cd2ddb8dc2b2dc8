"""Files that users give to the package: for every kind, how to write a good one, and what a user does with it."""

from __future__ import annotations

from collections.abc import Callable
from pathlib import Path
from typing import Any, NamedTuple

import numpy as np


class Kind(NamedTuple):
    """A kind of file: what writes a good one into a folder, what a user does with it, and how it is damaged.

    `format` is ``bytes``, ``text`` or ``attributes`` (of a NetCDF file).
    """

    make: Callable[[Path], Path]
    read: Callable[[Path], object]
    format: str = "bytes"


def shot() -> Any:
    """Return a small result, rendered once."""
    import mitransient_lidar

    params = {"layout": "2x2", "time_start_ns": 1400, "bin_count": 150, "spectrum": "flat"}
    return mitransient_lidar.render("table1", params=params, passes=4)


def series() -> Any:
    """Return a small series of shots."""
    import mitransient_lidar

    return mitransient_lidar.render_shots("table1", params={"layout": "2x2"}, count=3, passes=2)


def saved(dataset: Callable[[], Any], name: str) -> Callable[[Path], Path]:
    """Return what writes a result."""

    def make(folder: Path) -> Path:
        from mitransient_lidar import results

        results.save(dataset(), folder / name)
        return folder / name

    return make


def written(name: str, text: str) -> Callable[[Path], Path]:
    """Return what writes a text."""

    def make(folder: Path) -> Path:
        (folder / name).write_text(text)
        return folder / name

    return make


def analyse(path: Path) -> None:
    """Use a result as the commands waveforms, retrieve and plot do."""
    from mitransient_lidar import results
    from mitransient_lidar.analysis.retrieval.retrieve import retrieve
    from mitransient_lidar.analysis.waveforms import records
    from mitransient_lidar.analysis.waveforms.echo_table import extract
    from mitransient_lidar.plots.waveforms import plot_waveforms

    _each(
        lambda: extract(records.open_waveforms(path), ["gaussian", "leading_edge"]),
        lambda: retrieve(results.open(path)),
        lambda: plot_waveforms(results.open(path)),
    )


def use_again(path: Path) -> None:
    """Use a result as a scene, and cut gates and a record of a receiver from it."""
    from mitransient_lidar import results
    from mitransient_lidar.analysis.gates.cut import cut_gates
    from mitransient_lidar.analysis.receiver import detect_waveforms
    from mitransient_lidar.physics.lidar.gate_train import GateTrain
    from mitransient_lidar.rendering.again import describe_result
    from mitransient_lidar.rendering.render import render_again

    _each(
        lambda: describe_result(path),
        lambda: render_again(path, passes=2),
        lambda: cut_gates(results.open(path), GateTrain(start_ns=1420.0, width_ns=10.0, step_ns=10.0, count=3)),
        lambda: detect_waveforms(results.open(path), "apd"),
    )


def _each(*uses: Callable[[], object]) -> None:
    """Call all; raise a refusal at the end."""
    from mitransient_lidar.core.errors import UserError

    refusal = None
    for use in uses:
        try:
            use()
        except UserError as error:
            refusal = error
    if refusal is not None:
        raise refusal


def scene(folder: Path) -> Path:
    """Write a self-contained scene."""
    from mitransient_lidar.loading.catalogue import copy_scene

    return copy_scene("fig13_2x2", folder / "scene.xml")


def load(path: Path) -> None:
    """Load a scene, and plan the record of its lidar."""
    from mitransient_lidar.rendering.session import open_scene
    from mitransient_lidar.transport.scene_parts import find_lidar_scene

    session = open_scene(path, None)
    find_lidar_scene(session.scene, session.sensor)


def gates(name: str) -> Callable[[Path], Path]:
    """Return what writes a gate stack."""

    def make(folder: Path) -> Path:
        import mitransient_lidar
        from mitransient_lidar.results.gate_files import save_stack

        save_stack(mitransient_lidar.render("gated_waves", passes=2), folder / name)
        return folder / name

    return make


def draw_gates(path: Path) -> None:
    """Open and draw a gate stack."""
    from mitransient_lidar.plots.gates.images import plot_gates
    from mitransient_lidar.results.gate_files import open_stack

    plot_gates(open_stack(path))


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
    """Read a campaign, and plan its runs."""
    from mitransient_lidar.campaigns.design import Campaign
    from mitransient_lidar.campaigns.runs import RunRenderer

    campaign = Campaign.read(path)
    RunRenderer.of(campaign, campaign.table())


def table_of_runs(folder: Path) -> Path:
    """Write the table of a campaign."""
    (folder / "runs.csv").write_text("attenuation,bottom_depth,layout\n0.2,4.5,2x2\n0.3,5,1x1\n0.35,5.5,2x2\n")
    return folder / "runs.csv"


def plan_table(path: Path) -> None:
    """Plan the runs of a table."""
    from mitransient_lidar.campaigns.design import Campaign
    from mitransient_lidar.campaigns.runs import RunRenderer

    given = {"scene": "table1", "design": {"file": path.name}, "fixed": {"time_start_ns": 1400, "bin_count": 200}}
    campaign = Campaign.of(given, path.parent)
    RunRenderer.of(campaign, campaign.table())


def store(folder: Path) -> Path:
    """Render a small campaign."""
    from mitransient_lidar.campaigns.sweep import sweep

    fixed = {"spectrum": "flat", "layout": "1x1", "time_start_ns": 1380, "bin_count": 160}
    given = {
        **{"scene": "table1", "target_error": 0.5, "keep": ["waveform", "echoes", "truth"], "fixed": fixed},
        **{"parameters": {"bottom_depth": {"low": 2.0, "high": 9.0}}, "design": {"count": 6}},
    }
    sweep(given, folder / "store.zarr", workers=1, shard_size=3)
    return folder / "store.zarr"


def read_store(path: Path) -> None:
    """Read everything that a store holds, as far as it is not damaged, and draw it."""
    from mitransient_lidar.campaigns.store import Store, open_campaign, reporting_damage
    from mitransient_lidar.campaigns.sweep import describe_campaign
    from mitransient_lidar.plots.campaigns import plot_campaign

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
    """Work out the pulses of a flight."""
    from mitransient_lidar.core.files import read_text
    from mitransient_lidar.core.toml_files import check_keys, parse_toml, required, table
    from mitransient_lidar.flights.poses.mounting import Mounting, pulse_poses
    from mitransient_lidar.flights.poses.scanner import Scanner
    from mitransient_lidar.flights.poses.trajectory import Trajectory

    tables = ("platform", "scanner", "mounting")
    given = parse_toml(read_text(path), path)
    check_keys("a flight", given, tables)
    platform, scanner, mounting = (table(name, required("a flight", given, name)) for name in tables)
    trajectory = Trajectory.of(platform, path.parent)
    times = trajectory.pulse_times(10.0)[:1000]
    pulse_poses(trajectory, Mounting.of(mounting), Scanner.of(scanner), times)


def sbet(folder: Path) -> Path:
    """Write an SBET file."""
    data = np.zeros((9, 17))
    data[:, 0], data[:, 3] = 345600 + np.arange(9) / 200, 350.0
    data[:, 1:3] = np.radians([60.0, 15.0]) + 1e-7 * np.arange(9)[:, None]
    data[:, 9] = 0.3
    data.astype("<f8").tofile(folder / "a.sbet")
    return folder / "a.sbet"


def follow(**platform: Any) -> Callable[[Path], None]:
    """Return what reads a trajectory from a file, and interpolates it."""

    def read(path: Path) -> None:
        from mitransient_lidar.flights.poses.trajectory import Trajectory

        trajectory = Trajectory.of({"file": path.name, **platform}, path.parent)
        trajectory.at(np.linspace(*trajectory.lines[0], 50))

    return read


_TRAJECTORY = '#HEADER: "t", "roll", "pitch", "yaw", "x", "y", "z"\n' + "".join(
    f"{0.5 * i}, {i % 3}, 2.5, {10 * i}, {30 * i}, 20, 300\n" for i in range(12)
)

_HEIGHTS = 0.1 * np.sin(np.arange(24.0))[:, None] * np.ones(20)


def write_bag(path: Path, heights: Any, first: tuple[float, float], cell: tuple[float, float], **changes: Any) -> Path:
    """Write a Bathymetric Attributed Grid from its south-western cell on; `changes` are parts of its metadata."""
    import h5py

    rows, columns = np.shape(heights)
    last = (first[0] + (columns - 1) * cell[0], first[1] + (rows - 1) * cell[1])
    corners = changes.get("corners", f"{first[0]!r},{first[1]!r} {last[0]!r},{last[1]!r}")
    axes = "".join(
        f'<gmd:MD_Dimension><gmd:dimensionName><gmd:MD_DimensionNameTypeCode codeListValue="{name}"/>'
        f'</gmd:dimensionName><gmd:resolution><gco:Measure uom="m">{size!r}</gco:Measure></gmd:resolution>'
        "</gmd:MD_Dimension>"
        for name, size in (("row", cell[1]), ("column", cell[0]))
    )
    text = (
        f'<gmi:MI_Metadata xmlns:gmi="gmi" xmlns:gmd="gmd" xmlns:gco="gco" xmlns:gml="gml">{axes}'
        f"<gmd:cornerPoints><gml:Point><gml:coordinates>{corners}</gml:coordinates></gml:Point></gmd:cornerPoints>"
        f"<system>{changes.get('system', 'PROJCS[GEOGCS[]]')}</system></gmi:MI_Metadata>"
    )
    text = changes.get("head", "") + text
    with h5py.File(path, "w") as file:
        root = file.create_group("BAG_root")
        root["elevation"] = np.asarray(heights, dtype=np.float32)
        root["metadata"] = np.array([one.encode() for one in text], dtype="S1")
    return path


def height_map(suffix: str) -> Callable[[Path], Path]:
    """Return what writes a height map."""

    def make(folder: Path) -> Path:
        import OpenEXR
        import xarray as xr

        path = folder / f"map{suffix}"
        positions = {"x": np.arange(20.0), "y": np.arange(24.0)}
        if suffix == ".npy":
            np.save(path, _HEIGHTS)
        elif suffix == ".npz":
            np.savez(path, heights=_HEIGHTS, **positions)
        elif suffix == ".exr":
            kind = {"compression": OpenEXR.ZIP_COMPRESSION, "type": OpenEXR.scanlineimage}
            with OpenEXR.File(kind, {"Y": _HEIGHTS.astype(np.float32)}) as file:
                file.write(str(path))
        elif suffix == ".nc":
            xr.Dataset({"height": (("y", "x"), _HEIGHTS)}, positions).to_netcdf(path, engine="h5netcdf")
        elif suffix == ".bag":
            write_bag(path, _HEIGHTS, (500000.0, 6000000.0), (1.0, 1.0))
        elif suffix == ".xyz":
            places = np.random.default_rng(0).uniform(0, 20, (200, 2))
            rows = (f"{x:.2f} {y:.2f} {0.1 * np.sin(y):.3f}" for x, y in places)
            path.write_text("\n".join(("x y z", *rows)))
        else:
            head = "ncols 20\nnrows 24\nxllcorner 0\nyllcorner 0\ncellsize 1\nnodata_value -9999\n"
            path.write_text(head + "\n".join(" ".join(f"{one:.4f}" for one in row) for row in _HEIGHTS))
        return path

    return make


def load_map(path: Path) -> None:
    """Read a height map."""
    from mitransient_lidar.physics.sea.height_maps import read_height_map

    holes = "fill" if path.suffix == ".xyz" else "refuse"
    read_height_map(path, size=20.0 if path.suffix in (".npy", ".exr") else None, holes=holes)


_PROFILE = """depth (m),attenuation (1/m),scattering (1/m)
0,0.2,0.1
2,0.25,0.12
4.5,0.3,0.2
8,nan,0.2
12,0.3,0.2
"""


def load_plugin(**parameters: str) -> Callable[[Path], None]:
    """Return what loads a plugin with a file."""

    def read(path: Path) -> None:
        import mitsuba as mi

        from mitransient_lidar.loading import scenes, variants

        variants.set_variant()
        with scenes.as_user_error():
            mi.load_dict({name: str(path) if value == "FILE" else value for name, value in parameters.items()})

    return read


def image(suffix: str) -> Callable[[Path], Path]:
    """Return what writes a grey image."""

    def make(folder: Path) -> Path:
        import mitsuba as mi

        path = folder / f"image{suffix}"
        values = np.arange(1, 64, dtype=np.uint8).reshape(7, 9)
        if suffix == ".npy":
            np.save(path, values)
        else:
            mi.Bitmap(values[..., None] if suffix == ".png" else values[..., None].astype(np.float32)).write(str(path))
        return path

    return make


def read_image(path: Path) -> None:
    """Read a grey image."""
    from mitransient_lidar.transport.sensor.image_sampling import read_image as read

    read("pixel_map", str(path))


_PULSE = "time_ns,power\n" + "".join(f"{0.5 * i},{np.exp(-((i - 10) ** 2) / 20):.5f}\n" for i in range(21))
_PHASE = "angle (deg),phase function\n" + "".join(f"{i},{1 / (1 + i):.6f}\n" for i in range(0, 181, 5))

KINDS = {
    "scene": Kind(scene, load, "text"),
    "result_nc": Kind(saved(shot, "a.nc"), analyse),
    "result_exr": Kind(saved(shot, "a.exr"), analyse),
    "result_attributes": Kind(saved(shot, "a.nc"), analyse, "attributes"),
    "result_again": Kind(saved(shot, "a.nc"), use_again, "attributes"),
    "series_attributes": Kind(saved(series, "a.nc"), analyse, "attributes"),
    "gates_exr": Kind(gates("a_gates.exr"), draw_gates),
    "gates_attributes": Kind(gates("a_gates.nc"), draw_gates, "attributes"),
    "campaign": Kind(written("a.toml", _CAMPAIGN), plan, "text"),
    "flight": Kind(written("a.toml", _PLAN), fly, "text"),
    "trajectory": Kind(written("a.trj", _TRAJECTORY), follow(kind="csv"), "text"),
    "trajectory_sbet": Kind(sbet, follow(kind="sbet", epsg=32633)),
    "table_of_runs": Kind(table_of_runs, plan_table, "text"),
    "store": Kind(store, read_store),
    **{f"map{suffix}": Kind(height_map(suffix), load_map) for suffix in (".npy", ".npz", ".exr", ".nc", ".bag")},
    "map.xyz": Kind(height_map(".xyz"), load_map, "text"),
    "map.asc": Kind(height_map(".asc"), load_map, "text"),
    "profile": Kind(written("a.csv", _PROFILE), load_plugin(type="layered_water", profile="FILE"), "text"),
    "phase_function": Kind(written("a.csv", _PHASE), load_plugin(type="measured_phase", filename="FILE"), "text"),
    "pulse": Kind(
        written("a.csv", _PULSE),
        load_plugin(type="lidar_transmitter", pulse_file="FILE"),
        "text",
    ),
    **{f"image{suffix}": Kind(image(suffix), read_image) for suffix in (".png", ".npy", ".exr")},
}
