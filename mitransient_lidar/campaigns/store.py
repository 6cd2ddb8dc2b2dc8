"""The Zarr store of a campaign: made whole at first, then filled shard by shard."""

from __future__ import annotations

import json
import os
import shutil
from collections.abc import Mapping
from pathlib import Path
from typing import Any

import numpy as np
import numpy.typing as npt
import xarray as xr
import zarr

from mitransient_lidar.campaigns.design import Campaign, Column
from mitransient_lidar.campaigns.runs import Array, RunRenderer, record_of
from mitransient_lidar.core.errors import UserError
from mitransient_lidar.core.files import check_encodable
from mitransient_lidar.core.validation import integer
from mitransient_lidar.loading.scene_record import SceneRecord
from mitransient_lidar.loading.variants import versions
from mitransient_lidar.physics.lidar.time_axis import TimeAxis
from mitransient_lidar.rendering.again import compare_versions

#: Values of the variable ``status``.
PLANNED, DONE, FAILED = 0, 1, 2

#: Fewest and most runs of a shard, and the number of shards that a campaign has if its runs allow.
_FEWEST, _MOST, _SHARDS = 64, 1024, 16

#: Largest size of a shard in memory [bytes], by default.
_MOST_BYTES = 2**29

#: Suffix of parameters of the scene that have the name of a variable.
_INPUT = "_input"

_STATUS = {"long_name": "state of the run", "flag_values": [0, 1, 2], "flag_meanings": "planned done failed"}


class Store:
    """The store of a campaign.

    Arrays of a run have the dimension ``run`` first, in chunks of one shard. A shard is written by one process: its
    arrays, and last the ``status`` of its runs. Files replace former ones as a whole.

    Parameters
    ----------
    path
        Folder of the store.

    Raises
    ------
    UserError
        If there is no store of a campaign.
    """

    def __init__(self, path: str | os.PathLike[str]) -> None:
        self.path = Path(path)
        try:
            self._group = zarr.open_group(str(path), mode="r+", zarr_format=3)
            self.attributes: dict[str, Any] = dict(self._group.attrs)
            self.campaign = Campaign.from_json(self.attributes["campaign"])
        except (OSError, KeyError, ValueError, TypeError) as error:
            if isinstance(error, UserError):
                raise
            raise UserError(f"{path} is no store of a campaign.") from error
        #: Number of runs, and of runs of a shard.
        self.count, self.shard_size = int(self.attributes["runs"]), int(self.attributes["shard_size"])

    @classmethod
    def create(
        cls,
        path: str | os.PathLike[str],
        renderer: RunRenderer,
        columns: Mapping[str, Column],
        arrays: Mapping[str, Array],
        coordinates: Mapping[str, Array],
        shard_size: int | None = None,
    ) -> Store:
        """Make the store of a campaign, for arrays like those of one run; nothing is left of it on a failure.

        Raises
        ------
        UserError
            If the place cannot be written, or `shard_size` is not 1 to 1 000 000.
        """
        path = Path(path)
        check_encodable(path)
        count = len(next(iter(columns.values())))
        bytes_of_run = sum(array.values.nbytes for array in arrays.values())
        size = _shard_size(count, bytes_of_run)
        size = size if shard_size is None else integer("shard_size", shard_size, 1, 10**6)
        # Beside its place, so that a store is always whole.
        temporary = path.with_name(f".{path.name}.{os.getpid()}")
        try:
            path.parent.mkdir(parents=True, exist_ok=True)
            group = zarr.create_group(str(temporary), zarr_format=3)
            _fill(group, renderer, columns, arrays, coordinates, count, size)
            os.rename(temporary, path)
        except OSError as error:
            raise UserError(f"cannot write {path}: {error.strerror or error}.") from error
        finally:
            shutil.rmtree(temporary, ignore_errors=True)
        return cls(path)

    def renderer(self) -> RunRenderer:
        """Return the renderer of the runs; warn if the store is of other versions."""
        compare_versions(self.attributes)
        axis = self.attributes["record"]
        return RunRenderer(
            self.campaign,
            SceneRecord.from_attributes(self.attributes["scene"]),
            None if axis is None else TimeAxis(*axis),
        )

    def is_of(self, campaign: Campaign, columns: Mapping[str, Column]) -> bool:
        """Return whether it is the store of a campaign with these columns, and of its scene as it is now."""
        if json.loads(self.attributes["campaign"]) != json.loads(campaign.text):
            return False
        own = self.inputs(slice(0, self.count))
        if own.keys() != columns.keys() or not all(np.array_equal(own[name], columns[name]) for name in own):
            return False
        return record_of(campaign).attributes() == SceneRecord.from_attributes(self.attributes["scene"]).attributes()

    def inputs(self, runs: slice) -> dict[str, Column]:
        """Return the parameters of runs, by name."""
        names: dict[str, str] = self.attributes["inputs"]
        return {name: self._values(stored, runs) for name, stored in names.items()}

    def runs_of(self, shard: int) -> slice:
        """Return the runs of a shard."""
        return slice(shard * self.shard_size, min((shard + 1) * self.shard_size, self.count))

    @property
    def shards(self) -> range:
        """Numbers of the shards."""
        return range(-(-self.count // self.shard_size))

    def status(self, runs: slice = slice(None)) -> npt.NDArray[np.uint8]:
        """Return the status of runs."""
        return np.asarray(self._array("status")[runs])

    def errors(self, runs: slice = slice(None)) -> npt.NDArray[Any]:
        """Return why runs failed, empty for others."""
        return self._values("error", runs).astype(object)

    def read(self, shard: int) -> tuple[npt.NDArray[np.uint8], npt.NDArray[Any], dict[str, npt.NDArray[Any]]]:
        """Return status, errors and arrays of a shard."""
        runs = self.runs_of(shard)
        arrays = {name: np.array(self._array(name)[runs]) for name in self.attributes["variables"]}
        return self.status(runs).copy(), self.errors(runs), arrays

    def write(
        self,
        shard: int,
        status: npt.NDArray[np.uint8],
        errors: npt.NDArray[Any],
        arrays: Mapping[str, npt.NDArray[Any]],
    ) -> None:
        """Write a shard, its status last; one that another process has finished is left as it is.

        Raises
        ------
        UserError
            If the operating system reports an error.
        """
        runs = self.runs_of(shard)
        if np.all(self.status(runs) == DONE):
            return
        try:
            for name, values in arrays.items():
                self._array(name)[runs] = values
            self._array("error")[runs] = errors.astype(str)
            self._array("status")[runs] = status
        except OSError as error:
            raise UserError(f"cannot write {self.path}: {error.strerror or error}.") from error

    def _values(self, name: str, runs: slice) -> Column:
        """Return values of runs; texts have NumPy's fixed length, as in the table of the runs."""
        values = np.asarray(self._array(name)[runs])
        return values if values.dtype.kind in "biuf" else np.array([str(one) for one in values], dtype=np.str_)

    def _array(self, name: str) -> zarr.Array[Any]:
        found = self._group[name]
        assert isinstance(found, zarr.Array)
        return found


def open_campaign(path: str | os.PathLike[str]) -> xr.Dataset:
    """Return the dataset of a campaign, whose arrays are read when they are needed.

    Over ``run``: the parameters of the scene as coordinates; ``status`` (0 planned, 1 done, 2 failed), ``error`` (why a
    run failed), ``error_median`` (relative standard error of the median bin) and ``passes``; then ``shot`` if runs have
    several, the dimensions of the pixels, and those of each variable: what `campaigns.design.Campaign` keeps. Values of
    runs that are not done are NaN, or 0 for integers.

    Raises
    ------
    UserError
        If there is no store of a campaign.
    """
    Store(path)
    dataset: xr.Dataset = xr.open_zarr(path, consolidated=False, mask_and_scale=False, decode_times=False)
    return dataset


def describe_campaign(path: str | os.PathLike[str]) -> list[str]:
    """Return lines on a campaign: the numbers of its runs by status, and the most frequent reasons of failures."""
    store = Store(path)
    status = store.status()
    done, failures, planned = (int(np.count_nonzero(status == value)) for value in (DONE, FAILED, PLANNED))
    lines = [f"{store.count} runs: {done} done, {failures} failed, {planned} planned"]
    if failures:
        failed = np.flatnonzero(status == FAILED)
        reasons, first, number = np.unique(
            store.errors()[failed].astype(np.str_), return_index=True, return_counts=True
        )
        for reason, place, times in sorted(zip(reasons, first, number, strict=True), key=lambda row: -row[2])[:5]:
            lines.append(f"failed {times}, the first run {failed[place]}: {reason}")
    return lines


def _fill(
    group: zarr.Group,
    renderer: RunRenderer,
    columns: Mapping[str, Column],
    arrays: Mapping[str, Array],
    coordinates: Mapping[str, Array],
    count: int,
    size: int,
) -> None:
    """Make the arrays of a store."""
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
            fill_value="" if is_text else np.nan if values.dtype.kind == "f" else 0,
            dimension_names=dims,
            attributes=like.attributes,
        )
        if whole is not None:
            array[...] = whole.astype(str) if is_text else whole

    for name, found in coordinates.items():
        make(name, found, found.values, chunk=10**6)
    numbers = np.arange(count)
    make("run", Array(("run",), numbers, {"long_name": "number of the run"}), numbers, chunk=10**6)
    for name, column in columns.items():
        about = {"long_name": f"parameter {name} of the scene"}
        make(inputs[name], Array(("run",), column, about), column, chunk=10**6)
    make("status", Array((), np.zeros((), dtype=np.uint8), _STATUS))
    make("error", Array((), np.array("", dtype=object), {"long_name": "why the run failed"}))
    for name, found in arrays.items():
        make(name, found)
    dims = {dim for found in arrays.values() for dim in found.dims}
    if "shot" in dims:
        shots = np.arange(renderer.campaign.design.shots)
        make("shot", Array(("shot",), shots, {"long_name": "number of the shot over the sea of the run"}), shots)
    axis, time = renderer.axis, coordinates["time"].values
    secondary = [name for name in (*coordinates, *inputs.values(), "surface_seed") if name not in dims]
    group.attrs.update(
        {
            "Conventions": "CF-1.11",
            "title": f"Campaign of {count} runs, scene {renderer.scene.name}",
            "campaign": renderer.campaign.text,
            "scene": {"scene": renderer.scene.name, **renderer.scene.attributes()},
            "record": None if axis is None else [axis.start_ns, axis.bin_width_ns, axis.bin_count],
            "bin_width_ns": (width := float(time[1] - time[0]) if len(time) > 1 else 1.0),
            "time_start_ns": float(time[0]) - 0.5 * width,
            "runs": count,
            "shard_size": size,
            "inputs": inputs,
            "variables": list(arrays),
            "coordinates": " ".join(name for name in secondary if name in group),
            **versions(),
        }
    )


def _shard_size(count: int, bytes_of_run: int) -> int:
    """Return the number of runs of a shard."""
    size = int(np.clip(-(-count // _SHARDS), min(_FEWEST, count), _MOST))
    return max(min(size, _MOST_BYTES // max(bytes_of_run, 1)), 1)
