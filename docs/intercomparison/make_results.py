"""Render the cases of the intercomparison with both integrators, and write their energies by gate.

``python docs/intercomparison/make_results.py [CASE ...] [--integrator NAME] [-o docs/intercomparison/results]``
writes ``results/INTEGRATOR/CASE.csv`` and ``.nc``. The case ``waves`` is a mean over as many seas as there are passes.
"""

from __future__ import annotations

import argparse
import csv
import re
import tempfile
import time
from pathlib import Path

import numpy as np
import numpy.typing as npt
import xarray as xr

import mitransient_lidar
from mitransient_lidar.loading.scenes import choose_integrator, open_scene

HERE = Path(__file__).parent
#: Independent passes of a case, of which `waves` has one for each sea.
PASSES = 32
#: Options of the integrators. Points of `lidar_merging` lie closer than the gates, whose energies would be correlated.
INTEGRATORS: dict[str, dict[str, float]] = {
    "lidar_merging": {"point_spacing": 0.1, "paths_per_pass": 2**13, "photons_per_pass": 2**13},
    "lidar_volpath": {"paths_per_pass": 2**17},
}
#: Options of a case, in place of these: cells fine against the mean free path of the cloud, and no draws towards the
#: laser where light scatters hundreds of times, as each costs variance; automatic
#: points for the sea, as the spread between seas decides its errors.
OPTIONS: dict[tuple[str, str], dict[str, float]] = {
    ("orbit", "lidar_merging"): {"point_spacing": 0.2},
    ("waves", "lidar_merging"): {"point_spacing": 0.0},
    ("waves", "lidar_volpath"): {"paths_per_pass": 2**15},
    ("cloud", "lidar_merging"): {
        "point_spacing": 0.0075,
        "cell_size": 0.01,
        "paths_per_pass": 2**11,
        "photons_per_pass": 2**11,
    },
    ("cloud", "lidar_volpath"): {"guiding_probability": 0.0, "roulette_threshold": 0.5, "paths_per_pass": 2**14},
}
#: Cases in which `lidar_volpath` renders a wide beam in a narrow view instead of a narrow beam in a wide view: both are
#: top hats, lidar light is reversible, and paths from the receiver rarely meet a narrow beam.
EXCHANGED = "wide_view", "narrow_view", "cloud"
#: First seed of the seas of each integrator, so that their results are independent.
FIRST_SEA = {"lidar_merging": 1, "lidar_volpath": 1001}


def read_cases() -> dict[str, dict[str, str]]:
    """Return each case's parameters, as text; parameters that a case does not use are left out."""
    with (HERE / "cases.csv").open(newline="") as file:
        rows = list(csv.DictReader(file))
    names = [name for name in rows[0] if name not in ("parameter", "unit", "meaning")]
    return {name: {row["parameter"]: row[name] for row in rows if row[name]} for name in names}


def gate_edges(case: dict[str, str]) -> npt.NDArray[np.float64]:
    """Return the edges of the gates [ns]."""
    return float(case["time_start_ns"]) + float(case["bin_width_ns"]) * np.arange(int(case["bin_count"]) + 1)


def exchanged(text: str) -> tuple[str, float]:
    """Return a scene with beam and view angles exchanged, and its energies' factor."""
    angles = [re.search(rf'"{key}" value="([^"]*)"', text) for key in ("divergence_mrad", "field_of_view_mrad")]
    beam, view = (float(found[1]) for found in angles if found)
    for key, value in (("divergence_mrad", view), ("field_of_view_mrad", beam)):
        text = re.sub(rf'("{key}" value=)"[^"]*"', rf'\1"{value:g}"', text)
    return text, (view / beam) ** 2


def render(name: str, integrator: str, passes: int = PASSES) -> npt.NDArray[np.float64]:
    """Return independent passes' energies [J], shape (passes, gates)."""
    path, factor = HERE / "cases" / f"{name}.xml", 1.0
    with tempfile.TemporaryDirectory() as folder:
        if integrator == "lidar_volpath" and name in EXCHANGED:
            text, factor = exchanged(path.read_text())
            path = Path(folder) / path.name
            path.write_text(text)
        energies = render_file(path, integrator, name, passes)
    return factor * energies


def render_file(path: Path, integrator: str, name: str, passes: int) -> npt.NDArray[np.float64]:
    """Return the energies [J] in a scene file's passes, shape (passes, gates), with a case's options."""
    options = {"type": integrator, **INTEGRATORS[integrator], **OPTIONS.get((name, integrator), {})}
    renderer, found = None, []
    for number in range(passes):
        if renderer is None or name == "waves":
            sea = {"surface_seed": FIRST_SEA[integrator] + number} if name == "waves" else None
            session = open_scene(path, sea)
            renderer = choose_integrator(session.scene, options).prepare(session.scene, session.sensor)
        found.append(renderer.render_pass(number).histogram.energy()[0])
    return np.asarray(found, dtype=np.float64)


def write(directory: Path, name: str, edges: npt.NDArray[np.float64], energies: npt.NDArray[np.float64]) -> None:
    """Write mean and standard error of passes, shape (passes, gates), as CSV, and the passes as NetCDF."""
    directory.mkdir(parents=True, exist_ok=True)
    mean, error = energies.mean(axis=0), energies.std(axis=0, ddof=1) / np.sqrt(len(energies))
    table = np.column_stack([edges[:-1], edges[1:], mean, error])
    heading = "gate_start_ns,gate_end_ns,energy_j,stderr_j"
    np.savetxt(
        directory / f"{name}.csv", table, delimiter=",", header=heading, comments="", fmt="%.10g,%.10g,%.6e,%.3e"
    )
    xr.Dataset(
        {"energy": (("pass", "gate"), energies.astype(np.float32), {"units": "J", "long_name": "received energy"})},
        {"gate_start": ("gate", edges[:-1], {"units": "ns"}), "gate_end": ("gate", edges[1:], {"units": "ns"})},
        {"case": name, "integrator": directory.name, "version": mitransient_lidar.__version__},
    ).to_netcdf(directory / f"{name}.nc", encoding={"energy": {"zlib": True, "complevel": 9, "shuffle": True}})


def main() -> None:
    """Render the cases."""
    cases = read_cases()
    parser = argparse.ArgumentParser(description=__doc__.splitlines()[0])
    parser.add_argument("case", nargs="*", help="default: all")
    parser.add_argument("--integrator", choices=INTEGRATORS, action="append", help="default: both")
    parser.add_argument("-o", "--output", type=Path, default=HERE / "results")
    options = parser.parse_args()
    for name in options.case or cases:
        for integrator in options.integrator or INTEGRATORS:
            start = time.perf_counter()
            energies = render(name, integrator)
            write(options.output / integrator, name, gate_edges(cases[name]), energies)
            error = energies.std(axis=0, ddof=1) / np.sqrt(len(energies)) / energies.mean(axis=0)
            print(
                f"{name}, {integrator}: {time.perf_counter() - start:.0f} s, relative standard error of a gate: median "
                f"{100 * np.nanmedian(error):.2f} %, largest {100 * np.nanmax(error):.1f} %",
                flush=True,
            )


if __name__ == "__main__":
    main()
