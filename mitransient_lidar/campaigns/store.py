"""The Zarr store of a campaign or a flight: made whole at first, then filled shard by shard.

Every chunk ends in its CRC32C, and the attributes that identify a store have a SHA-256, so that damage is found on
reading. A shard's chunks are written even where all values are fill values: a missing chunk is lost.
"""

from __future__ import annotations

import contextlib
import errno
import hashlib
import importlib
import json
import logging
import os
import shutil
from collections.abc import Callable, Iterator, Mapping
from pathlib import Path
from typing import Any

import numpy as np
import numpy.typing as npt
import xarray as xr
import zarr
from zarr.codecs import Crc32cCodec, ZstdCodec

from mitransient_lidar.campaigns.design import MOST_RUNS, Column
from mitransient_lidar.campaigns.runs import Array, Renderer, own_versions
from mitransient_lidar.core.errors import UserError, WriteError
from mitransient_lidar.core.files import check_encodable, check_tree, sweep, temporary_beside
from mitransient_lidar.core.validation import integer, require_memory, shown
from mitransient_lidar.loading.scene_source import SceneSource
from mitransient_lidar.loading.variants import versions
from mitransient_lidar.physics.lidar.time_axis import TimeAxis
from mitransient_lidar.rendering.again import compare_versions
from mitransient_lidar.results.attributes import described

_LOG = logging.getLogger(__name__)

PLANNED, DONE, FAILED = 0, 1, 2  #: Values of the variable ``status``.

#: Fewest and most runs per shard, and number of shards in a campaign if its runs allow.
_FEWEST, _MOST, _SHARDS = 8, 1024, 16

LARGEST_BYTES = 2**29  #: Largest size of a shard in memory [bytes], by default.
BYTES_PER_BYTE = 2  #: Memory per byte of a shard: itself, and its chunk while that is written.
LARGEST_SHARD = 10**6  #: Most runs in a requested shard, and in a chunk of an array for all runs.

_INPUT = "_input"  # suffix of scene parameters with the name of a variable

#: Attributes by which a store is read, and the attribute with their SHA-256.
_SEALED, _SEAL = ("campaign", "flight", "scene", "record", "runs", "shard_size", "inputs", "variables"), "sha256"

#: Errors that zarr and its codecs raise for damaged files.
_DAMAGE = (OSError, ValueError, TypeError, KeyError, IndexError, AttributeError, RuntimeError, MemoryError)

_WRITING = {"array.write_empty_chunks": True}  # for a store's arrays

_STATUS = {**described("status"), "flag_values": [0, 1, 2], "flag_meanings": "planned done failed"}


#: Module and class of the renderer, by store kind.
_RENDERERS = {
    "campaign": ("mitransient_lidar.campaigns.runs", "RunRenderer"),
    "flight": ("mitransient_lidar.flights.renderer", "FlightRenderer"),
}


class Store:
    """Store of a campaign or a flight.

    Run arrays have the dimension ``run`` first, in chunks of one shard. One process writes a shard: its arrays, and
    last the ``status`` of its runs. Files replace former ones as a whole.

    Raises UserError if there is no such store in the folder `path`, or a link is in it.
    """

    def __init__(self, path: str | os.PathLike[str]) -> None:
        self.path = Path(path)
        # A link may lead to any file of whoever opens the store, and be written to.
        if self.path.is_dir():
            check_tree(self.path)
        try:
            with zarr.config.set(_WRITING):
                self._group = zarr.open_group(str(path), mode="r+", zarr_format=3)
            self.attributes: dict[str, Any] = dict(self._group.attrs)
            #: The store's kind, and its plan as JSON.
            self.kind = "flight" if "flight" in self.attributes else "campaign"
            self.text = str(self.attributes[self.kind])
            module, name = _RENDERERS[self.kind]
            self._type: type[Renderer] = getattr(importlib.import_module(module), name)
            self._plan = self._type.plan_type.from_json(self.text)
            #: Number of runs, and of runs per shard.
            self.count = integer("runs", self.attributes["runs"], 1, MOST_RUNS)
            self.shard_size = integer("shard_size", self.attributes["shard_size"], 1, LARGEST_SHARD)
            self.variables = [str(name) for name in self.attributes["variables"]]
        except _DAMAGE as error:
            raise UserError(f"{path} is no store of a campaign or a flight, or is damaged") from error
        if self.attributes.get(_SEAL) != seal(self.attributes):
            reason = "its attributes have changed" if _SEAL in self.attributes else "an earlier release has made it"
            raise UserError(f"{path} cannot be used: {reason}")
        self._arrays: dict[str, zarr.Array[Any]] = {}
        self._check_arrays()

    @classmethod
    def create(
        cls,
        path: str | os.PathLike[str],
        renderer: Renderer,
        columns: Mapping[str, Column],
        arrays: Mapping[str, Array],
        coordinates: Mapping[str, Array],
        shard_size: int | None = None,
        attributes: Mapping[str, Any] | None = None,
    ) -> Store:
        """Make a store, for arrays like one run's, with more attributes; nothing is left of it on a failure.

        Where another process has just made one, that one is returned.

        Raises UserError if the place cannot be written, or `shard_size` is not 1 to 1 000 000.
        """
        path = Path(path)
        check_encodable(path)
        sweep(path.parent)
        count = len(next(iter(columns.values())))
        bytes_of_run = sum(array.values.nbytes for array in arrays.values())
        size = int(np.clip(-(-count // _SHARDS), min(_FEWEST, count), _MOST))
        size = max(min(size, LARGEST_BYTES // max(bytes_of_run, 1)), 1)
        size = size if shard_size is None else integer("shard_size", shard_size, 1, LARGEST_SHARD)
        needed = BYTES_PER_BYTE * bytes_of_run * min(size, count)
        require_memory(f"shards of {size} runs", needed, "take a smaller shard_size, or fewer pixels or bins")
        # Beside its place, so that a store is always whole.
        temporary = temporary_beside(path)
        try:
            path.parent.mkdir(parents=True, exist_ok=True)
            group = zarr.create_group(str(temporary), zarr_format=3)
            with zarr.config.set(_WRITING):
                _fill(group, renderer, columns, arrays, coordinates, count, size, attributes or {})
            os.rename(temporary, path)
        except OSError as error:
            if error.errno in (errno.EEXIST, errno.ENOTEMPTY):
                return cls(path)
            raise WriteError(f"cannot write {path}: {error.strerror or error}") from error
        finally:
            shutil.rmtree(temporary, ignore_errors=True)
        return cls(path)

    def renderer(self) -> Any:
        """Return the `Renderer` for the runs; warn if the store has other versions."""
        compare_versions(self.attributes)
        axis, scene = self.attributes["record"], SceneSource.from_attributes(self.attributes["scene"])
        return self._type(self._plan, scene, None if axis is None else TimeAxis(*axis))

    @property
    def unit(self) -> str:
        """Name of a run."""
        return self._type.unit

    def require(
        self,
        plan: Any,
        columns: Mapping[str, Column] | None,
        scene: Callable[[], SceneSource],
        shard_size: int | None = None,
    ) -> Store:
        """Return the store; raise `UserError` unless it belongs to a plan.

        `plan`: campaign or flight. `columns`: parameters of its runs, None where they follow from the plan. `scene`:
        its current scene. `shard_size`: runs per shard, None for any.
        """
        own, source = self.inputs(slice(0, self.count)), SceneSource.from_attributes(self.attributes["scene"])
        if (
            not isinstance(self._plan, type(plan))
            or json.loads(self.text) != json.loads(plan.text)
            or (columns is not None and own.keys() != columns.keys())
            or (columns is not None and not all(np.array_equal(own[name], columns[name]) for name in own))
            or scene().attributes() != source.attributes()
        ):
            raise UserError(
                f"{self.path} holds another {self.kind}, or its scene has changed: choose another place, or remove it"
            )
        if shard_size not in (None, self.shard_size):
            raise UserError(f"shard_size = {shown(shard_size)} must be that of {self.path}, {self.shard_size}")
        return self

    def inputs(self, runs: slice) -> dict[str, Column]:
        """Return the parameters of runs, by name."""
        names: dict[str, str] = self.attributes["inputs"]
        return {name: self._values(stored, runs) for name, stored in names.items()}

    def runs_of(self, shard: int) -> slice:
        """Return a shard's runs."""
        return slice(shard * self.shard_size, min((shard + 1) * self.shard_size, self.count))

    @property
    def shards(self) -> range:
        """Shard numbers."""
        return range(-(-self.count // self.shard_size))

    def status(self, runs: slice = slice(None)) -> npt.NDArray[np.uint8]:
        """Return the status of runs; runs in a shard that has lost an array are planned."""
        status = np.array(self.stored("status", runs))
        first = runs.start or 0
        for shard in np.unique((first + np.flatnonzero(status != PLANNED)) // self.shard_size):
            if self._lost(int(shard)):
                of_shard = self.runs_of(int(shard))
                status[max(of_shard.start - first, 0) : of_shard.stop - first] = PLANNED
        return status

    def errors(self, runs: slice = slice(None)) -> npt.NDArray[Any]:
        """Return why runs failed, empty for others."""
        return self._values("error", runs).astype(object)

    def read(self, shard: int) -> tuple[npt.NDArray[np.uint8], npt.NDArray[Any], dict[str, npt.NDArray[Any]]]:
        """Return a shard's status, errors and arrays; all runs in one that cannot be read are planned."""
        runs = self.runs_of(shard)
        names = ("error", *self.variables)
        try:
            arrays = {name: np.array(self.stored(name, runs)) for name in names}
            status = self.status(runs)
        except UserError:
            fill = {name: self.array(name) for name in names}
            shapes = {name: (runs.stop - runs.start, *array.shape[1:]) for name, array in fill.items()}
            arrays = {name: np.full(shapes[name], array.fill_value, dtype=array.dtype) for name, array in fill.items()}
            status = np.full(runs.stop - runs.start, PLANNED, dtype=np.uint8)
        return status, _texts(arrays.pop("error")).astype(object), arrays

    def mend(self) -> None:
        """Plan the runs in damaged shards, or shards that have lost an array, again; warn about them.

        Raises UserError if an array for all runs is damaged, or the operating system reports an error.
        """
        self.inputs(slice(0, self.count))
        for shard in self.shards:
            runs = self.runs_of(shard)
            damage = self._lost(shard) if self._is_begun(runs) else None
            for name in ("status", "error", *self.variables):
                try:
                    self.stored(name, runs)
                except UserError as error:
                    damage = str(error)
            if damage:
                _LOG.warning("%s: runs %d to %d are rendered again", damage, runs.start, runs.stop - 1)
                with _writing(self.path):
                    self.array("status")[runs] = np.full(runs.stop - runs.start, PLANNED, dtype=np.uint8)

    def _check_arrays(self) -> None:
        """Raise `UserError` if an array's shape contradicts the attributes, or an array for all runs is lost."""
        with _reading(self.path, "the list of its arrays"):
            names = list(self._group.array_keys())
        of_runs = ("status", "error", *self.variables)
        for name in sorted({*self.attributes.get("arrays", ()), "run"} - {*names, *of_runs}):
            raise UserError(f"{self.path} is damaged: it has lost {name}")
        for name in {*names, *of_runs}:
            array = self.array(name)
            if name not in of_runs:
                lost = [one for one in range(-(-[*array.shape, 1][0] // LARGEST_SHARD)) if not self._has(name, one)]
                if lost and array.size:
                    raise UserError(f"{self.path} is damaged: it has lost {name}")
            elif array.shape[:1] != (self.count,) or array.chunks[:1] != (min(self.shard_size, self.count),):
                raise UserError(f"{self.path} is damaged: {name} has the shape {array.shape}")

    def _has(self, name: str, chunk: int) -> bool:
        """Return whether an array's chunk exists."""
        array = self.array(name)
        key = array.metadata.encode_chunk_key((chunk, *[0] * (array.ndim - 1)) if array.ndim else ())
        return (self.path / name / key).is_file()

    def _is_begun(self, runs: slice) -> bool:
        """Return whether a run is done or failed, or it is not known."""
        try:
            return bool(np.any(self.stored("status", runs) != PLANNED))
        except UserError:
            return True

    def _lost(self, shard: int) -> str | None:
        """Return the sentence of an array that a shard has lost."""
        for name in ("error", *self.variables):
            if not self._has(name, shard):
                return f"{self.path} is damaged: it has lost {name} of the runs from {shard * self.shard_size} on"
        return None

    def write(
        self,
        shard: int,
        status: npt.NDArray[np.uint8],
        errors: npt.NDArray[Any],
        arrays: Mapping[str, npt.NDArray[Any]],
    ) -> None:
        """Write a shard, its status last; one that another process has finished is left as it is.

        Raises `WriteError` if the operating system reports an error.
        """
        runs = self.runs_of(shard)
        if np.all(self.status(runs) == DONE):
            return
        with _writing(self.path):
            for name, values in arrays.items():
                self.array(name)[runs] = values
            self.array("error")[runs] = errors.astype(str)
            self.array("status")[runs] = status

    def _values(self, name: str, runs: slice) -> Column:
        """Return values for runs."""
        values = self.stored(name, runs)
        return values if values.dtype.kind in "biuf" else _texts(values)

    def stored(self, name: str, runs: slice = slice(None)) -> npt.NDArray[Any]:
        """Return values of runs as they are stored; raise `UserError` where they are damaged."""
        array = self.array(name)
        with _reading(self.path, name):
            return np.asarray(array[runs])

    def array(self, name: str) -> zarr.Array[Any]:
        """Return an array; raise `UserError` if it is damaged."""
        # Once: a store has an array for each variable, and thousands of shards.
        if name in self._arrays:
            return self._arrays[name]
        with _reading(self.path, name), zarr.config.set(_WRITING):
            found = self._group[name]
            if not isinstance(found, zarr.Array):
                raise TypeError(name)
            return self._arrays.setdefault(name, found)


@contextlib.contextmanager
def reporting_damage(path: str | os.PathLike[str]) -> Iterator[None]:
    """Convert the error by a damaged array in `open_campaign` to a `UserError`."""
    try:
        yield
    except ValueError as error:
        if "checksum" not in str(error):
            raise
        raise UserError(f"{path} is damaged: the same command of the campaign renders what cannot be read") from error


@contextlib.contextmanager
def _reading(path: str | os.PathLike[str], name: str) -> Iterator[None]:
    """Convert zarr errors for a damaged store to a `UserError`."""
    try:
        yield
    except UserError:
        raise
    except _DAMAGE as error:
        raise UserError(f"{path} is damaged: {name} cannot be read") from error


@contextlib.contextmanager
def _writing(path: Path) -> Iterator[None]:
    """Convert an error of the operating system to a `WriteError`."""
    try:
        yield
    except OSError as error:
        raise WriteError(f"cannot write {path}: {error.strerror or error}") from error


def open_campaign(path: str | os.PathLike[str]) -> xr.Dataset:
    """Return a campaign's dataset, whose arrays are read when they are needed.

    Over ``run``: the scene parameters as coordinates; ``status`` (0 planned, 1 done, 2 failed), ``error`` (why a run
    failed), ``error_median`` (relative standard error of the median bin) and ``passes``; then ``shot`` if runs have
    several, the pixel dimensions, and each variable's own: the contents that `campaigns.design.Campaign` keeps. All
    have ``long_name``, and numbers ``units``, except parameters whose names shipped scenes lack. Values for unfinished
    runs are NaN, or 0 for integers. Runs that have lost an array in the store are planned; a damaged array raises
    ``ValueError`` when it is read.

    Raises `UserError` if there is no campaign store, or its coordinates are damaged.
    """
    store = Store(path)
    with _reading(path, "a coordinate"):
        dataset: xr.Dataset = xr.open_zarr(path, consolidated=False, mask_and_scale=False, decode_times=False)
    dataset["status"] = dataset["status"].copy(data=store.status())
    return dataset


def _fill(
    group: zarr.Group,
    renderer: Renderer,
    columns: Mapping[str, Column],
    arrays: Mapping[str, Array],
    coordinates: Mapping[str, Array],
    count: int,
    size: int,
    attributes: Mapping[str, Any],
) -> None:
    """Make a store's arrays."""
    taken = {"run", "shot", "row", "column", "status", "error", *coordinates, *arrays}
    inputs = {name: f"{name}{_INPUT}" if name in taken else name for name in columns}

    def make(name: str, like: Array, whole: npt.NDArray[Any] | None = None, chunk: int = size) -> None:
        values = like.values if whole is None else whole
        dims = like.dims if whole is not None else ("run", *like.dims)
        shape = values.shape if whole is not None else (count, *values.shape)
        is_text = values.dtype.kind in "UO"
        array = group.create_array(
            name,
            shape=shape,
            chunks=(min(chunk, shape[0]), *shape[1:]) if shape else (),
            dtype=str if is_text else values.dtype,
            compressors=[ZstdCodec(), Crc32cCodec()],
            fill_value="" if is_text else np.nan if values.dtype.kind == "f" else 0,
            dimension_names=dims,
            attributes=like.attributes,
        )
        if whole is not None:
            array[...] = whole.astype(str) if is_text else whole

    for name, found in coordinates.items():
        make(name, found, found.values, chunk=LARGEST_SHARD)
    numbers = np.arange(count)
    named = {"units": "1", "long_name": f"number of the {renderer.unit}"}
    make("run", Array(("run",), numbers, named), numbers, chunk=LARGEST_SHARD)
    for name, column in columns.items():
        like = Array(("run",), column, renderer.describe_input(name, column))
        make(inputs[name], like, column, chunk=LARGEST_SHARD)
    make("status", Array((), np.zeros((), dtype=np.uint8), _STATUS))
    make("error", Array((), np.array("", dtype=object), described("error", "campaign")))
    for name, found in arrays.items():
        make(name, found)
    dims = {dim for found in arrays.values() for dim in found.dims}
    if "shot" in dims:
        shots = np.arange(renderer.shots)
        make("shot", Array(("shot",), shots, described("shot", "campaign")), shots)
    axis, time = renderer.axis, coordinates["time"].values
    secondary = [name for name in (*coordinates, *inputs.values(), "surface_seed") if name not in dims]
    about: dict[str, Any] = {
        "Conventions": "CF-1.11",
        "title": f"{renderer.kind.capitalize()} of {count} {renderer.unit}s, scene {renderer.scene.name}",
        renderer.kind: renderer.plan.text,
        "scene": {"scene": renderer.scene.name, **renderer.scene.attributes()},
        "record": None if axis is None else [axis.start_ns, axis.bin_width_ns, axis.bin_count],
        "bin_width_ns": (width := float(time[1] - time[0]) if len(time) > 1 else 1.0),
        "time_start_ns": float(time[0]) - 0.5 * width,
        "runs": count,
        "shard_size": size,
        "inputs": inputs,
        "variables": list(arrays),
        "arrays": sorted(group.array_keys()),
        "coordinates": " ".join(name for name in secondary if name in group),
        **versions(),
        "versions": own_versions(),
        **attributes,
    }
    group.attrs.update({**about, _SEAL: seal(about)})


def seal(attributes: Mapping[str, Any]) -> str:
    """Return the SHA-256 of the attributes that a store is read by."""
    text = json.dumps(
        {name: attributes.get(name) for name in _SEALED if name != "flight" or name in attributes}, sort_keys=True
    )
    return hashlib.sha256(text.encode()).hexdigest()


def _texts(values: npt.NDArray[Any]) -> npt.NDArray[Any]:
    """Return texts in NumPy's fixed length, as in the table of the runs."""
    return np.array([str(one) for one in values], dtype=np.str_)
