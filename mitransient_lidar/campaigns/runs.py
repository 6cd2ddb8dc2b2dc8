"""Campaign runs: shots for one parameter set, arrays stored from them, and versions that decide the numbers."""

from __future__ import annotations

import hashlib
import importlib.metadata
import logging
import sys
from abc import ABC, abstractmethod
from collections.abc import Collection, Iterator, Mapping, Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Any, ClassVar, NamedTuple

import numpy as np
import numpy.typing as npt
import xarray as xr

from mitransient_lidar._version import __version__
from mitransient_lidar.campaigns.design import Campaign, Column
from mitransient_lidar.core.errors import UserError
from mitransient_lidar.core.parameters.catalogue import unit_of
from mitransient_lidar.loading.catalogue import mount, scene_path
from mitransient_lidar.loading.document import SceneDocument, read_document
from mitransient_lidar.loading.parameters import check_known, values_of
from mitransient_lidar.loading.scene_source import SceneSource
from mitransient_lidar.loading.scenes import open_scene, read_source
from mitransient_lidar.loading.variants import alone
from mitransient_lidar.physics.lidar.time_axis import TimeAxis
from mitransient_lidar.rendering.passes import SMALLEST_SHARE
from mitransient_lidar.rendering.shots.series import render_shots
from mitransient_lidar.results.attributes import described

_REACH = 256.0  #: Half the side of the square that contains a sea's locations [m].
_MARGIN = 0.05  #: Relative margin of a shared record on both sides.
_SEA = "surface_seed"  #: Number of the random sea; each run has its own unless the campaign gives it.
_SEAS = 2**31 - 1  #: Whole numbers for random seas.


class Array(NamedTuple):
    """Array for one run, or for all: dimension names, values, and attributes."""

    dims: tuple[str, ...]
    values: npt.NDArray[Any]
    attributes: dict[str, Any]

    @classmethod
    def of(cls, values: xr.DataArray | xr.Variable, dtype: npt.DTypeLike | None = None) -> Array:
        """Return a variable's array, with another type if one is given."""
        return cls(tuple(map(str, values.dims)), np.asarray(values.values, dtype=dtype), plain(values.attrs))


@dataclass(frozen=True, eq=False)
class Renderer(ABC):
    """Renderer for the runs in a store, each with the same bits wherever and whenever."""

    plan: Any  #: The campaign or the flight.
    scene: SceneSource  #: Its scene, with its instrument.
    axis: TimeAxis | None = None  #: Time bins for all runs; None where each has its own.

    #: Plan class, unit name, and title of a store of such units.
    plan_type: ClassVar[Any]
    unit: ClassVar[str]
    kind: ClassVar[str]

    @property
    def shots(self) -> int:
        """Shots per run, where they have a dimension."""
        return 1

    @abstractmethod
    def batches(self, inputs: Mapping[str, Column]) -> Iterator[list[int]]:
        """Return the row numbers of a shard's runs; runs rendered together share a list."""

    def own_inputs(self, numbers: npt.NDArray[np.int64], inputs: Mapping[str, Column]) -> dict[str, Any]:
        """Return arrays that are known of runs before they are rendered, and not from their inputs."""
        return {}

    @abstractmethod
    def stacked(self, numbers: npt.NDArray[np.int64], inputs: Mapping[str, Column]) -> dict[str, Array]:
        """Return the arrays of runs that are rendered together, which are the first dimension; raise `UserError`."""

    @abstractmethod
    def describe_input(self, name: str, column: Column) -> dict[str, Any]:
        """Return the attributes of a run parameter."""


@dataclass(frozen=True, eq=False)
class RunRenderer(Renderer):
    """Renders the runs of a campaign; without time bins they are automatic for each run."""

    plan: Campaign
    plan_type, unit, kind = Campaign, "run", "campaign"

    @property
    def shots(self) -> int:
        """Shots per run."""
        return self.plan.design.shots

    @classmethod
    def of(cls, campaign: Campaign, columns: Mapping[str, Column]) -> RunRenderer:
        """Return the renderer for a new campaign with its run columns, with a record that contains all runs.

        Raises UserError if the scene cannot be loaded, or lacks a parameter that the campaign sets.
        """
        source = source_of(campaign)
        _check_parameters(campaign, columns, source.document())
        return cls(campaign, source, cls(campaign, source)._longest_record(columns))

    def inputs(self, number: int, values: Mapping[str, Any]) -> dict[str, Any]:
        """Return a run's own parameters: the table's, and the random sea."""
        if _SEA in values or _SEA in self.plan.fixed or _SEA not in self.scene.values:
            return dict(values)
        return {**values, _SEA: int(self._random(number).integers(1, _SEAS))}

    def series(self, number: int, values: Mapping[str, Any], **options: Any) -> xr.Dataset:
        """Return a run's shots, as from `render_shots`, from its row number and parameters.

        Raises `UserError` if the scene refuses the parameters, or the light does not fit the record.
        """
        campaign, known = self.plan, self.scene.values
        params = {**campaign.fixed, **self.inputs(number, values)}
        random = self._random(number)
        random.integers(1, _SEAS)
        places = random.uniform(-_REACH, _REACH, (campaign.design.shots, 2))
        for axis, name in enumerate(("aim_x", "aim_y")):
            if name in params:
                places[:, axis] = float(params[name])
        wanted: dict[str, Any] = {
            "positions": places,
            "move_target": "target_x" in known and "target_y" in known,
            "target_error": campaign.target_error,
            "max_time": campaign.max_time,
            "components": "components" in campaign.keep,
            "derivatives": list(campaign.derivatives) or None,
            "first_seed": int(random.integers(2**40)),
            "axis": self.axis,
            "describe_sea": False,
            "light": campaign.light,
            "merge_unsuited": True,
        }
        return render_shots(self.scene, params, **{**wanted, **options})

    def record(self, number: int, series: xr.Dataset) -> xr.Dataset | None:
        """Return the receiver's record for a run's shots, None without a receiver."""
        from mitransient_lidar.analysis.receiver import detect_waveforms

        campaign = self.plan
        if campaign.receiver is None:
            return None
        noise = int(np.random.SeedSequence([campaign.design.seed, number, 1]).generate_state(1)[0])
        return detect_waveforms(
            series,
            campaign.receiver,
            seed=noise,
            background_power=campaign.background_power_w,
            gain=campaign.gain,
            optical_density=campaign.optical_density,
        )

    def arrays(self, number: int, values: Mapping[str, Any]) -> dict[str, Array]:
        """Return a run's stored arrays, without its dimension; raises as `series`, or if shots are missing."""
        series, planned = self.series(number, values), self.plan.design.shots
        if series.sizes["shot"] < planned:
            done = f"ended after {series.sizes['shot']} of {planned} shots of the run"
            raise UserError(f"max_time = {self.plan.max_time:g} s {done}: it must be longer")
        return self._stored(number, values, series)

    def batches(self, inputs: Mapping[str, Column]) -> Iterator[list[int]]:
        """Return the rows of runs that are rendered together: each on its own."""
        return ([row] for row in range(len(next(iter(inputs.values())))))

    def stacked(self, numbers: npt.NDArray[np.int64], inputs: Mapping[str, Column]) -> dict[str, Array]:
        """Return `arrays` of runs that are rendered together, with the runs as first dimension."""
        row = self.arrays(int(numbers[0]), {name: column[0].item() for name, column in inputs.items()})
        return {name: array._replace(values=array.values[None]) for name, array in row.items()}

    def own_inputs(self, numbers: npt.NDArray[np.int64], inputs: Mapping[str, Column]) -> dict[str, Any]:
        """Return `inputs` of runs that are rendered together, those that fail too."""
        return self.inputs(int(numbers[0]), {name: column[0].item() for name, column in inputs.items()})

    def describe_input(self, name: str, column: Column) -> dict[str, Any]:
        """Return the attributes of a run parameter."""
        text = {"long_name": f"parameter {name} of the scene"}
        unit = unit_of(name) if column.dtype.kind in "iuf" else None
        return text if unit is None else {"units": unit, **text}

    def sample(self, number: int, values: Mapping[str, Any]) -> tuple[dict[str, Array], dict[str, Array]]:
        """Return `arrays` from few paths, and the coordinates of their dimensions; raises as `series`."""
        series = self.series(number, values, target_error=None, max_time=None, passes=2, pass_share=SMALLEST_SHARE)
        return self._stored(number, values, series), self._coordinates(number, series)

    def _stored(self, number: int, values: Mapping[str, Any], series: xr.Dataset) -> dict[str, Array]:
        found = dict(self._arrays(number, series))
        found["error_median"] = _number("error_median", series.attrs, np.float32)
        found["passes"] = _number("passes", series.attrs, np.int32)
        if _SEA in (own := self.inputs(number, values)) and _SEA not in values:
            found[_SEA] = _number(_SEA, own, np.int64)
        if self.plan.design.shots > 1:
            return found
        return {name: _of_one_shot(array) for name, array in found.items()}

    def _arrays(self, number: int, series: xr.Dataset) -> Iterator[tuple[str, Array]]:
        from mitransient_lidar.analysis.waveforms.echo_table import extract

        keep, recorded = self.plan.keep, self.record(number, series)
        names = [name for name, kind in (("waveform", "waveform"), ("waveform_stderr", "stderr")) if kind in keep]
        if "components" in keep:
            names += ["waveform_by_origin"] + (["waveform_by_origin_stderr"] if "stderr" in keep else [])
        if self.plan.derivatives:
            names += ["waveform_derivative"] + (["waveform_derivative_stderr"] if "stderr" in keep else [])
        for name in names:
            about = {key: value for key, value in series[name].attrs.items() if key != "ancillary_variables"}
            yield name, _single(series[name].assign_attrs(about))
        if recorded is not None:
            yield "signal", _single(_renamed_time(recorded["signal"], series))
            for name in ("gain", "optical_density"):
                yield name, _number(name, recorded.attrs, np.float64)
        if "truth" in keep:
            for name, values in _truth(series).items():
                yield name, Array(tuple(map(str, values.dims)), values.values, dict(values.attrs))
        if "echoes" in keep:
            echoes = extract(series if recorded is None else recorded, targets=1)
            for kind, values in echoes.data_vars.items():
                array = np.asarray(values, dtype=np.int16 if kind == "flags" else np.float32)
                yield f"echo_{kind}", Array(tuple(map(str, values.dims)), array, plain(values.attrs))

    def _coordinates(self, number: int, series: xr.Dataset) -> dict[str, Array]:
        from mitransient_lidar.analysis.waveforms.echo_table import ECHOES

        recorded = self.record(number, series)
        names = [
            name for name in ("pixel", "angle_x", "angle_y", "time", "origin", "parameter") if name in series.coords
        ]
        found = {name: Array.of(series[name]) for name in names}
        if recorded is not None and (time := _renamed_time(recorded["signal"], series)).dims[-1] != "time":
            found["signal_time"] = Array(("signal_time",), time["signal_time"].values, plain(series["time"].attrs))
        if "echoes" in self.plan.keep:
            found["echo"] = Array(("echo",), np.array(ECHOES), described("echo"))
        return found

    def _random(self, number: int) -> np.random.Generator:
        """Return a run's random numbers: its sea, then its locations, then the seed of its shots."""
        return np.random.default_rng([self.plan.design.seed, number])

    def _longest_record(self, columns: Mapping[str, Column]) -> TimeAxis | None:
        """Return time bins that hold the light of all runs, None where the campaign gives them.

        Each end is sought by one parameter after the other: from the first run, its extreme value that makes the record
        longer is kept.
        """
        if all(name in self.plan.fixed for name in ("time_start_ns", "bin_count")):
            return None
        extremes = {name: _extremes(column) for name, column in columns.items()}
        ends: list[tuple[float, TimeAxis]] = []
        for sign in (1.0, -1.0):
            chosen = _values(columns, 0)
            best: tuple[float, TimeAxis] | None = None
            for name, tried in extremes.items():
                for value in tried:
                    try:
                        axis = self.own_axis({**chosen, name: value})
                    except UserError:
                        # A combination of extremes that the scene refuses; such runs fail by themselves.
                        continue
                    end = axis.end_ns if sign > 0 else -axis.start_ns
                    if best is None or end > best[0]:
                        best, chosen = (end, axis), {**chosen, name: value}
            ends += [] if best is None else [best]
        if not ends:
            self.own_axis(_values(columns, 0))
            raise UserError("the scene refuses the extreme values of all parameters: reduce their ranges")
        start, end = min(axis.start_ns for _, axis in ends), max(axis.end_ns for _, axis in ends)
        margin, width = _MARGIN * (end - start), ends[0][1].bin_width_ns
        return TimeAxis.covering(start - margin, end + margin, width, None, None)

    @alone
    def own_axis(self, values: Mapping[str, Any]) -> TimeAxis:
        """Return a run's automatic time bins."""
        from mitransient_lidar.transport.scene_parts import find_lidar_scene

        session = open_scene(self.scene, {**self.plan.fixed, **values})
        return find_lidar_scene(session.scene, session.sensor).axis


def source_of(campaign: Campaign) -> SceneSource:
    """Return the source of a campaign's scene, with its instrument; raise `UserError` if it cannot be read.

    It is not loaded: its default files may be missing where the runs have others.
    """
    return read_source(campaign.scene, campaign.fixed, campaign.instrument)


def check_names(campaign: Campaign) -> None:
    """Raise `UserError` for a campaign parameter that its scene lacks, before the table of its runs."""
    document = read_document(scene_path(campaign.scene))
    if campaign.instrument is not None:
        document = mount(campaign.instrument, document)
    _check_parameters(campaign, campaign.parameters, document)


def _check_parameters(campaign: Campaign, columns: Collection[str], document: SceneDocument) -> None:
    """Raise `UserError` for parameters that the scene does not have, or that may not vary."""
    known = values_of(document)
    check_known([*campaign.fixed, *columns], known, document)
    for name in ("time_start_ns", "bin_width_ns", "bin_count"):
        if name in columns:
            raise UserError(f"parameter {name!r} must be the same in all runs, which share a record: set it in [fixed]")
    for name in ("aim_x", "aim_y"):
        if name not in known:
            raise UserError(f"scene {campaign.scene} has no parameter {name}, which the places of shots need")
        if campaign.design.shots > 1 and (name in campaign.fixed or name in columns):
            raise UserError(f"design.shots = {campaign.design.shots} needs random places: leave out {name}")


def _values(columns: Mapping[str, Column], row: int) -> dict[str, Any]:
    """Return a row's parameters."""
    return {name: column[row].item() for name, column in columns.items()}


def _extremes(column: Column) -> Sequence[Any]:
    """Return the parameter values that may make a record longer: both ends of numbers, all texts."""
    values = np.unique(column)
    return [one.item() for one in (values[[0, -1]] if column.dtype.kind in "if" else values)]


def _single(values: xr.DataArray) -> Array:
    """Return an array in single precision, shots first."""
    ordered = values.transpose("shot", ...) if "shot" in values.dims else values
    return Array.of(ordered, np.float32)


def _number(name: str, values: Mapping[str, Any], dtype: npt.DTypeLike) -> Array:
    """Return one number per run."""
    return Array((), np.asarray(values[name], dtype=dtype), described(name))


def _renamed_time(signal: xr.DataArray, series: xr.Dataset) -> xr.DataArray:
    """Return a signal over its own time, unless it is sampled as the waveform."""
    return signal if signal.sizes["time"] == series.sizes["time"] else signal.rename(time="signal_time")


def _truth(series: xr.Dataset) -> dict[str, xr.DataArray]:
    """Return the known truth for each shot, and each pixel's lines of sight."""
    of_pixels = set(series["angle_x"].dims)
    return {
        str(name): values
        for name, values in series.coords.items()
        if name not in ("shot", "angle_x", "angle_y", "pixel", "row", "column", "origin", "time")
        and (values.dims == ("shot",) or set(values.dims) == of_pixels)
        and values.dtype.kind == "f"
    }


def _of_one_shot(array: Array) -> Array:
    """Return an array without the dimension of the only shot."""
    if "shot" not in array.dims:
        return array
    place = array.dims.index("shot")
    return array._replace(dims=array.dims[:place] + array.dims[place + 1 :], values=array.values.take(0, place))


def plain(attributes: Mapping[Any, Any]) -> dict[str, Any]:
    """Return attributes that JSON can hold."""
    return {
        str(name): value.tolist() if isinstance(value, (np.generic, np.ndarray)) else value
        for name, value in attributes.items()
    }


_LOG = logging.getLogger(__name__)

#: Packages whose version decides the numbers. LLVM does not: 22.1 and 23.1 give the same bits.
_PACKAGES = ("mitsuba", "drjit", "numpy")

_SUFFIXES = (".py", ".csv", ".toml")  #: Files of the package that decide the numbers, by suffix.
FILES = "files of mitransient-lidar"  #: Name of the SHA-256 of the files.


def own_versions() -> dict[str, str]:
    """Return this process's versions by name, and the first digits of the SHA-256 of the package's files.

    An installation from sources keeps its version while its files change.
    """
    return {
        "mitransient-lidar": __version__,
        FILES: _digest(),
        **{name: importlib.metadata.version(name) for name in _PACKAGES},
        "python": ".".join(map(str, sys.version_info[:2])),
    }


def difference(wanted: Mapping[str, str], found: Mapping[str, str]) -> str | None:
    """Return in words which version is found where another one is wanted, None where all are the same."""
    texts: list[str] = []
    for name, version in wanted.items():
        other = found.get(name, "unknown")
        # Another version has other files.
        if other != version and not (name == FILES and texts):
            texts.append(f"{name} {other} instead of {version}")
    return " and ".join(texts) or None


def check_versions(store: Path, attributes: Mapping[str, Any]) -> None:
    """Raise `UserError` if current renders would give other numbers than the versions that a store has.

    Package files that have changed since, as in a source folder, give a warning.
    """
    own = own_versions()
    # Stores from version 0.2 state Mitsuba and Dr.Jit alone.
    first = {name: attributes.get(f"{name}_version", own[name]) for name in ("mitsuba", "drjit")}
    begun = attributes.get("versions", first)
    if differs := difference({**begun, FILES: own[FILES]}, own):
        raise UserError(
            f"{store} was begun by other versions, and here is {differs}: install those, or choose another place"
        )
    if difference(begun, own):
        _LOG.warning("files of this package have changed since %s was begun: numbers may differ", store)


def other_versions(place: str, differs: str) -> str:
    """Return the sentence that refuses a place, as a worker, with other versions."""
    return f"{place} has {differs}: all that render into a store must have the same"


def _digest() -> str:
    """Return the first digits of the SHA-256 of the files, the same for a wheel and for sources.

    Scenes are left out: a store holds its own.
    """
    import mitransient_lidar.plugins

    found = hashlib.sha256()
    for module, others in ((mitransient_lidar, ("plugins", "scenes")), (mitransient_lidar.plugins, ())):
        root = Path(module.__file__ or "").parent
        for path in sorted(root.rglob("*")):
            name = path.relative_to(root)
            if path.suffix in _SUFFIXES and name.parts[0] not in others:
                found.update(f"{name.as_posix()}\0".encode() + path.read_bytes() + b"\0")
    return found.hexdigest()[:12]
