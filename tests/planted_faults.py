"""Power of the test suite: plant faults, one at a time, in a copy of the repository, and run the tests there.

Run by hand, in the environment that the package is developed in::

    .venv/bin/python tests/planted_faults.py --check              # whether all faults still apply
    .venv/bin/python tests/planted_faults.py --control            # the whole measurement, in hours
    .venv/bin/python tests/planted_faults.py one_bin_late --tier quick
    .venv/bin/python tests/planted_faults.py --near --tier quick  # tests of the same room, in minutes

Progress goes to stderr and a Markdown table to stdout. A fault counts as found when a test fails that passes without
it. Tests that cannot be collected or fail anyway, crashes of pytest and stages that take too long are errors. The
slow tier runs where the quick one found nothing.
"""

from __future__ import annotations

import argparse
import ast
import os
import re
import shutil
import signal
import subprocess
import sys
import tempfile
import time
from dataclasses import dataclass
from pathlib import Path

ROOT = Path(__file__).resolve().parents[1]

TIERS = {"quick": "not slow and not long", "slow": "slow and not long"}

#: Arguments of pytest that select the tests of each stage: those that find most come first.
_REST = ("tests", "--ignore=tests/analytic", "--ignore=tests/sampling")
STAGES = (("tests/analytic",), ("tests/sampling",), _REST)

#: Exit statuses of pytest: tests failed; or it stopped, as pytest-xdist does at the first failure.
_PASSED, _FAILED, _STOPPED, _INTERNAL_ERROR, _NO_TESTS = 0, 1, 2, 3, 5

#: Prints where the packages that the tests import are.
_WHERE = (
    "import mitransient_lidar, mitransient_lidar.scenes as scenes, mitransient_lidar.plugins.ocean_surface as plugin;"
    "print(mitransient_lidar.__file__, scenes.__file__, plugin.__file__, sep='\\n')"
)


@dataclass(frozen=True)
class Fault:
    """A fault: a text in a file that is replaced by another one, the number of its places, and tests of its room."""

    name: str
    file: str
    old: str
    new: str
    count: int = 1
    near: str = "tests/analytic/test_closed_forms.py"

    def planted(self, text: str) -> str:
        """Return the faulty text of the file; end the script where the fault does not apply."""
        found = text.count(self.old)
        if found != self.count:
            sys.exit(f"fault {self.name}: its text occurs {found} times in {self.file}, not {self.count}: {self.old!r}")
        return text.replace(self.old, self.new)


_T, _P, _A, _R, _G = (f"mitransient_lidar/{name}" for name in ("transport", "physics", "analysis", "results", "plots"))
_M, _UNIT = f"{_T}/merging", "tests/unit"
_FIGURES = f"{_UNIT}/plots/test_figures.py"

FAULTS = (
    # Radiance is connected to the laser through the surface without the square of the refractive index.
    Fault(
        *("radiance_without_index_squared", f"{_T}/paths/refracted_connection.py"),
        "si.bsdf().eval(mi.BSDFContext(), scene.on_shapes(si), si.to_local(direction)",
        "si.bsdf().eval(mi.BSDFContext(mi.TransportMode.Importance), scene.on_shapes(si), si.to_local(direction)",
    ),
    # The cosine of the photon stays in the BSDF of merges on solids.
    Fault("cosine_at_the_bottom", f"{_M}/merge.py", "outgoing, within)[0] / cosine", "outgoing, within)[0]"),
    Fault(
        *("merged_light_2_percent_more", f"{_M}/merge.py"),
        "= points.throughput * typical / cell",
        "= 1.02 * points.throughput * typical / cell",
        count=2,
    ),
    Fault(
        "phase_index_times_water_leg",
        f"{_T}/paths/volpath.py",
        "to_surface * opaque(scene.group",
        "to_surface * opaque(scene.refractive",
    ),
    # All photons enter the water.
    Fault(
        *("no_fresnel_at_entry", f"{_T}/paths/random_walk.py"),
        "sample(step.context, self.scene.on_shapes(si), pick, u, vertex.on_surface)",
        "sample(step.context, si, dr.select(vertex.at_sea & step.adjoint, 1, pick), u, vertex.on_surface)",
    ),
    Fault(
        "one_bin_late", f"{_T}/paths/histogram.py", "minimum(mi.UInt32(position),", "minimum(mi.UInt32(position) + 1,"
    ),
    # The last part of a segment that crosses edges has the coefficient of the layer where it starts.
    Fault("layer_above_its_edge", f"{_T}/medium/free_flight.py", "downward * self.coefficient(end)", "downward * here"),
    # The balance heuristic of beam and view takes the view for 3 % smaller than it is.
    Fault(
        "share_of_photons_in_view",
        f"{_T}/laser.py",
        "opaque(count // 2 / count)",
        "opaque(0.97 * (count // 2) / count)",
        near="tests/sampling",
    ),
    Fault("absorption_twice_up_to_points", f"{_M}/segments.py", "dr.exp(-absorption)", "dr.exp(-2 * absorption)"),
    Fault(
        *("left_and_right_exchanged", f"{_T}/sensor/pixels.py"),
        "across = (opaque(0.5 * width) - angle_y)",
        "across = (angle_y + opaque(0.5 * width))",
        near="tests/sampling",
    ),
    Fault(
        "efficiency_squared", f"{_T}/sensor/receiver.py", "self.optical_efficiency *", "self.optical_efficiency**2 *"
    ),
    Fault("half_of_the_group_delay", f"{_M}/segments.py", "length + along * group", "length + 0.5 * along * group"),
    Fault("obscuration_squared", f"{_T}/sensor/receiver.py", "(1 - self.obscuration)", "(1 - self.obscuration**2)"),
    # Probes of the covered share of a patch do not reach the lower half of its level.
    Fault(
        "short_probe_of_patches",
        f"{_M}/patches.py",
        "ray.maxt = patch.height",
        "ray.maxt = 0.5 * patch.height",
        near="tests/analytic/test_merging.py",
    ),
    Fault(
        "index_without_square_in_layers",
        f"{_T}/paths/path.py",
        "& passes, ratio * ratio, 1)",
        "& passes, ratio, 1)",
        near="tests/analytic/test_strata.py",
    ),
    Fault(
        *("no_complement", f"{_M}/renderer.py"),
        "        trace_connected(scene, self.sampler, complement, received, shots, paths)\n",
        "",
        near="tests/analytic/test_agreement.py",
    ),
    Fault("connections_absorb_3_percent_more", f"{_T}/paths/volpath.py", "dr.exp(-crossed)", "dr.exp(-1.03 * crossed)"),
    # Beckmann's alpha is the square root of twice the slope variance.
    Fault("ripples_without_root_2", "plugins/ocean_surface.py", "np.sqrt(2 * variance)", "np.sqrt(variance)"),
    # The ripples have the slope variance along the wind across it.
    Fault("ripples_across_the_wind", "plugins/ocean_surface.py", "return along, across", "return across, along"),
    # The weights of the two connections of the reference do not sum to one.
    Fault(
        *("balance_without_transmittance", f"{_T}/paths/volpath.py"),
        "transmittance / (transmittance + path.emitter_ratio)",
        "1 / (1 + path.emitter_ratio)",
        near="tests/analytic/test_estimator.py",
    ),
    # Light in a plume scatters at bubbles too often instead of the water, though as often in all.
    Fault(
        *("too_many_bubbles", f"{_T}/medium/water.py"),
        "() * (bubbles + flight.coefficient(layer)) <",
        "() * flight.coefficient(layer) <",
        near="tests/sampling",
    ),
    # Sampled phase functions have other values than evaluated ones.
    Fault(
        "sampled_phase_1_percent_more",
        f"{_T}/medium/tabulated_phase.py",
        "value * dr.select(even",
        "1.01 * value * dr.select(even",
        near="tests/sampling",
    ),
    # The response of pulse and receiver is reversed in time, which only an uneven one shows.
    Fault(
        "reversed_response_of_gates",
        f"{_P}/lidar/gate_train.py",
        "(gate, kernel[::-1])",
        "(gate, kernel)",
        near=f"{_UNIT}/physics/lidar",
    ),
    # The sky that the sea reflects counts twice.
    Fault(
        *("reflected_sky_twice", f"{_T}/daylight/renderer.py"),
        "dr.select(path.reflected_by_sea, 0, scene.sky_radiance(path.direction))",
        "scene.sky_radiance(path.direction)",
        near="tests/analytic/test_passive.py",
    ),
    # Light that survives a reflection by a solid is weakened by its reflectance, too.
    Fault(
        "roulette_without_compensation",
        f"{_T}/paths/random_walk.py",
        "factor / survival, bs",
        "factor, bs",
        near="tests/analytic/test_agreement.py",
    ),
    Fault(*("far_row_below", f"{_G}/drawing.py"), 'origin="upper"', 'origin="lower"', near=_FIGURES),
    Fault(
        *("depth_below_the_laser", f"{_G}/waveforms.py"),
        "ax, -zero * metres_per_ns",
        "ax, zero * metres_per_ns",
        near=_FIGURES,
    ),
    Fault(
        *("left_of_layouts_on_the_right", f"{_G}/layout.py"),
        "xlim=(high[0], low[0])",
        "xlim=(low[0], high[0])",
        near=_FIGURES,
    ),
    Fault(*("even_bands", f"{_G}/drawing.py"), "lowest), y + above", "lowest), y + below", near=_FIGURES),
    Fault(*("black_for_blue", f"{_G}/palette.py"), '"#014c7f", "#111111")', '"#111111", "#014c7f")', near=_FIGURES),
    Fault(
        *("share_of_lost_bottoms", f"{_G}/campaigns.py"),
        "(flags & _NO_ECHO) == 0",
        "(flags & _NO_ECHO) != 0",
        near=_FIGURES,
    ),
    Fault(
        *("gates_of_one_pulse", f"{_A}/gates/cut.py"),
        "= train.pulses * time.bin_width_ns",
        "= time.bin_width_ns",
        near=f"{_UNIT}/analysis/gates",
    ),
    Fault(
        *("depths_of_gate_starts", f"{_R}/gate_stack.py"),
        "depth_of_time(train.middles_ns)",
        "depth_of_time(train.starts_ns)",
        near=f"{_UNIT}/analysis/gates",
    ),
    Fault(
        *("ranges_from_gate_starts", f"{_A}/gates/range_images.py"),
        '    middles = stack["gate_start"].values + 0.5 * stack["gate_width"].values',
        '    middles = stack["gate_start"].values',
        near=f"{_UNIT}/analysis/gates",
    ),
    Fault(
        *("other_gps_time", "mitransient_lidar/flights/las.py"),
        '(_time_system(points) == "gps")',
        '(_time_system(points) == "adjusted_gps")',
        near=f"{_UNIT}/flights",
    ),
    Fault(
        *("scan_angle_to_the_other_side", "mitransient_lidar/flights/las.py"),
        "np.round(angle / _SCAN",
        "np.round(-angle / _SCAN",
        near=f"{_UNIT}/flights",
    ),
    Fault(
        *("five_digits_in_tables", f"{_A}/waveforms/csv_tables.py"),
        "path, digits=9)",
        "path, digits=5)",
        near=f"{_UNIT}/analysis/waveforms",
    ),
    Fault(
        *("last_bin_first_in_exr", f"{_R}/exr.py"),
        "enumerate(images):",
        "enumerate(images[::-1]):",
        near=f"{_UNIT}/results",
    ),
    Fault(
        *("attenuation_of_one_way", f"{_A}/waveforms/echo_table.py"),
        "per_metre = 0.5 / waveforms",
        "per_metre = 1.0 / waveforms",
        near=f"{_UNIT}/analysis/waveforms",
    ),
    Fault(
        *("correction_added", f"{_A}/waveforms/depth_correction.py"),
        'found["depth_m"] - correction',
        'found["depth_m"] + correction',
        near=f"{_UNIT}/analysis/waveforms",
    ),
    Fault(
        *("turned_to_the_other_side", f"{_A}/waveforms/depth_correction.py"),
        "azimuth[:, np.newaxis] - turn_deg",
        "azimuth[:, np.newaxis] + turn_deg",
        near=f"{_UNIT}/analysis/waveforms",
    ),
    Fault(
        *("slope_away_from_the_lidar", f"{_A}/retrieval/surface_slope.py"),
        "(a * np.sin(off_nadir)",
        "(-a * np.sin(off_nadir)",
        near=f"{_UNIT}/analysis/retrieval",
    ),
    Fault(
        *("crest_behind_the_sea_level", f"{_A}/waveforms/surface_times.py"),
        "(-height * per_metre",
        "(height * per_metre",
        near=f"{_UNIT}/analysis/waveforms",
    ),
    Fault(
        *("variances_of_area_exchanged", f"{_A}/detection/statistics.py"),
        "ddof=1) / m + np.var(below, ddof=1) / n",
        "ddof=1) / n + np.var(below, ddof=1) / m",
        near=f"{_UNIT}/analysis/detection",
    ),
    Fault(*("one_sided_limit", f"{_A}/comparison.py"), "ndtri(-0.5 * np", "ndtri(-np", near=f"{_UNIT}/analysis"),
    Fault(
        *("first_minus_second", f"{_A}/comparison.py"),
        "values[1] - values[0], np.nan",
        "values[0] - values[1], np.nan",
        near=f"{_UNIT}/analysis",
    ),
    Fault(
        *("parabola_turned", f"{_A}/detection/matched_filter.py"),
        "0.5 * (left - right)",
        "0.5 * (right - left)",
        near=f"{_UNIT}/analysis/detection",
    ),
    Fault(
        *("uncertainty_without_height", f"{_A}/depth_uncertainty.py"),
        "up**2 + trajectory.height_m**2",
        "up**2",
        near=f"{_UNIT}/analysis",
    ),
    Fault(
        *("bins_alone_twice", f"{_R}/sum_errors.py"), "(1 - np.diagonal", "(1 + np.diagonal", near=f"{_UNIT}/results"
    ),
    Fault(
        *("area_without_the_spread_of_targets", f"{_A}/detection/statistics.py"),
        "np.hypot(self.null_sd, self.target_sd)",
        "self.null_sd",
        near=f"{_UNIT}/analysis/detection",
    ),
    Fault(
        *("camera_without_efficiency", f"{_P}/receiver/camera.py"),
        "factor = self.quantum_efficiency * photons",
        "factor = photons",
        near=f"{_UNIT}/physics/receiver/test_camera.py",
    ),
    Fault(
        *("platform_to_the_left", f"{_P}/lidar/gate_train.py"),
        "[math.sin(heading), math.cos",
        "[-math.sin(heading), math.cos",
        near=f"{_UNIT}/physics/lidar/test_gate_sequence.py",
    ),
    Fault(
        *("frames_of_one_pulse", f"{_A}/gates/recording.py"),
        'int(dataset.attrs.get("pulses", 1)), "pat',
        '1, "pat',
        near=f"{_UNIT}/analysis/gates",
    ),
    Fault(
        "map_bottom_without_cosine",
        "mitransient_lidar/transport/light_maps/renderer.py",
        "dr.select(on_bed, value / -rays.direction.z, 0)",
        "dr.select(on_bed, value, 0)",
    ),
    Fault(
        "map_absorption_one_way",
        "mitransient_lidar/transport/light_maps/maps.py",
        "energy * density * dr.exp(-lost)",
        "energy * density",
    ),
    Fault(
        "map_scattering_one_way",
        "mitransient_lidar/transport/light_maps/renderer.py",
        "share = (1 - dr.exp(-2 * scattered))",
        "share = (1 - dr.exp(-scattered))",
        near="tests/analytic/test_light_maps.py",
    ),
    Fault(
        "map_detour_at_phase_index",
        "mitransient_lidar/transport/light_maps/renderer.py",
        "length + way + group_index * excess",
        "length + way + excess",
        near="tests/analytic/test_light_maps.py",
    ),
    Fault(
        "frames_add_up", f"{_A}/detection/images.py", ".mean() / frames", ".mean()", near=f"{_UNIT}/analysis/detection"
    ),
)


@dataclass(frozen=True)
class Outcome:
    """Result of a tier: ``found``, ``not found`` or ``error``, its time [s], and the first failed test or the cause."""

    result: str
    seconds: float
    cause: str = ""

    def __str__(self) -> str:
        return f"{self.result}, {self.seconds:.0f} s"


def snapshot(folder: Path) -> Path:
    """Copy the working tree, with its own git history and a package that holds plugins and scenes as installed."""

    def listed(*options: str) -> set[str]:
        command = ["git", "-C", str(ROOT), "ls-files", "-z", "--exclude-standard", *options]
        return set(subprocess.check_output(command, text=True).split("\0")) - {""}

    copy = folder / "pristine"
    subprocess.run(["git", "clone", "--quiet", "--shared", str(ROOT), str(copy)], check=True)
    for name in listed("--cached"):
        if not (ROOT / name).exists():
            (copy / name).unlink(missing_ok=True)
    for name in listed("--cached", "--others"):
        if (ROOT / name).is_file():
            (copy / name).parent.mkdir(parents=True, exist_ok=True)
            shutil.copy2(ROOT / name, copy / name)
    for name in ("plugins", "scenes"):
        (copy / "mitransient_lidar" / name).symlink_to(Path("..", name))
    with (copy / ".git" / "info" / "exclude").open("a") as excluded:
        excluded.write("/mitransient_lidar/plugins\n/mitransient_lidar/scenes\n")
    return copy


def run(command: list[str], copy: Path, log: Path, limit: float) -> int | None:
    """Run Python in a copy, whose package precedes the installed one; return the exit status, None after the limit."""
    # Finders of editable installs come last in sys.meta_path, so that PYTHONPATH wins, in subprocesses, too.
    environment = {**os.environ, "PYTHONPATH": str(copy)}
    with log.open("w") as output:
        streams = {"stdout": output, "stderr": subprocess.STDOUT}
        command = [sys.executable, *command]
        process = subprocess.Popen(command, cwd=copy, env=environment, start_new_session=True, **streams)
        try:
            return process.wait(limit)
        except subprocess.TimeoutExpired:
            return None
        finally:
            if process.poll() is None:
                os.killpg(process.pid, signal.SIGKILL)
                process.wait()


def run_tier(
    copy: Path, pristine: Path, tier: str, processes: int, limit: float, stages: tuple[tuple[str, ...], ...] = STAGES
) -> Outcome:
    """Run a tier's stages up to the first failure."""
    start, ran = time.monotonic(), False
    log = copy.with_suffix(f".{tier}.log")
    if run(["-c", _WHERE], copy, log, limit) != 0:
        return Outcome("error", time.monotonic() - start, "import")
    places = log.read_text().split()
    assert all(Path(place).is_relative_to(copy) for place in places), places
    options = ["-q", "-x", "-p", "no:cacheprovider", "-n", str(processes), "-m", TIERS[tier]]
    for stage in stages:
        status = run(["-m", "pytest", *options, *stage], copy, log, limit)
        if status == _INTERNAL_ERROR:
            # Rarely, pytest-xdist loses a test.
            status = run(["-m", "pytest", *options, *stage], copy, log, limit)
        seconds = time.monotonic() - start
        failed = re.findall(r"^(?:FAILED|ERROR) (\S+::.+?)(?: - .*)?$", log.read_text(errors="replace"), re.MULTILINE)
        # Files that cannot be collected stop it, too, but no test of them has failed.
        if status in (_FAILED, _STOPPED) and failed:
            again = ["-m", "pytest", "-q", "-p", "no:cacheprovider", "-n", "0", "-m", "", failed[0]]
            if run(again, pristine, log.with_suffix(".pristine.log"), limit) != _PASSED:
                return Outcome("error", seconds, f"fails without the fault, too: {failed[0]}")
            return Outcome("found", seconds, failed[0])
        if status not in (_PASSED, _NO_TESTS):
            return Outcome("error", seconds, "time limit" if status is None else f"exit status {status}")
        ran |= status == _PASSED
    return Outcome("not found" if ran else "error", time.monotonic() - start, "" if ran else "no tests")


def measure(
    fault: Fault | None, pristine: Path, tiers: list[str], processes: int, limit: float, keep: bool, near: bool = False
) -> dict[str, Outcome]:
    """Return the outcome of each tier that ran with a fault, or without one; `near` runs tests of its room alone."""
    name = "control" if fault is None else fault.name
    copy = pristine.with_name(name)
    shutil.copytree(pristine, copy, symlinks=True)
    if fault is not None:
        path = copy / fault.file
        path.write_text(fault.planted(path.read_text("utf-8")), "utf-8")
    stages = ((fault.near,),) if fault is not None and near else STAGES
    outcomes: dict[str, Outcome] = {}
    for tier in tiers:
        print(f"{name}: {tier} ...", end=" ", file=sys.stderr, flush=True)
        outcomes[tier] = outcome = run_tier(copy, pristine, tier, processes, limit, stages)
        print(outcome, outcome.cause, file=sys.stderr, flush=True)
        if outcome.result != "not found":
            break
    if not keep:
        shutil.rmtree(copy)
    return outcomes


def main() -> None:
    """Measure, and print the table."""
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("names", nargs="*", metavar="NAME", help="faults to plant; default: all")
    parser.add_argument("--check", action="store_true", help="check that all faults apply, and run no tests")
    parser.add_argument("--control", action="store_true", help="run the tests without a fault first: they must pass")
    parser.add_argument("--near", action="store_true", help="run the tests of the fault's room alone")
    parser.add_argument("--tier", choices=[*TIERS, "both"], default="both", help="tests to run; default: both")
    parser.add_argument("--keep", action="store_true", help="keep the copies and the output of pytest")
    parser.add_argument("-n", "--processes", type=int, default=2, help="processes of pytest; default: 2")
    parser.add_argument("--limit", type=float, default=3600.0, help="longest time of a stage [s]; default: 3600")
    given = parser.parse_args()
    for fault in FAULTS:
        ast.parse(fault.planted((ROOT / fault.file).read_text("utf-8")), fault.file)
    unknown = sorted(set(given.names) - {fault.name for fault in FAULTS})
    if unknown:
        parser.error(f"no such fault: {', '.join(unknown)}; there are {', '.join(fault.name for fault in FAULTS)}")
    if given.check:
        print(f"All {len(FAULTS)} faults apply.")
        return
    chosen = [fault for fault in FAULTS if not given.names or fault.name in given.names]
    tiers = list(TIERS) if given.tier == "both" else [given.tier]
    folder = Path(tempfile.mkdtemp(prefix="planted_faults_")).resolve()
    rows, found = [], []
    try:
        settings = (snapshot(folder), tiers, given.processes, given.limit, given.keep)
        if given.control:
            for tier, outcome in measure(None, *settings).items():
                if outcome.result != "not found":
                    sys.exit(f"without a fault the {tier} tier does not pass: {outcome.cause}")
        for fault in chosen:
            outcomes = measure(fault, *settings, near=given.near)
            last = list(outcomes.values())[-1]
            found += [tier for tier, outcome in outcomes.items() if outcome.result == "found"]
            cells = [str(outcomes.get(tier, "")) for tier in TIERS]
            rows.append(" | ".join(["", fault.name, fault.file, *cells, last.cause, ""]).strip())
    finally:
        if given.keep:
            print(f"copies and output: {folder}", file=sys.stderr)
        else:
            shutil.rmtree(folder, ignore_errors=True)
        if rows:
            print("| fault | file | quick | slow | found by |", "|---|---|---|---|---|", *rows, sep="\n")
            print(f"\n{len(found)} of {len(rows)} found, {found.count('quick')} by the quick tier")


if __name__ == "__main__":
    main()
