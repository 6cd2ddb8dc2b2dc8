"""Narrow beam benchmark: figure of merit against divergence, field of view, water and sea."""

from __future__ import annotations

import time
from typing import Any

import numpy as np

from mitransient_lidar.studies.bench.integrators import TURBID
from mitransient_lidar.studies.bench.processes import Tasks, answer, run_processes

#: Divergences [mrad], views over the divergence, and the largest view [mrad].
DIVERGENCES = (0.1, 0.25, 0.5, 1.0, 2.5, 5.0, 10.0, 20.0)
VIEWS = (2, 5, 10, 20, 50, 100)
_LARGEST_VIEW = 100.0

#: Reference beam and view [mrad].
REFERENCE = (10.0, 30.0)

WATERS = {"clear": {}, "turbid": TURBID}
SEAS = {"flat": {"spectrum": "flat"}, "waves": {}}

_SCENE, _WIND = "table1", {"wind_speed": "6"}

#: Passes after the first one, which compiles.
_PASSES = 16

_COLUMNS = {"figure_of_merit": "1/(var s)", "ratio": "of 10 in 30", "cpu_s": "CPU s/pass"}


def run(*, json: bool = False) -> None:
    """Measure each water and sea in its own process; print a table or one JSON object to stdout.

    Scene: the table system over a bottom at 8 m, 2x2 pixels, 1 ns bins, a flat sea with 6 m/s ripples or 6 m/s waves.
    The figure of merit is 1 / (median relative variance x CPU time) of the waveform's bins from the surface echo to the
    end of the bottom echo.
    """
    tasks: Tasks = {(water, sea): {"water": water, "sea": sea} for water in WATERS for sea in SEAS}
    run_processes("beams", ("water", "sea"), tasks, _COLUMNS, json, "beams")


def measure(water: str, sea: str) -> dict[str, dict[str, float]]:
    """Measure all beams in one water and sea in this process; return the figures by beam and view."""
    reference = _measure(*REFERENCE, water, sea)
    figures = {f"{REFERENCE[0]:g} in {REFERENCE[1]:g}": {**reference, "ratio": 1.0}}
    for divergence in DIVERGENCES:
        for view in VIEWS:
            if divergence * view <= _LARGEST_VIEW:
                found = _measure(divergence, divergence * view, water, sea)
                found["ratio"] = found["figure_of_merit"] / reference["figure_of_merit"]
                figures[f"{divergence:g} in {divergence * view:g}"] = found
    return figures


def _measure(divergence: float, view: float, water: str, sea: str) -> dict[str, float]:
    """Measure one beam and view [mrad]."""
    from mitransient_lidar.rendering.render import render

    beam = {"divergence_mrad": f"{divergence:g}", "field_of_view_mrad": f"{view:g}"}
    marks: list[float] = []
    result: Any = render(
        _SCENE,
        params={**_WIND, **WATERS[water], **SEAS[sea], **beam},
        passes=1 + _PASSES,
        seed=1,
        progress=lambda _: marks.append(time.process_time()),
    )
    cpu = marks[-1] - marks[0]
    moment = result["time"].values
    window = (moment >= result.attrs["window_start_ns"]) & (moment <= result.attrs["window_end_ns"])
    waveform, stderr = (result[name].values[:, window] for name in ("waveform", "waveform_stderr"))
    variance = float(np.median((stderr / waveform) ** 2))
    return {"figure_of_merit": 1 / (variance * cpu), "cpu_s": cpu / _PASSES}


if __name__ == "__main__":
    answer(measure)
