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
from collections.abc import Iterator
from pathlib import Path
from typing import Any

import numpy as np
from input_files import KINDS

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


DAMAGE = {"bytes": damage_bytes, "text": damage_text, "attributes": damage_attributes}


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
                DAMAGE[KINDS[name].format](path, rng)
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
