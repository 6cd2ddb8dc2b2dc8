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
import tomllib
from dataclasses import dataclass
from pathlib import Path

ROOT = Path(__file__).resolve().parents[1]
TABLE = Path(__file__).with_suffix(".toml")

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


#: The faults of the table beside this script.
FAULTS = tuple(Fault(name, **about) for name, about in tomllib.loads(TABLE.read_text("utf-8")).items())


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
