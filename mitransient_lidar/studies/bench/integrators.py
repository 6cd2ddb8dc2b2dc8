"""Benchmark for integrator speed and accuracy."""

from __future__ import annotations

import statistics
import tempfile
import time
from pathlib import Path
from typing import TYPE_CHECKING, Annotated

import numpy as np

from mitransient_lidar.core.errors import UserError
from mitransient_lidar.core.options import Option, checked, positive_option
from mitransient_lidar.loading.exclusive import alone
from mitransient_lidar.studies.bench.processes import Tasks, answer, peak_mb, run_processes

if TYPE_CHECKING:
    import mitsuba as mi

    from mitransient_lidar.transport.paths.passes import PassRenderer

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

#: Cases for ``--quick``.
QUICK_CASES = ("flat", "clear")

INTEGRATORS = ("lidar_merging", "lidar_volpath")

#: Passes after the first one, which compiles.
_QUICK_PASSES, _PASSES = 16, 64

#: Longest time of a render to a given error [s].
_LONGEST_S = 120.0

#: Headings of the figures.
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


@checked
def run(
    *,
    quick: Annotated[bool, Option("Fewer cases, in less than a minute")] = False,
    json: Annotated[bool, Option("Print JSON")] = False,
    case: Annotated[str | None, Option("Run only this case")] = None,
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
    """
    from mitransient_lidar.loading.instruments import instrument_names

    instruments = instrument_names()
    if case is not None and case not in CASES and case not in instruments:
        raise UserError(f"case = {case!r} must be one of {', '.join([*CASES, *instruments])}")
    ends = {"target_error": target_error, "max_time": max_time}
    tasks: Tasks = {
        (name, integrator): {"case": name, "integrator": integrator, "quick": quick, **ends}
        for name in ([case] if case else list(QUICK_CASES if quick else (*CASES, *instruments)))
        for integrator in INTEGRATORS[: None if name in CASES else 1]
    }
    run_processes("integrators", ("case", "integrator"), tasks, _COLUMNS, json)


@alone
def measure(
    case: str, integrator: str, quick: bool, target_error: float | None, max_time: float | None
) -> dict[str, float]:
    """Measure one case with one integrator in this process.

    Rates and times belong to the passes after the first one, which also compiles. The figure of merit is 1 / (median
    relative variance x CPU time) of the waveform's bins.
    """
    from mitransient_lidar.loading.scenes import choose_integrator
    from mitransient_lidar.rendering.render import render
    from mitransient_lidar.transport.scene_parts import lidar_sensor

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
    peak = peak_mb()
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
    from mitransient_lidar.loading.catalogue import scene_text
    from mitransient_lidar.loading.scenes import open_scene

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
    import drjit as dr
    import mitsuba as mi

    from mitransient_lidar.transport.rng import pass_streams

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


if __name__ == "__main__":
    answer(measure)
