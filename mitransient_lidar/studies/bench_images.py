"""Benchmark of images: what a gate on the bottom costs as the pixels become more."""

from __future__ import annotations

import json as json_module
import resource
import subprocess
import sys
import tempfile
import time
from pathlib import Path
from typing import Any

import numpy as np

from mitransient_lidar.core.errors import UserError

#: Layouts whose cost is measured.
LAYOUTS = ("2x2", "8x8", "32x32", "128x128", "256x256")

#: Error of the gate on the bottom at which a render ends, in the median over the lit pixels.
TARGET_ERROR = 0.1

#: A pixel is lit with this share of the energy of the brightest (99th percentile).
_LIT = 0.05

_SCENE = "fig09_2x2"
_GATES = """<film type="time_gated_film">
            <float name="gate_start_ns" value="1411"/>
            <float name="gate_width_ns" value="10"/>
            <float name="gate_step_ns" value="1.5"/>
            <integer name="gate_count" value="64"/>"""
_RECORD = {"bin_width_ns": "0.5", "bin_count": "320"}

_COLUMNS = {
    "pixels": "pixels",
    "wall_s": "wall s",
    "render_s": "render s",
    "passes": "passes",
    "bottom_error": "error",
    "per_pixel_ms": "ms/pixel",
    "peak_mb": "peak MB",
}


def run(*, json: bool = False) -> dict[str, dict[str, float]]:
    """Measure each layout in a process of its own, and print a table or one JSON object to stdout.

    The table system with a bottom at 8 m below a sea at 3 m/s, c = 0.3 /m, 64 gates of 10 ns, 1.5 ns apart. A render
    ends when the gate on the bottom is known to 10 %.

    Returns
    -------
    dict
        ``{layout: {pixels, wall_s, render_s, passes, bottom_error, per_pixel_ms, peak_mb}}``; wall_s is from the
        start of the render to its result, compiling included, render_s that of the passes after the first two.

    Raises
    ------
    UserError
        When a process fails.
    """
    figures: dict[str, dict[str, float]] = {}
    if not json:
        print(_row("layout", list(_COLUMNS.values())))
    for layout in LAYOUTS:
        done = subprocess.run(
            [sys.executable, "-m", "mitransient_lidar.studies.bench_images", layout],
            check=False,
            stdout=subprocess.PIPE,
            text=True,
        )
        if done.returncode:
            raise UserError(f"layout {layout} ended with exit code {done.returncode}")
        figures[layout] = json_module.loads(done.stdout)
        if not json:
            print(_row(layout, [f"{figures[layout][key]:.4g}" for key in _COLUMNS]), flush=True)
    if json:
        print(json_module.dumps(figures, indent=2))
    return figures


def _row(layout: str, cells: list[str]) -> str:
    return f"{layout:<8} " + " ".join(f"{cell:>9}" for cell in cells)


def measure(layout: str) -> dict[str, float]:
    """Measure one layout in this process; see `run` for the figures."""
    from mitransient_lidar.loading.catalogue import scene_text
    from mitransient_lidar.rendering.render import render

    marks: list[float] = []

    def progress(_: Any) -> None:
        marks.append(time.perf_counter())

    with tempfile.TemporaryDirectory() as folder:
        path = Path(folder) / "images.xml"
        path.write_text(scene_text(_SCENE).replace('<film type="time_gated_film">', _GATES))
        start = time.perf_counter()
        passes, error = 8, np.inf
        # The goal is that of one gate, so the number of passes is found first from a few.
        for _ in range(2):
            marks.clear()
            start = time.perf_counter()
            result = render(path, params={"layout": layout, **_RECORD}, passes=passes, seed=1, progress=progress)
            wall = time.perf_counter() - start
            error = _bottom_error(result)
            wanted = max(2, int(np.ceil(passes * (error / TARGET_ERROR) ** 2)))
            if wanted <= passes:
                break
            passes = wanted + 1
    pixels = int(np.prod([result.sizes[dim] for dim in ("row", "column", "pixel") if dim in result.sizes]))
    return {
        "pixels": pixels,
        "wall_s": wall,
        "render_s": marks[-1] - marks[1] if len(marks) > 2 else 0.0,
        "passes": passes,
        "bottom_error": error,
        "per_pixel_ms": 1e3 * wall / pixels,
        "peak_mb": resource.getrusage(resource.RUSAGE_SELF).ru_maxrss / 1024,
    }


def _bottom_error(result: Any) -> float:
    """Return the median relative error over the lit pixels of the gate about the bottom's echo."""
    bottom = result.attrs["surface_time_ns"] + 8.0 * 9.24576
    gate = int(np.argmin(np.abs(result["gate_start"].values + 0.5 * result["gate_width"].values - bottom)))
    energy, stderr = (result[name].values[..., gate].ravel() for name in ("gate_energy", "gate_energy_stderr"))
    lit = energy > _LIT * np.percentile(energy, 99)
    return float(np.median(stderr[lit] / energy[lit]))


if __name__ == "__main__":
    print(json_module.dumps(measure(sys.argv[1])))
