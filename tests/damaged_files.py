"""Damaged input: every reader of files, with thousands of files that are damaged at random or by intent.

Run by hand, in the environment that the package is developed in::

    .venv/bin/python tests/damaged_files.py --count 1000               # of every kind of file
    .venv/bin/python tests/damaged_files.py result_attributes --count 100 --first 40
    .venv/bin/python tests/damaged_files.py --others --count 200      # something else in place of the file

In place of a file, of one that it includes, or of one in its folder stand a named pipe, a device, a socket, a folder, a
link to one of these or to itself, or nothing; an HDF5 file has its values in one of these, or a link to it.

A file must be read, or refused with one sentence (`UserError`), within half a minute, or more on a busy machine.
Everything else is a finding: another exception, the end of the process by a signal, and a read that takes longer.
Findings go to stderr, each with the number that makes it again, and a Markdown table to stdout.
"""

from __future__ import annotations

import argparse
import contextlib
import faulthandler
import io
import json
import logging
import os
import random
import re
import shutil
import signal
import socket
import subprocess
import sys
import tempfile
import traceback
import warnings
from collections import Counter
from collections.abc import Iterator
from pathlib import Path
from typing import Any
from xml.etree import ElementTree

import h5py
import numpy as np
import xarray as xr
from input_files import KINDS

from mitransient_lidar.core.errors import UserError
from mitransient_lidar.core.parameters.catalogue import PLUGINS, limits

LIMIT_S = 30

#: Kinds of files with something else in their place have this behind their names.
OTHERS = " (others)"

#: What numbers and texts are replaced by.
_ODD_TEXTS = (
    *("nan", "inf", "-1", "0", "1e300", "-1e-300", "1e999", "", "x", "[]", "9" * 30, "true", "$x", "../a", "é", "'"),
)
_ODD_VALUES: tuple[Any, ...] = (
    *(np.nan, np.inf, -1.0, 0.0, 0, 1e300, -1e-300, 2**62, "", "x", "nan", "{", "[1", '{"a": 1}', "null"),
    *([], [1.0], [1.0, 2.0, 3.0], ["a", "b"], [np.nan, np.nan], "[" * 5000),
)

_EXTREMES = (-1e6, -1.0, 0.0, 1e-30, 1e-6, 1e-3, 1.0, 1e3, 1e6, 1e9, 1e30)


def damage_bytes(path: Path, rng: random.Random) -> None:
    """Damage the bytes of a file, or of one file of a folder."""
    if path.is_dir():
        path = _one_of(path, rng)
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
    path = _one_of(path, rng) if path.is_dir() else path
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


def set_extreme(path: Path, rng: random.Random) -> None:
    """Set one parameter of a plugin of a scene to an end of its range, or to an extreme."""
    tree = ElementTree.parse(path)
    parts = [(part, each.name) for part in tree.iter() for each in PLUGINS.get(part.get("type", ""), ())]
    part, name = rng.choice(parts)
    setting = next((one for one in part if one.get("name") == name and one.get("value") is not None), None)
    if setting is None:
        setting = ElementTree.SubElement(part, "float", name=name)
    default = setting.get("value", "").removeprefix("$")
    setting = next((one for one in tree.iter("default") if one.get("name") == default), setting)
    setting.set("value", f"{rng.choice((*_EXTREMES, *(limits(name) or ()))):.15g}")
    tree.write(path)


def _one_of(folder: Path, rng: random.Random) -> Path:
    return rng.choice(sorted(one for one in folder.rglob("*") if one.is_file()))


def put_another(path: Path, rng: random.Random) -> None:
    """Put something that is not a regular file in the place of a file, or of one file of a folder, or into it."""
    hdf5 = path.suffix in (".nc", ".bag")
    place = rng.choice((path, _one_of(path, rng))) if path.is_dir() else path
    other = place.with_name("other")
    match rng.choice(("fifo", "device", "socket", "folder", "nothing", "loop")):
        case "fifo":
            os.mkfifo(other)
        case "device":
            other = Path(rng.choice(("/dev/zero", "/dev/full", "/dev/null", "/dev/random", "/dev/tty")))
        case "socket":
            # Names of sockets have at most 107 bytes, and a relative one is shorter.
            with contextlib.chdir(other.parent), socket.socket(socket.AF_UNIX) as server:
                server.bind(other.name)
        case "folder":
            other.mkdir()
        case "loop":
            other.symlink_to(other.name)
    if hdf5 and rng.random() < 0.5:
        _refer(path, other, rng)
        return
    shutil.rmtree(place) if place.is_dir() else place.unlink()
    if other.parent == Path("/dev") or rng.random() < 0.5:
        place.symlink_to(other)
    elif os.path.lexists(other):
        other.rename(place)


def _refer(path: Path, other: Path, rng: random.Random) -> None:
    """Replace a dataset of an HDF5 file by one whose values another file holds, or by a link into that file."""
    with h5py.File(path, "r+") as file:
        names: list[str] = []
        file.visititems(lambda name, part: names.append(name) if isinstance(part, h5py.Dataset) else None)
        name = rng.choice(names)
        shape, kind = file[name].shape, file[name].dtype
        del file[name]
        match rng.randrange(3):
            case 0:
                external = [(str(other), 0, h5py.h5f.UNLIMITED)]
                file.create_dataset(name, shape, "f8" if kind.kind == "O" else kind, external=external)
            case 1:
                file[name] = h5py.ExternalLink(str(other), "/a")
            case 2:
                layout = h5py.VirtualLayout(shape or (1,), "f8")
                layout[:] = h5py.VirtualSource(str(other), "a", shape or (1,))
                file.create_virtual_dataset(name, layout)


DAMAGE = {"bytes": damage_bytes, "text": damage_text, "attributes": damage_attributes, "extremes": set_extreme}


def attempts(name: str, first: int, count: int, original: Path) -> Iterator[tuple[int, str, str]]:
    """Yield number, result and cause of damaged files of a kind."""
    warnings.simplefilter("ignore")
    logging.disable()
    signal.signal(signal.SIGALRM, _too_long)
    kind = KINDS[name.removesuffix(OTHERS)]
    damage = put_another if name.endswith(OTHERS) else DAMAGE[kind.format]
    kind.read(original)
    for number in range(first, first + count):
        rng = random.Random(f"{name} {number}")
        with tempfile.TemporaryDirectory() as folder:
            path = Path(folder) / "in" / original.name
            path.parent.mkdir()
            (shutil.copytree if original.is_dir() else shutil.copy)(original, path)
            try:
                damage(path, rng)
            except Exception:
                yield number, "not damaged", ""
                continue
            # A damaged file may end the process; its number is told before.
            yield number, "began", ""
            # Other processes may take most of the time.
            limit = round(LIMIT_S * max(os.getloadavg()[0] / len(os.sched_getaffinity(0)), 1))
            signal.alarm(limit)
            # A read in a library may not come back to Python; the process ends then, and the next one goes on.
            faulthandler.dump_traceback_later(2 * limit, exit=True)
            try:
                with contextlib.redirect_stdout(io.StringIO()):
                    kind.read(path)
                result, cause = "read", ""
            except UserError as error:
                result, cause = ("refused", "") if "\n" not in str(error) else ("traceback", f"two lines: {error}")
            except TimeoutError:
                result, cause = "too long", ""
            except BaseException as error:
                result, cause = "traceback", f"{type(error).__name__}: {error} {_place(error)}"
            signal.alarm(0)
            faulthandler.cancel_dump_traceback_later()
            yield number, result, " ".join(cause.split())[-400:]


def _too_long(*_: object) -> None:
    raise TimeoutError


def _place(error: BaseException) -> str:
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
            results["too long" if process.returncode == 1 else "process ended"] += 1
            print(f"{name} {at - 1}: the process ended with {process.returncode}", file=sys.stderr, flush=True)
    return results


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("names", nargs="*", metavar="KIND", help=f"kinds of files; default: all of {', '.join(KINDS)}")
    parser.add_argument("--count", type=int, default=0, help="number of damaged files of each kind")
    parser.add_argument("--first", type=int, default=0, help="number of the first one")
    parser.add_argument("--others", action="store_true", help="put something else in the place of files")
    parser.add_argument("--child", help=argparse.SUPPRESS)
    parser.add_argument("--folder", type=Path, help=argparse.SUPPRESS)
    given = parser.parse_args()
    if given.child and not given.count:
        KINDS[given.child.removesuffix(OTHERS)].make(given.folder)
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
        for name in [f"{one}{OTHERS}" if given.others else one for one in given.names or KINDS]:
            results = measure(name, given.first, given.count or 100, Path(folder))
            print(f"| {name} |", " | ".join(str(results[one]) for one in columns), "|", flush=True)


if __name__ == "__main__":
    main()
