"""Plans of campaigns: the file of a campaign, and the table of its runs."""

from __future__ import annotations

import csv
import io
import json
import math
import os
from collections.abc import Mapping, Sequence
from dataclasses import dataclass, field, fields
from pathlib import Path
from typing import Any, Literal, Union

import numpy as np
import numpy.typing as npt

from mitransient_lidar.campaigns.expressions import Expression
from mitransient_lidar.core.errors import UserError
from mitransient_lidar.core.files import is_there, read_text
from mitransient_lidar.core.toml_files import check_keys, parse_toml
from mitransient_lidar.core.validation import (
    FloatArray,
    finite,
    in_range,
    integer,
    is_number,
    non_negative,
    positive,
    shown,
)

#: Kinds of designs: every combination; points of a sequence, of a Latin hypercube, or random ones; rows of a file.
DESIGN_KINDS = ("grid", "sobol", "latin_hypercube", "random", "table")

#: Contents of a store that a campaign may keep.
KEPT = ("waveform", "stderr", "components", "echoes", "truth")

#: Most runs of a campaign, and most shots of a run.
MOST_RUNS, MOST_SHOTS = 10**7, 10_000

#: Most values of all parameters of all runs, and of a table that is a file, a million rows of ten numbers.
_MOST_VALUES, _MOST_CELLS = 10**8, 2 * 10**7

#: Largest table of runs [bytes].
_LARGEST_TABLE = 2**27

Column = npt.NDArray[Any]

#: What a parameter of a design may take: a range, or values.
_Free = Union["Range", tuple[Any, ...]]


@dataclass(frozen=True)
class Range:
    """Range of a parameter: `low` to `high`, uniform in the value, or in its logarithm for the scale ``log``.

    `steps` is the number of its values in a grid, both ends among them.
    """

    low: float
    high: float
    scale: str = "linear"
    steps: int | None = None

    @classmethod
    def of(cls, name: str, given: Mapping[str, Any]) -> Range:
        """Check a range of a file; raise `UserError` if it is empty, or not a range."""
        check_keys(f"parameters.{name}", given, ("low", "high", "scale", "steps"))
        for end in ("low", "high"):
            if end not in given:
                raise UserError(f"{name} = {shown(dict(given))} must have {end}, as in {{ low = 2.0, high = 20.0 }}")
        low, high = (finite(f"{name}.{end}", given[end]) for end in ("low", "high"))
        scale = given.get("scale", "linear")
        if scale not in ("linear", "log"):
            raise UserError(f"{name}.scale = {shown(scale)} must be 'linear' or 'log'")
        if not low < high:
            raise UserError(f"{name} has the empty range {low:g} to {high:g}: low must be less than high")
        if scale == "log" and low <= 0:
            raise UserError(f"{name}.low = {low:g} must be positive for the scale 'log'")
        steps = integer(f"{name}.steps", given["steps"], 2, 10**6) if "steps" in given else None
        return cls(low, high, scale, steps)

    def at(self, shares: FloatArray) -> FloatArray:
        """Return the values at shares of the range, 0 to 1."""
        if self.scale == "log":
            return np.asarray(np.exp(math.log(self.low) + shares * (math.log(self.high) - math.log(self.low))))
        return self.low + shares * (self.high - self.low)


@dataclass(frozen=True)
class Design:
    """Choice of the runs: `kind` (`DESIGN_KINDS`), `count` of runs, places on each sea (`shots`), `seed`, and table."""

    kind: str = "sobol"
    count: int | None = None
    shots: int = 1
    seed: int = 0
    file: str | None = None


@dataclass(frozen=True)
class Campaign:
    """A campaign, as its file describes it.

    Attributes
    ----------
    scene, instrument
        Scene by name or path, and instrument, as for `render_shots`.
    target_error
        Relative standard error of the median bin of each run.
    max_time
        Longest time for the passes of each run [s], None for any. A run that it ends has other bits elsewhere.
    keep
        What the store holds, of `KEPT`.
    derivatives
        Names of parameters by which the waveforms are differentiated, as for `render_shots`; kept as
        ``waveform_derivative``.
    receiver
        Receiver chain of every pixel, whose noisy ``signal`` is kept as well; `gain`, `optical_density` (numbers or
        'auto') and `background_power_w` are those of `analysis.receiver.detect_waveforms`.
    fixed
        Parameters of the scene that are the same in all runs.
    parameters
        Parameters that vary: a `Range`, a tuple of values, or an `Expression` of the others.
    design
        Choice of the runs.
    folder
        Folder of the file, from which relative paths count.
    text
        The campaign as JSON, from which `from_json` returns it.
    """

    scene: str
    target_error: float = 0.05
    max_time: float | None = None
    keep: tuple[str, ...] = ("waveform", "truth")
    instrument: str | None = None
    derivatives: tuple[str, ...] = ()
    receiver: str | None = None
    gain: float | Literal["auto"] = 1.0
    optical_density: float | Literal["auto"] = 0.0
    background_power_w: float = 0.0
    fixed: Mapping[str, Any] = field(default_factory=dict)
    parameters: Mapping[str, Range | tuple[Any, ...] | Expression] = field(default_factory=dict)
    design: Design = Design()
    folder: Path = Path()
    text: str = ""

    @classmethod
    def read(cls, path: str | os.PathLike[str]) -> Campaign:
        """Read a TOML file; raise `UserError` if it cannot be read, is not TOML, or describes no campaign."""
        return cls.of(parse_toml(read_text(path), path), Path(path).resolve().parent)

    @classmethod
    def of(cls, given: Mapping[str, Any], folder: Path | None = None) -> Campaign:
        """Check a campaign given as a dict of the contents of its file; raise `UserError` if it is invalid."""
        own = [one.name for one in fields(cls) if one.name not in ("folder", "text")]
        check_keys("a campaign", given, own)
        scene = given.get("scene")
        if not isinstance(scene, (str, os.PathLike)):
            raise UserError(f"scene = {shown(scene)} must be the name of a shipped scene or the path of an XML file")
        folder = Path.cwd() if folder is None else folder
        for name in ("instrument", "receiver"):
            if not isinstance(given.get(name), (str, type(None))):
                raise UserError(f"{name} = {shown(given[name])} must be a name")
        gain, density = given.get("gain", 1.0), given.get("optical_density", 0.0)
        parameters = {name: _parameter(name, value) for name, value in _section(given, "parameters").items()}
        design = _design(_section(given, "design"))
        fixed = _section(given, "fixed")
        if twice := [name for name in parameters if name in fixed]:
            raise UserError(f"parameter {twice[0]!r} is in [fixed] and in [parameters]: leave out one of them")
        try:
            text = json.dumps(_plain(given))
        except (TypeError, ValueError, RecursionError):
            raise UserError("the campaign must hold numbers, texts, lists and tables only") from None
        campaign = cls(
            scene=_resolved(str(scene), folder),
            target_error=positive("target_error", given.get("target_error", 0.05)),
            max_time=None if given.get("max_time") is None else positive("max_time", given["max_time"]),
            keep=_kept(given.get("keep", ["waveform", "truth"])),
            instrument=given.get("instrument"),
            derivatives=_names("derivatives", given.get("derivatives", [])),
            receiver=given.get("receiver"),
            gain=gain if gain == "auto" else positive("gain", gain),
            optical_density=density if density == "auto" else in_range("optical_density", density, 0, 12),
            background_power_w=non_negative("background_power_w", given.get("background_power_w", 0.0)),
            fixed=fixed,
            parameters=parameters,
            design=design,
            folder=folder,
            text=text,
        )
        if campaign.receiver is None and (
            told := [name for name in ("gain", "optical_density", "background_power_w") if name in given]
        ):
            raise UserError(f'{told[0]} = {shown(given[told[0]])} needs a receiver, as in receiver = "apd"')
        return campaign

    @classmethod
    def from_json(cls, text: str) -> Campaign:
        """Return the campaign of a `text`."""
        return cls.of(json.loads(text))

    @property
    def needed_names(self) -> set[str]:
        """Names of the parameters of the scene that the runs set, without those of a table."""
        return {*self.fixed, *self.parameters}

    def table(self) -> dict[str, Column]:
        """Return the parameters that vary, by name, one value a run; raise `UserError` for an impossible design."""
        free = {name: one for name, one in self.parameters.items() if not isinstance(one, Expression)}
        design = self.design
        if design.kind == "table":
            columns = self._from_file()
            _check_size(len(next(iter(columns.values()), ())), len(columns) + len(self.parameters))
        else:
            if not free:
                raise UserError("the campaign has no parameters to vary: add a range or a list to [parameters]")
            _check_size(_run_count(free, design), len(self.parameters))
            columns = _designed(free, design)
        return self._with_expressions(columns)

    def _from_file(self) -> dict[str, Column]:
        """Return the columns of the table of a design."""
        assert self.design.file is not None
        path = Path(_resolved(self.design.file, self.folder))
        if free := [name for name, one in self.parameters.items() if not isinstance(one, Expression)]:
            raise UserError(f"parameters.{free[0]}: the table gives the values; only expressions may be added to it")
        text = read_text(path, _LARGEST_TABLE)
        if (values := text.count(",") + text.count("\n")) > _MOST_CELLS:
            raise UserError(f"{path} has {values} values: a table of runs may have {_MOST_CELLS}")
        lines = io.StringIO(text, newline="")
        try:
            rows = [[cell.strip() for cell in row] for row in csv.reader(lines) if any(map(str.strip, row))]
        except csv.Error as error:
            raise UserError(f"{path} is not a CSV file.") from error
        if len(rows) < 2:
            raise UserError(f"{path} must have a heading with the names of parameters, and a row for each run")
        names = rows[0]
        for number, row in enumerate(rows[1:], start=1):
            if len(row) != len(names) or "" in row:
                raise UserError(f"{path}, run {number}: it must have {len(names)} values, as the heading has names")
        if len(set(names)) < len(names) or not all(names):
            raise UserError(f"{path} must name each column once, and names {', '.join(names)}")
        if known := [name for name in names if name in self.needed_names]:
            raise UserError(f"parameter {known[0]!r} is a column of {path} and in the campaign: leave out one of them")
        columns = {}
        for name, cells in zip(names, zip(*rows[1:], strict=True), strict=True):
            numeric = all(is_number(cell) and math.isfinite(float(cell)) for cell in cells)
            columns[name] = np.array([float(cell) for cell in cells] if numeric else list(cells))
        return columns

    def _with_expressions(self, columns: dict[str, Column]) -> dict[str, Column]:
        """Return columns and the parameters that are expressions of them, of fixed ones, or of each other."""
        count = len(next(iter(columns.values())))
        waiting = {name: one for name, one in self.parameters.items() if isinstance(one, Expression)}
        fixed = {name: value for name, value in self.fixed.items() if isinstance(value, (int, float))}
        found = dict(columns)
        while waiting:
            known = {**fixed, **found}
            ready = [name for name, one in waiting.items() if one.names <= known.keys()]
            for name, one in waiting.items():
                if unknown := sorted(one.names - known.keys() - waiting.keys()):
                    raise UserError(
                        f"{name} = {one.text!r} needs {unknown[0]}, which is neither a number in [fixed] nor one of "
                        f"the parameters {', '.join(found)}"
                    )
            if not ready:
                raise UserError(f"the parameters {', '.join(sorted(waiting))} depend on each other in a circle")
            for name in ready:
                one = waiting.pop(name)
                for each in one.names:
                    if np.asarray(known[each]).dtype.kind not in "if":
                        raise UserError(f"{name} = {one.text!r} needs {each}, whose values are texts")
                values = {each: np.asarray(known[each], dtype=np.float64) for each in one.names}
                found[name] = np.array(np.broadcast_to(one.evaluate(values), (count,)))
        first = columns if self.design.kind == "table" else ()
        return {name: found[name] for name in dict.fromkeys([*first, *self.parameters])}


def _run_count(free: Mapping[str, _Free], design: Design) -> int:
    """Return the number of runs of a design other than a table."""
    if design.kind != "grid":
        assert design.count is not None
        return design.count
    lengths = []
    for name, one in free.items():
        if isinstance(one, Range) and one.steps is None:
            raise UserError(f"{name}.steps is missing: the range of a grid needs the number of its values, or a list")
        lengths.append(one.steps or 0 if isinstance(one, Range) else len(one))
    return math.prod(lengths)


def _check_size(count: int, parameters: int) -> None:
    """Raise `UserError` for a number of runs that is impossible, or whose table needs too much memory."""
    if not 1 <= count <= MOST_RUNS:
        raise UserError(f"the design has {count} runs: it must have 1 to {MOST_RUNS}")
    if count * parameters > _MOST_VALUES:
        raise UserError(f"the design has {count} runs of {parameters} parameters: it may have {_MOST_VALUES} values")


def _designed(free: Mapping[str, _Free], design: Design) -> dict[str, Column]:
    """Return the columns of a design other than a table."""
    if design.kind == "grid":
        axes = [_grid_axis(one) for one in free.values()]
        grid = np.meshgrid(*[np.arange(len(axis)) for axis in axes], indexing="ij")
        return {name: axis[index.ravel()] for name, axis, index in zip(free, axes, grid, strict=True)}
    assert design.count is not None
    shares = _shares(design.kind, design.count, len(free), design.seed)
    columns = {}
    for (name, one), share in zip(free.items(), shares.T, strict=True):
        if isinstance(one, Range):
            columns[name] = one.at(share)
        else:
            columns[name] = np.array(one)[np.minimum((share * len(one)).astype(int), len(one) - 1)]
    return columns


def _shares(kind: str, count: int, dimensions: int, seed: int) -> FloatArray:
    """Return points of the unit cube, shape (count, dimensions)."""
    rng = np.random.default_rng(seed)
    if kind == "random":
        return rng.random((count, dimensions))
    from scipy.stats import qmc

    if kind == "latin_hypercube":
        return np.asarray(qmc.LatinHypercube(dimensions, seed=rng).random(count))
    # Whole powers of two keep the balance of the sequence; the first points of the next one are taken.
    sampler = qmc.Sobol(dimensions, seed=rng)
    return np.asarray(sampler.random_base2(max(count - 1, 0).bit_length())[:count])


def _grid_axis(one: _Free) -> Column:
    """Return the values of a parameter in a grid, which has steps."""
    if not isinstance(one, Range):
        return np.array(one)
    assert one.steps is not None
    return one.at(np.linspace(0, 1, one.steps))


def _parameter(name: str, value: Any) -> Range | tuple[Any, ...] | Expression:
    """Return what a parameter takes: a range, values, or an expression."""
    if isinstance(value, Mapping):
        return Range.of(name, value)
    if isinstance(value, str):
        return Expression(name, value)
    if isinstance(value, Sequence) and value:
        if all(isinstance(one, (int, float)) and not isinstance(one, bool) for one in value):
            # Whole numbers stay whole: some parameters of scenes are integers.
            return tuple(one if isinstance(one, int) else finite(name, one) for one in value)
        if all(isinstance(one, str) for one in value):
            return tuple(value)
    raise UserError(
        f"{name} = {shown(value)} must be a range {{ low = .., high = .. }}, a list of numbers or of texts, or an "
        "expression in quotes; a single value belongs to [fixed]"
    )


def _design(given: Mapping[str, Any]) -> Design:
    """Check the design of a file."""
    check_keys("design", given, [one.name for one in fields(Design)])
    kind = given.get("kind", "table" if "file" in given else "sobol")
    if kind not in DESIGN_KINDS:
        raise UserError(f"design.kind = {shown(kind)} must be one of {', '.join(DESIGN_KINDS)}")
    file, count = given.get("file"), given.get("count")
    if (file is not None) != (kind == "table") or not isinstance(file, (str, type(None))):
        raise UserError(f"design.file = {shown(file)} must name a CSV file for kind = 'table', and only for it")
    if (count is None) == (kind not in ("grid", "table")):
        needs = "needs a number of runs" if count is None else "has the number of runs that its values give"
        raise UserError(f"design.count = {shown(count)}: a design of kind {kind!r} {needs}")
    return Design(
        kind,
        None if count is None else integer("design.count", count, 1, MOST_RUNS),
        integer("design.shots", given.get("shots", 1), 1, MOST_SHOTS),
        integer("design.seed", given.get("seed", 0), 0, 2**32 - 1),
        file,
    )


def _kept(given: Any) -> tuple[str, ...]:
    """Check what the store holds."""
    names = [given] if isinstance(given, str) else given
    if not isinstance(names, (list, tuple)) or not names:
        raise UserError(f"keep = {shown(given)} must be a list of {', '.join(KEPT)}")
    for name in names:
        if name not in KEPT:
            raise UserError(f"keep holds {shown(name)}: allowed are {', '.join(KEPT)}")
    return tuple(name for name in KEPT if name in names)


def _names(option: str, given: Any) -> tuple[str, ...]:
    """Check a list of names."""
    names = [given] if isinstance(given, str) else given
    if not isinstance(names, (list, tuple)) or not all(isinstance(name, str) for name in names):
        raise UserError(f"{option} = {shown(given)} must be a list of names")
    return tuple(names)


def _section(given: Mapping[str, Any], name: str) -> Mapping[str, Any]:
    """Return a table of a file, empty if it is not there."""
    section = given.get(name, {})
    if not isinstance(section, Mapping):
        raise UserError(f"{name} = {shown(section)} must be a table, as [{name}] begins")
    return section


def _resolved(name: str, folder: Path) -> str:
    """Return the absolute path of a file beside that of the campaign, any other name as it is."""
    path = folder / name
    return str(path.resolve()) if path.suffix and is_there(path) else name


def _plain(value: Any) -> Any:
    """Return a value that JSON can hold."""
    if isinstance(value, Mapping):
        return {str(key): _plain(one) for key, one in value.items()}
    if isinstance(value, (list, tuple, np.ndarray)):
        return [_plain(one) for one in value]
    if isinstance(value, np.generic):
        return value.item()
    return str(value) if isinstance(value, os.PathLike) else value
