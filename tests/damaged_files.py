"""Damaged input: every reader of files, with thousands of files that are damaged at random or by intent.

Run by hand, in the environment that the package is developed in::

    .venv/bin/python tests/damaged_files.py --count 1000               # of every kind of file
    .venv/bin/python tests/damaged_files.py result_attributes --count 100 --first 40

A file must be read, or refused with one sentence (`UserError`), within half a minute. Everything else is a finding:
another exception, the end of the process by a signal, and a read that takes longer. Findings go to stderr, each with
the number that makes it again, and a Markdown table to stdout.
"""

from __future__ import annotations

import argparse
import contextlib
import io
import json
import logging
import os
import random
import re
import shutil
import signal
import subprocess
import sys
import tempfile
import traceback
import warnings
from collections import Counter
from collections.abc import Callable, Iterator
from pathlib import Path
from typing import Any

import numpy as np

LIMIT_S = 30

#: What numbers and texts are replaced by.
_ODD_TEXTS = (
    "nan",
    "inf",
    "-1",
    "0",
    "1e300",
    "-1e-300",
    "1e999",
    "",
    "x",
    "[]",
    "9" * 30,
    "true",
    "$x",
    "../a",
    "é",
    "'",
)
_ODD_VALUES: tuple[Any, ...] = (
    *(np.nan, np.inf, -1.0, 0.0, 0, 1e300, -1e-300, 2**62, "", "x", "nan", "{", "[1", '{"a": 1}', "null"),
    *([], [1.0], [1.0, 2.0, 3.0], ["a", "b"], [np.nan, np.nan], "[" * 5000),
)


class Kind:
    """A kind of file: `make` writes a good one, `damage` changes it, and `read` is what a user does with it."""

    def __init__(
        self,
        make: Callable[[Path], Path],
        read: Callable[[Path], object],
        damage: Callable[[Path, random.Random], None] | None = None,
    ) -> None:
        self.make, self.read, self.damage = make, read, damage or damage_bytes


def damage_bytes(path: Path, rng: random.Random) -> None:
    """Damage the bytes of a file, or of one file of a folder."""
    if path.is_dir():
        path = rng.choice(sorted(one for one in path.rglob("*") if one.is_file()))
        if rng.random() < 0.2:
            path.unlink()
            return
    data = bytearray(path.read_bytes())
    # The heads of files say most about them.
    place = int(len(data) * rng.random() ** rng.choice((1, 4)))
    length = rng.randrange(1, 64)
    match rng.randrange(6):
        case 0:
            for _ in range(rng.randrange(1, 9)):
                data[min(place + rng.randrange(32), len(data) - 1)] ^= 1 << rng.randrange(8)
        case 1:
            del data[place:]
        case 2:
            del data[place : place + length]
        case 3:
            data[place:place] = data[place : place + length]
        case 4:
            data[place : place + length] = bytes(length)
        case 5:
            data[place : place + length] = rng.randbytes(length)
    path.write_bytes(data)


def damage_text(path: Path, rng: random.Random) -> None:
    """Replace a number or a text of a file by an odd one, or change its lines or bytes."""
    text = path.read_text("utf-8")
    lines = text.splitlines(keepends=True)
    place = rng.randrange(len(lines))
    match rng.randrange(6):
        case 0:
            damage_bytes(path, rng)
            return
        case 1:
            lines[place] *= rng.choice((0, 2))
        case 2:
            other = rng.randrange(len(lines))
            lines[place], lines[other] = lines[other], lines[place]
        case _:
            tokens = list(re.finditer(r"[-+]?\d[\d.e+-]*|\"[^\"]*\"|\b[a-z_]+\b", text))
            token = rng.choice(tokens)
            odd = rng.choice(_ODD_TEXTS) if rng.random() < 0.7 else rng.choice(tokens)[0]
            odd = f'"{odd}"' if token[0].startswith('"') and not odd.startswith('"') else odd
            lines = [text[: token.start()], odd, text[token.end() :]]
    path.write_text("".join(lines), "utf-8")


def damage_attributes(path: Path, rng: random.Random) -> None:
    """Replace an attribute, a coordinate or a variable of a NetCDF file by an odd one, or remove it."""
    import xarray as xr

    dataset = xr.load_dataset(path, engine="h5netcdf", decode_times=False)
    names = [("attribute", name) for name in dataset.attrs] * 2 + [("array", str(name)) for name in dataset.variables]
    where, name = rng.choice(names)
    if where == "attribute":
        if rng.random() < 0.15:
            del dataset.attrs[name]
        else:
            dataset.attrs[name] = rng.choice(_ODD_VALUES)
    else:
        array = dataset[name]
        match rng.randrange(6):
            case 0:
                dataset = dataset.drop_vars(name)
            case 1:
                dataset[name] = array.copy(data=np.full(array.shape, rng.choice((np.nan, np.inf, -1.0, 0.0, 1e300))))
            case 2:
                dataset[name] = array.copy(data=np.full(array.shape, "x"))
            case 3:
                dataset[name] = array.copy(data=array.values[::-1] if array.ndim else array.values)
            case 4 if array.ndim:
                dim = rng.choice(array.dims)
                dataset = dataset.isel({dim: slice(0, rng.choice((0, 1, 2)))})
            case _:
                dataset = dataset.rename({name: "other"})
    path.unlink()
    dataset.to_netcdf(path, engine="h5netcdf")


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
    from mitransient_lidar.rendering.again import describe_result, render_again

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
    from mitransient_lidar.transport.scene import LidarScene

    session = open_scene(path, None)
    LidarScene.from_scene(session.scene, session.sensor)


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
    from mitransient_lidar.campaigns.store import Store, describe_campaign, open_campaign, reading
    from mitransient_lidar.plots.campaigns import plot_campaign

    def draw() -> None:
        with reading(path):
            plot_campaign(open_campaign(path))

    _each(lambda: describe_campaign(path), draw, lambda: Store(path).renderer(), lambda: Store(path).mend())


_HEIGHTS = 0.1 * np.sin(np.arange(24.0))[:, None] * np.ones(20)


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
        else:
            head = "ncols 20\nnrows 24\nxllcorner 0\nyllcorner 0\ncellsize 1\nnodata_value -9999\n"
            path.write_text(head + "\n".join(" ".join(f"{one:.4f}" for one in row) for row in _HEIGHTS))
        return path

    return make


def load_map(path: Path) -> None:
    """Read a height map."""
    from mitransient_lidar.physics.sea.height_maps import read_height_map

    read_height_map(path, size=20.0 if path.suffix in (".npy", ".exr") else None)


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
    "scene": Kind(scene, load, damage_text),
    "result_nc": Kind(saved(shot, "a.nc"), analyse),
    "result_exr": Kind(saved(shot, "a.exr"), analyse),
    "result_attributes": Kind(saved(shot, "a.nc"), analyse, damage_attributes),
    "result_again": Kind(saved(shot, "a.nc"), use_again, damage_attributes),
    "series_attributes": Kind(saved(series, "a.nc"), analyse, damage_attributes),
    "gates_exr": Kind(gates("a_gates.exr"), draw_gates),
    "gates_attributes": Kind(gates("a_gates.nc"), draw_gates, damage_attributes),
    "campaign": Kind(written("a.toml", _CAMPAIGN), plan, damage_text),
    "table_of_runs": Kind(table_of_runs, plan_table, damage_text),
    "store": Kind(store, read_store),
    **{f"map{suffix}": Kind(height_map(suffix), load_map) for suffix in (".npy", ".npz", ".exr", ".nc")},
    "map.asc": Kind(height_map(".asc"), load_map, damage_text),
    "profile": Kind(written("a.csv", _PROFILE), load_plugin(type="layered_water", profile="FILE"), damage_text),
    "phase_function": Kind(written("a.csv", _PHASE), load_plugin(type="measured_phase", filename="FILE"), damage_text),
    "pulse": Kind(
        written("a.csv", _PULSE),
        load_plugin(type="lidar_transmitter", pulse_file="FILE"),
        damage_text,
    ),
    **{f"image{suffix}": Kind(image(suffix), read_image) for suffix in (".png", ".npy", ".exr")},
}


def attempts(name: str, first: int, count: int, original: Path) -> Iterator[tuple[int, str, str]]:
    """Yield number, result and cause of damaged files of a kind."""
    from mitransient_lidar.core.errors import UserError

    warnings.simplefilter("ignore")
    logging.disable()
    signal.signal(signal.SIGALRM, _too_long)
    KINDS[name].read(original)
    for number in range(first, first + count):
        rng = random.Random(f"{name} {number}")
        with tempfile.TemporaryDirectory() as folder:
            path = Path(folder) / original.name
            (shutil.copytree if original.is_dir() else shutil.copy)(original, path)
            try:
                KINDS[name].damage(path, rng)
            except Exception:
                yield number, "not damaged", ""
                continue
            # A damaged file may end the process; its number is told before.
            yield number, "began", ""
            signal.alarm(LIMIT_S)
            try:
                with contextlib.redirect_stdout(io.StringIO()):
                    KINDS[name].read(path)
                result, cause = "read", ""
            except UserError as error:
                result, cause = ("refused", "") if "\n" not in str(error) else ("traceback", f"two lines: {error}")
            except TimeoutError:
                result, cause = "too long", ""
            except BaseException as error:
                result, cause = "traceback", f"{type(error).__name__}: {error} {_place(error)}"
            signal.alarm(0)
            yield number, result, " ".join(cause.split())[-400:]


def _too_long(*_: object) -> None:
    raise TimeoutError


def _place(error: BaseException) -> str:
    """Return the last place of this package in a traceback."""
    own = [frame for frame in traceback.extract_tb(error.__traceback__) if "/mitransient_lidar/" in frame.filename]
    return f"at {Path(own[-1].filename).name}:{own[-1].lineno}" if own else ""


def measure(name: str, first: int, count: int, folder: Path) -> Counter[str]:
    """Return the number of results of a kind; processes that end are started again behind the file that ended them."""
    place = folder / name
    place.mkdir()
    command = [sys.executable, __file__, "--child", name]
    subprocess.run([*command, "--folder", str(place)], check=True, stdout=subprocess.DEVNULL, stderr=subprocess.DEVNULL)
    (original,) = place.iterdir()
    results: Counter[str] = Counter()
    at, end = first, first + count
    while at < end:
        order = [*command, "--folder", str(original), "--first", str(at), "--count", str(end - at)]
        began = at
        with subprocess.Popen(order, stdout=subprocess.PIPE, stderr=subprocess.DEVNULL, text=True) as process:
            assert process.stdout is not None
            for line in process.stdout:
                if not line.startswith('["'):
                    continue
                _, number, result, cause = json.loads(line)
                at = number + 1
                if result == "began":
                    continue
                results[result] += 1
                if result not in ("read", "refused", "not damaged"):
                    print(f"{name} {number}: {result}: {cause}", file=sys.stderr, flush=True)
        if process.returncode != 0 and at == began:
            raise SystemExit(f"{name}: the file is not read without damage: {' '.join(order)}")
        if process.returncode != 0:
            results["process ended"] += 1
            print(f"{name} {at - 1}: the process ended with {process.returncode}", file=sys.stderr, flush=True)
    return results


def main() -> None:
    """Read damaged files, and print a table."""
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("names", nargs="*", metavar="KIND", help=f"kinds of files; default: all of {', '.join(KINDS)}")
    parser.add_argument("--count", type=int, default=0, help="number of damaged files of each kind")
    parser.add_argument("--first", type=int, default=0, help="number of the first one")
    parser.add_argument("--child", help=argparse.SUPPRESS)
    parser.add_argument("--folder", type=Path, help=argparse.SUPPRESS)
    given = parser.parse_args()
    if given.child and not given.count:
        KINDS[given.child].make(given.folder)
        return
    if given.child:
        # Mitsuba writes to standard output, too.
        out = os.fdopen(os.dup(1), "w")
        os.dup2(2, 1)
        for attempt in attempts(given.child, given.first, given.count, given.folder):
            print(json.dumps([given.child, *attempt]), file=out, flush=True)
        return
    if unknown := sorted(set(given.names) - set(KINDS)):
        parser.error(f"no such kind: {', '.join(unknown)}")
    columns = ("read", "refused", "traceback", "too long", "process ended")
    print("| file |", " | ".join(columns), "|\n|---|", "---|" * len(columns), sep="", flush=True)
    with tempfile.TemporaryDirectory() as folder:
        for name in given.names or KINDS:
            results = measure(name, given.first, given.count or 100, Path(folder))
            print(f"| {name} |", " | ".join(str(results[one]) for one in columns), "|", flush=True)


if __name__ == "__main__":
    main()
