"""Benchmark: how fast the integrators are, and how accurate for their time.

Every case and integrator runs in a process of its own, so that peak memory and compile time are its own.
"""

from __future__ import annotations

import json as json_module
import resource
import statistics
import subprocess
import sys
import tempfile
import time
from pathlib import Path
from typing import TYPE_CHECKING

import numpy as np

from mitransient_lidar.core.errors import UserError
from mitransient_lidar.core.validation import positive

if TYPE_CHECKING:
    import mitsuba as mi

    from mitransient_lidar.transport.passes import PassRenderer

#: Parameters that turn a shipped scene into each case: (scene, parameters).
CASES: dict[str, tuple[str, dict[str, str]]] = {
    "flat": ("fig09_2x2", {"spectrum": "flat"}),
    "clear": ("fig09_2x2", {}),
    "turbid": ("fig09_2x2", {"attenuation": "1.5", "scattering": "1.2", "backscattering": "0.024"}),
    "layered": (
        "fig09_2x2",
        {
            "layer_tops": "0, 3",
            "attenuation": "0.9, 0.5",
            "scattering": "0.7, 0.35",
            "backscattering": "0.014, 0.007",
            "field_of_view_mrad": "35",
        },
    ),
    "target": ("fig09_2x2", {"field_of_view_mrad": "35", "bottom_depth": "12", "bin_count": "190"}),
    "imager": ("fig09_2x2", {"layout": "128x128", "bin_width_ns": "2", "bin_count": "64", "time_start_ns": "1400"}),
}

#: What the case ``target`` has beside its scene: a plate of 1.5 m x 1.5 m at 8 m depth.
_TARGET = """
    <shape type="rectangle" id="target">
        <transform name="to_world"><scale value="0.75"/><translate z="-8"/></transform>
        <bsdf type="diffuse"><spectrum name="reflectance" value="0.1"/></bsdf>
    </shape>
</scene>"""

#: Cases of ``--quick``.
QUICK_CASES = ("flat", "clear")

INTEGRATORS = ("lidar_merging", "lidar_volpath")

#: Passes after the first one, which compiles.
_QUICK_PASSES = 16
_PASSES = 64


def run(
    *, quick: bool = False, json: bool = False, case: str | None = None, target_error: float | None = None
) -> dict[str, dict[str, dict[str, float]]]:
    """Run the benchmark and print its figures to stdout.

    Parameters
    ----------
    quick
        Only the cases ``flat`` and ``clear``, with few passes.
    json
        Print one JSON object instead of a table.
    case
        Only this case.
    target_error
        Go on until the 95th percentile of the relative standard error has come down to this, greater than 0.

    Returns
    -------
    dict
        ``{case: {integrator: {wall_s, cpu_s, compile_s, paths_per_s, rays_per_s, ray_rate_ratio, peak_mb,
        error_median, error_p95, figure_of_merit}}}``.

    Raises
    ------
    UserError
        When the case is unknown or the target is not positive.
    """
    if case is not None and case not in CASES:
        raise UserError(f"case = {case!r} must be one of {', '.join(CASES)}")
    if target_error is not None:
        positive("target_error", target_error)
    names = [case] if case else list(QUICK_CASES if quick else CASES)
    figures: dict[str, dict[str, dict[str, float]]] = {}
    if not json:
        print(_row("case", "integrator", list(_COLUMNS.values())))
    for name in names:
        figures[name] = {}
        for integrator in INTEGRATORS:
            task = {"case": name, "integrator": integrator, "quick": quick, "target_error": target_error}
            done = subprocess.run(
                [sys.executable, "-m", "mitransient_lidar.studies.bench", json_module.dumps(task)],
                check=False,
                stdout=subprocess.PIPE,
                text=True,
            )
            if done.returncode:
                raise UserError(f"case {name} with {integrator} ended with exit code {done.returncode}")
            figures[name][integrator] = json_module.loads(done.stdout)
            if not json:
                values = figures[name][integrator]
                print(_row(name, integrator, [f"{values[key]:.4g}" for key in _COLUMNS]), flush=True)
    if json:
        print(json_module.dumps(figures, indent=2))
    return figures


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


def _row(case: str, integrator: str, cells: list[str]) -> str:
    return f"{case:<8} {integrator:<14} " + " ".join(f"{cell:>10}" for cell in cells)


def measure(case: str, integrator: str, quick: bool, target_error: float | None) -> dict[str, float]:
    """Measure one case with one integrator in this process; see `run` for the figures.

    Rates and times are those of the passes after the first one, which also compiles. The figure of merit is
    1 / (median relative variance x CPU time) of the waveform's bins.
    """
    from mitransient_lidar.rendering.render import render
    from mitransient_lidar.rendering.session import choose_integrator

    marks: list[tuple[float, float]] = []

    def progress(_: object) -> None:
        marks.append((time.perf_counter(), time.process_time()))

    loaded = _load(case)
    passes = None if target_error else 1 + (_QUICK_PASSES if quick else _PASSES)
    start = time.perf_counter()
    result = render(
        loaded,
        integrator=integrator,
        passes=passes,
        target_error=target_error,
        max_time=120.0 if target_error else None,
        progress=progress,
    )
    peak = resource.getrusage(resource.RUSAGE_SELF).ru_maxrss / 1024
    renderer = choose_integrator(loaded, integrator).prepare(loaded, loaded.sensors()[0])
    times = np.array(marks)
    steps = np.diff(times[:, 0])
    warm = len(steps)
    wall, cpu = times[-1] - times[0]
    relative_variance = result.attrs["error_median"] ** 2
    rays = float(renderer.render_pass(0).rays[0]) * warm
    return {
        "wall_s": float(wall),
        "cpu_s": float(cpu),
        "compile_s": float(marks[0][0] - start - statistics.median(steps)),
        "paths_per_s": renderer.paths * warm / float(wall),
        "rays_per_s": rays / float(wall),
        "ray_rate_ratio": rays / float(wall) / _plain_ray_rate(renderer),
        "peak_mb": peak,
        "error_median": result.attrs["error_median"],
        "error_p95": result.attrs["error_p95"],
        "figure_of_merit": 1 / (relative_variance * float(cpu)),
    }


def _load(case: str) -> mi.Scene:
    """Load the scene of a case."""
    from mitransient_lidar.loading.catalogue import scene_text
    from mitransient_lidar.loading.scenes import load_scene

    name, parameters = CASES[case]
    if case != "target":
        return load_scene(name, parameters)[0]
    with tempfile.TemporaryDirectory() as folder:
        path = Path(folder) / "target.xml"
        path.write_text(scene_text(name).replace("</scene>", _TARGET))
        return load_scene(path, parameters)[0]


def _plain_ray_rate(renderer: PassRenderer) -> float:
    """Return how many rays a second plain ``ray_intersect`` traces from the receiver in the same scene."""
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
    # The first one compiles.
    return statistics.median(rates[1:])


if __name__ == "__main__":
    print(json_module.dumps(measure(**json_module.loads(sys.argv[1]))))
