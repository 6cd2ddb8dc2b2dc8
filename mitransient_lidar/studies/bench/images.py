"""Image benchmark: the cost of a gate on the bottom against the number of pixels."""

from __future__ import annotations

import tempfile
import time
from pathlib import Path
from typing import Any

import numpy as np

from mitransient_lidar.studies.bench.processes import Tasks, answer, peak_mb, run_processes

#: Layouts whose cost is measured.
LAYOUTS = ("2x2", "8x8", "32x32", "128x128", "256x256")

#: Median relative error over the lit pixels of the gate on the bottom at which a render ends.
TARGET_ERROR = 0.1

#: A pixel is lit with this share of the brightest energy (99th percentile).
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


def run(*, json: bool = False) -> None:
    """Measure each layout in its own process; print a table or one JSON object to stdout.

    Scene: the table system over a bottom at 8 m below a sea at 3 m/s, c = 0.3 /m, 64 gates of 10 ns, 1.5 ns apart. A
    render ends when the gate on the bottom is known to 10 %.
    """
    tasks: Tasks = {(layout,): {"layout": layout} for layout in LAYOUTS}
    run_processes("images", ("layout",), tasks, _COLUMNS, json)


def measure(layout: str) -> dict[str, float]:
    """Measure one layout in this process.

    ``wall_s`` is the render time with compilation, and ``render_s`` the time of the passes after the first two.
    """
    from mitransient_lidar.loading.catalogue import scene_text
    from mitransient_lidar.rendering.render import render

    marks: list[float] = []
    with tempfile.TemporaryDirectory() as folder:
        path = Path(folder) / "images.xml"
        path.write_text(scene_text(_SCENE).replace('<film type="time_gated_film">', _GATES))
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
        "peak_mb": peak_mb(),
    }


def _bottom_error(result: Any) -> float:
    """Return the median relative error over the lit pixels in the gate about the bottom echo."""
    bottom = result.attrs["surface_time_ns"] + 8.0 * 9.24576
    gate = int(np.argmin(np.abs(result["gate_start"].values + 0.5 * result["gate_width"].values - bottom)))
    energy, stderr = (result[name].values[..., gate].ravel() for name in ("gate_energy", "gate_energy_stderr"))
    lit = energy > _LIT * np.percentile(energy, 99)
    return float(np.median(stderr[lit] / energy[lit]))


if __name__ == "__main__":
    answer(measure)
