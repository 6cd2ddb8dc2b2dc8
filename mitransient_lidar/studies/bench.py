"""Benchmarks: speed and accuracy of integrators and instruments, the cost of images, and narrow beams.

Each measurement has its own process: peak memory and compile time are independent of the others.
"""

from __future__ import annotations

import json as json_format
import os
import resource
import statistics
import subprocess
import sys
import tempfile
import time
from collections.abc import Callable, Iterable, Mapping
from pathlib import Path
from typing import Annotated, Any

import drjit as dr
import mitsuba as mi
import numpy as np
import xarray as xr

from mitransient_lidar.core.errors import UserError
from mitransient_lidar.core.options import Option, checked, positive_option, refuse_unused
from mitransient_lidar.loading.catalogue import instrument_names, scene_text
from mitransient_lidar.loading.scenes import choose_integrator, open_scene
from mitransient_lidar.loading.variants import alone
from mitransient_lidar.rendering.passes import LIGHT, LightOption
from mitransient_lidar.rendering.render import render
from mitransient_lidar.transport.paths.passes import PassRenderer
from mitransient_lidar.transport.rng import pass_streams
from mitransient_lidar.transport.scene_parts import lidar_sensor

#: Measurement values: task labels and arguments.
Tasks = Mapping[tuple[str, ...], Mapping[str, Any]]

#: Coefficients of turbid water [1/m].
TURBID = {"attenuation": "1.5", "scattering": "1.2", "backscattering": "0.024"}

_LAYERED = {"layer_tops": "0, 3", "attenuation": "0.9, 0.5", "scattering": "0.7, 0.35"}
_IMAGER = {"layout": "128x128", "bin_width_ns": "2", "bin_count": "64", "time_start_ns": "1400"}
_SPACE = {"altitude": "500000", "off_nadir_deg": "1", "divergence_mrad": "0.01", "field_of_view_mrad": "0.08"}

#: Shipped scene and parameters for each case.
CASES: dict[str, tuple[str, dict[str, str]]] = {
    "flat": ("fig09_2x2", {"spectrum": "flat"}),
    "clear": ("fig09_2x2", {}),
    "turbid": ("fig09_2x2", TURBID),
    "layered": ("fig09_2x2", {**_LAYERED, "backscattering": "0.014, 0.007", "field_of_view_mrad": "35"}),
    "target": ("fig09_2x2", {"field_of_view_mrad": "35", "bottom_depth": "12"}),
    "imager": ("fig09_2x2", _IMAGER),
    "narrow": ("fig09_2x2", {"divergence_mrad": "0.5"}),
    "mast": ("fig04_mast", {}),
    "space": ("fig09_2x2", _SPACE),
}

#: Scene and parameters in which instruments are measured: wind of 5 m/s and coastal water.
INSTRUMENT_CASE = ("table1", {"wind_speed": "5", "petzold": "coastal"})

#: Target in the case ``target``: a plate of 1.5 m x 1.5 m at a depth of 8 m.
_TARGET = """
    <shape type="rectangle" id="target">
        <transform name="to_world"><scale value="0.75"/><translate z="-8"/></transform>
        <bsdf type="diffuse"><spectrum name="reflectance" value="0.1"/></bsdf>
    </shape>
</scene>"""

QUICK_CASES = ("flat", "clear")  #: Cases for ``--quick``.

INTEGRATORS = ("lidar_merging", "lidar_volpath")

_QUICK_PASSES, _PASSES = 16, 64  #: Passes after the first one, which compiles.
_LONGEST_S = 120.0  #: Longest time of a render to a given error [s].

#: Headings of the figures of integrators and instruments, of images, and of beams.
_COLUMNS = {
    "wall_s": "wall s",
    "cpu_s": "CPU s",
    "compile_s": "compile s",
    "paths_per_s": "paths/s",
    "rays_per_s": "rays/s",
    "ray_rate_ratio": "of plain",
    "peak_mb": "peak MB",
    "error_median": "median err",
    "error_p95": "p95 err",
    "figure_of_merit": "1/(var s)",
}

LAYOUTS = ("2x2", "8x8", "32x32", "128x128", "256x256")  #: Layouts whose cost is measured.
TARGET_ERROR = 0.1  #: Median relative error over the lit pixels of the gate on the bottom at which a render ends.

_LIT = 0.05  #: A pixel is lit with this share of the brightest energy (99th percentile).

_GATES = """<film type="time_gated_film">
            <float name="gate_start_ns" value="1411"/>
            <float name="gate_width_ns" value="10"/>
            <float name="gate_step_ns" value="1.5"/>
            <integer name="gate_count" value="64"/>"""
_RECORD = {"bin_width_ns": "0.5", "bin_count": "320"}

_IMAGE_COLUMNS = {
    "pixels": "pixels",
    "wall_s": "wall s",
    "render_s": "render s",
    "passes": "passes",
    "bottom_error": "error",
    "per_pixel_ms": "ms/pixel",
    "peak_mb": "peak MB",
}

#: Divergences [mrad], views over the divergence, and the largest view [mrad].
DIVERGENCES = (0.1, 0.25, 0.5, 1.0, 2.5, 5.0, 10.0, 20.0)
VIEWS = (2, 5, 10, 20, 50, 100)
_LARGEST_VIEW = 100.0

REFERENCE = (10.0, 30.0)  #: Reference beam and view [mrad].

WATERS = {"clear": {}, "turbid": TURBID}
SEAS = {"flat": {"spectrum": "flat"}, "waves": {}}

_SCENE, _WIND = "table1", {"wind_speed": "6"}

_BEAM_PASSES = 16  #: Passes after the first one, which compiles.

_BEAM_COLUMNS = {"figure_of_merit": "1/(var s)", "ratio": "of 10 in 30", "cpu_s": "CPU s/pass"}


@checked
def run(
    *,
    quick: Annotated[bool, Option("Fewer cases, in less than a minute")] = False,
    json: Annotated[bool, Option("Print JSON")] = False,
    case: Annotated[str | None, Option("Run only this case")] = None,
    images: Annotated[bool, Option("Time a gate of 4 to 65536 pixels to 10 % instead")] = False,
    light: LightOption = "merging",
    beams: Annotated[bool, Option("Compare beams from 0.1 to 20 mrad in all views instead")] = False,
    target_error: Annotated[
        float | None,
        Option("Stop when 95 % of the bins of lit pixels have reached this relative standard error", 0, 1, above=True),
    ] = None,
    max_time: Annotated[
        float | None, positive_option("Stop each render before this many seconds, by default 120 with a target error")
    ] = None,
) -> None:
    """Measure every case with every integrator, and instruments with merging; print a table or one JSON object.

    With `quick` only the cases ``flat`` and ``clear``, with few passes; with `case` only this one, which may be an
    instrument's name. With `target_error`, above 0, renders end when the 95th percentile of the relative standard
    errors has reached it, or after `max_time`, above 0 [s], by default 120 s. A `max_time` alone ends them, too.

    Images: the table system over a bottom at 8 m below a sea at 3 m/s, c = 0.3 /m, 64 gates of 10 ns, 1.5 ns apart. A
    render ends when the gate on the bottom is known to 10 %; `light` as for `rendering.render.render`. Beams: the table
    system over a bottom at 8 m, 2x2 pixels, 1 ns bins, a flat sea with 6 m/s ripples or 6 m/s waves.
    """
    if light != LIGHT[0] and not images:
        raise UserError(f"light = {light!r} needs images = True")
    if images and beams:
        raise UserError("images = True and beams = True are alternatives: give one of them")
    if images or beams:
        ignored = {"quick": quick, "case": case, "target_error": target_error, "max_time": max_time}
        refuse_unused(run, f"is ignored: {'images' if images else 'beams'} = True has its own cases", **ignored)
    if images:
        layouts: Tasks = {(one,): {"layout": one, "light": light} for one in LAYOUTS}
        _run_processes("images", ("layout",), layouts, _IMAGE_COLUMNS, json)
        return
    if beams:
        tasks: Tasks = {(water, sea): {"water": water, "sea": sea} for water in WATERS for sea in SEAS}
        _run_processes("beams", ("water", "sea"), tasks, _BEAM_COLUMNS, json, "beams")
        return
    instruments = instrument_names()
    if case is not None and case not in CASES and case not in instruments:
        raise UserError(f"case = {case!r} must be one of {', '.join([*CASES, *instruments])}")
    ends = {"target_error": target_error, "max_time": max_time}
    tasks = {
        (name, integrator): {"case": name, "integrator": integrator, "quick": quick, **ends}
        for name in ([case] if case else list(QUICK_CASES if quick else (*CASES, *instruments)))
        for integrator in INTEGRATORS[: None if name in CASES else 1]
    }
    _run_processes("integrators", ("case", "integrator"), tasks, _COLUMNS, json)


@alone
def measure_integrator(
    case: str, integrator: str, quick: bool, target_error: float | None, max_time: float | None
) -> dict[str, float]:
    """Measure one case with one integrator in this process.

    Rates and times belong to the passes after the first one, which also compiles. The figure of merit is 1 / (median
    relative variance x CPU time) of the waveform's bins.
    """
    marks: list[tuple[float, float]] = []
    loaded = _load(case)
    start = time.perf_counter()
    result = render(
        loaded,
        integrator=integrator,
        passes=None if target_error or max_time else 1 + (_QUICK_PASSES if quick else _PASSES),
        target_error=target_error,
        max_time=_LONGEST_S if target_error and max_time is None else max_time,
        progress=lambda _: marks.append((time.perf_counter(), time.process_time())),
    )
    peak = _peak_mb()
    renderer = choose_integrator(loaded, integrator).prepare(loaded, lidar_sensor(loaded))
    steps = np.diff(np.array(marks)[:, 0])
    wall, cpu = (float(last - first) for first, last in zip(marks[0], marks[-1], strict=True))
    rays = float(renderer.render_pass(0).rays[0]) * len(steps)
    return {
        "wall_s": wall,
        "cpu_s": cpu,
        "compile_s": float(marks[0][0] - start - statistics.median(steps)),
        "paths_per_s": renderer.paths * len(steps) / wall,
        "rays_per_s": rays / wall,
        "ray_rate_ratio": rays / wall / _plain_ray_rate(renderer),
        "peak_mb": peak,
        "error_median": result.attrs["error_median"],
        "error_p95": result.attrs["error_p95"],
        "figure_of_merit": 1 / (result.attrs["error_median"] ** 2 * cpu),
    }


def _load(case: str) -> mi.Scene:
    """Load a case's scene."""
    if case not in CASES:
        return open_scene(*INSTRUMENT_CASE, case).scene
    name, parameters = CASES[case]
    if case != "target":
        return open_scene(name, parameters).scene
    with tempfile.TemporaryDirectory() as folder:
        path = Path(folder) / "target.xml"
        path.write_text(scene_text(name).replace("</scene>", _TARGET))
        return open_scene(path, parameters).scene


def _plain_ray_rate(renderer: PassRenderer) -> float:
    """Return the rays per second of plain ``ray_intersect`` from the receiver in the same scene."""
    scene, count, rates = renderer.scene, 2**21, []
    for attempt in range(6):
        start = renderer.sampler.sample(dr.arange(mi.UInt32, count), count, pass_streams(attempt, 0, count))
        ray = mi.Ray3f(mi.Point3f(scene.receiver.pose.origin.tolist()), start.direction)
        dr.eval(ray)
        dr.sync_thread()
        begin = time.perf_counter()
        si = scene.ray_intersect(ray)
        dr.eval(si.p, si.n)
        dr.sync_thread()
        rates.append(count / (time.perf_counter() - begin))
    return statistics.median(rates[1:])  # the first one compiles


def measure_image(layout: str, light: str = "merging") -> dict[str, float]:
    """Measure one layout in this process, with the light as of `render`.

    ``wall_s`` is the render time with compilation, and ``render_s`` the time of the passes after the first two.
    """
    marks: list[float] = []
    with tempfile.TemporaryDirectory() as folder:
        path = Path(folder) / "images.xml"
        path.write_text(scene_text("fig09_2x2").replace('<film type="time_gated_film">', _GATES))
        passes = 8
        # The goal concerns one gate: its number of passes is estimated from a few.
        for _ in range(2):
            marks.clear()
            start = time.perf_counter()
            result = render(
                path,
                params={"layout": layout, **_RECORD},
                passes=passes,
                seed=1,
                light=light,
                progress=lambda _: marks.append(time.perf_counter()),
            )
            wall, done, error = time.perf_counter() - start, passes, _bottom_error(result)
            passes = max(2, int(np.ceil(done * (error / TARGET_ERROR) ** 2))) + 1
            if passes <= done + 1:
                break
    pixels = int(np.prod([result.sizes[dim] for dim in ("row", "column", "pixel") if dim in result.sizes]))
    return {
        "pixels": pixels,
        "wall_s": wall,
        "render_s": marks[-1] - marks[1] if len(marks) > 2 else 0.0,
        "passes": done,
        "bottom_error": error,
        "per_pixel_ms": 1e3 * wall / pixels,
        "peak_mb": _peak_mb(),
    }


def _bottom_error(result: xr.Dataset) -> float:
    """Return the median relative error over the lit pixels in the gate about the bottom echo."""
    bottom = result.attrs["surface_time_ns"] + 8.0 * 9.24576
    gate = int(np.argmin(np.abs(result["gate_start"].values + 0.5 * result["gate_width"].values - bottom)))
    energy, stderr = (result[name].values[..., gate].ravel() for name in ("gate_energy", "gate_energy_stderr"))
    lit = energy > _LIT * np.percentile(energy, 99)
    return float(np.median(stderr[lit] / energy[lit]))


def measure_beams(water: str, sea: str) -> dict[str, dict[str, float]]:
    """Measure all beams in one water and sea in this process; return the figures by beam and view.

    The figure of merit is 1 / (median relative variance x CPU time) of the waveform's bins from the surface echo to the
    end of the bottom echo.
    """
    reference = _measure_beam(*REFERENCE, water, sea)
    figures = {f"{REFERENCE[0]:g} in {REFERENCE[1]:g}": {**reference, "ratio": 1.0}}
    for divergence in DIVERGENCES:
        for view in VIEWS:
            if divergence * view <= _LARGEST_VIEW:
                found = _measure_beam(divergence, divergence * view, water, sea)
                found["ratio"] = found["figure_of_merit"] / reference["figure_of_merit"]
                figures[f"{divergence:g} in {divergence * view:g}"] = found
    return figures


def _measure_beam(divergence: float, view: float, water: str, sea: str) -> dict[str, float]:
    """Measure one beam and view [mrad]."""
    beam = {"divergence_mrad": f"{divergence:g}", "field_of_view_mrad": f"{view:g}"}
    marks: list[float] = []
    result = render(
        _SCENE,
        params={**_WIND, **WATERS[water], **SEAS[sea], **beam},
        passes=1 + _BEAM_PASSES,
        seed=1,
        progress=lambda _: marks.append(time.process_time()),
    )
    cpu = marks[-1] - marks[0]
    moment = result["time"].values
    window = (moment >= result.attrs["window_start_ns"]) & (moment <= result.attrs["window_end_ns"])
    waveform, stderr = (result[name].values[:, window] for name in ("waveform", "waveform_stderr"))
    variance = float(np.median((stderr / waveform) ** 2))
    return {"figure_of_merit": 1 / (variance * cpu), "cpu_s": cpu / _BEAM_PASSES}


def _run_processes(
    kind: str, heading: tuple[str, ...], tasks: Tasks, columns: Mapping[str, str], as_json: bool, groups: str = ""
) -> None:
    """Measure each task in its own process, and print the figures as a table or as JSON.

    Tasks are given by their labels, with the headings `heading`; `columns` are the figures' headings. With the heading
    `groups` a task returns the figures for several rows by their labels.
    """
    figures: dict[str, Any] = {}
    if not as_json:
        print(_row([*heading, *([groups] if groups else [])], columns.values()))
    for labels, task in tasks.items():
        command = [sys.executable, "-m", __name__, kind, json_format.dumps(task)]
        with tempfile.TemporaryDirectory() as folder:
            # In its own session: after Ctrl-C, it would print its part as if it were all.
            done = subprocess.run(
                command,
                check=False,
                stdout=subprocess.PIPE,
                text=True,
                start_new_session=True,
                env={**os.environ, "TMPDIR": folder},
            )
        if done.returncode:
            raise UserError(f"the benchmark of {' with '.join(labels)} ended with exit code {done.returncode}")
        values = json_format.loads(done.stdout)
        group = figures
        for label in labels[:-1]:
            group = group.setdefault(label, {})
        group[labels[-1]] = values
        rows = {(*labels, label): row for label, row in values.items()} if groups else {labels: values}
        for row_labels, row in rows.items() if not as_json else ():
            print(_row(row_labels, (f"{row[key]:.4g}" for key in columns)), flush=True)
    if as_json:
        print(json_format.dumps(figures, indent=2))


def _peak_mb() -> float:
    """Return the largest memory of this process so far [MB]."""
    return resource.getrusage(resource.RUSAGE_SELF).ru_maxrss / 1024


def _row(labels: Iterable[str], cells: Iterable[str]) -> str:
    return " ".join([*(f"{label:<14}" for label in labels), *(f"{cell:>10}" for cell in cells)])


_MEASURES: Mapping[str, Callable[..., Any]] = {
    "integrators": measure_integrator,
    "images": measure_image,
    "beams": measure_beams,
}

if __name__ == "__main__":
    print(json_format.dumps(_MEASURES[sys.argv[1]](**json_format.loads(sys.argv[2]))))
