"""Campaign plans: a campaign's file, and the table of its runs, with parameters that are expressions of others."""

from __future__ import annotations

import ast
import csv
import io
import json
import math
import operator
import os
from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass, field
from pathlib import Path
from typing import Annotated, Any, Literal, Union

import numpy as np
import numpy.typing as npt

from mitransient_lidar.core.errors import UserError
from mitransient_lidar.core.files import is_there, read_text
from mitransient_lidar.core.formats.documents import parse_toml, table
from mitransient_lidar.core.options import BackgroundPower, Option, Plan, Seed, positive_option
from mitransient_lidar.core.validation import FloatArray, finite, is_number, shown
from mitransient_lidar.physics.receiver.receiver_files import Setting
from mitransient_lidar.rendering.passes import LightOption

_OPERATORS: dict[type[ast.AST], Callable[..., Any]] = {
    ast.Add: operator.add,
    ast.Sub: operator.sub,
    ast.Mult: operator.mul,
    ast.Div: operator.truediv,
    ast.Pow: operator.pow,
    ast.USub: operator.neg,
    ast.UAdd: operator.pos,
}

_FUNCTIONS: dict[str, Callable[..., Any]] = {
    "sqrt": np.sqrt,
    "exp": np.exp,
    "log": np.log,
    "sin": np.sin,
    "cos": np.cos,
    "tan": np.tan,
    "min": np.minimum,
    "max": np.maximum,
}

_LONGEST = 500  #: Most characters in an expression: its evaluation is recursive.

_ALLOWED = f"numbers, parameters, + - * / ** ( ) and {', '.join(_FUNCTIONS)}"


class Expression:
    """An arithmetic expression of named quantities, such as ``0.8 * attenuation``.

    It may contain numbers, names, ``+ - * / **``, parentheses, and the functions ``sqrt``, ``exp``, ``log``, ``sin``,
    ``cos``, ``tan`` (of radians), ``min`` and ``max`` (of two arguments).

    Raises UserError if it contains anything else.

    `name`: name of the quantity that it defines, for messages.
    """

    def __init__(self, name: str, text: str) -> None:
        self.name, self.text = name, text
        if len(text) > _LONGEST:
            raise UserError(f"{name} = {shown(text)} has {len(text)} characters: it may have {_LONGEST}")
        try:
            self._tree = ast.parse(text.strip(), mode="eval").body
        except (SyntaxError, ValueError, RecursionError, MemoryError):
            raise UserError(f"{name} = {shown(text)} is no expression: it may hold {_ALLOWED}") from None
        functions = {id(node.func) for node in ast.walk(self._tree) if isinstance(node, ast.Call)}
        for node in ast.walk(self._tree):
            self._check(node, functions)
        #: Names of the quantities that it needs.
        self.names = {
            node.id for node in ast.walk(self._tree) if isinstance(node, ast.Name) and id(node) not in functions
        }

    def _check(self, node: ast.AST, functions: set[int]) -> None:
        """Refuse a part that is not arithmetic."""
        known = isinstance(node, (ast.BinOp, ast.UnaryOp, ast.Load, ast.Name)) or type(node) in _OPERATORS
        if isinstance(node, ast.Name) and id(node) in functions:
            known = node.id in _FUNCTIONS
        elif isinstance(node, ast.Call):
            count = 2 if isinstance(node.func, ast.Name) and node.func.id in ("min", "max") else 1
            known = isinstance(node.func, ast.Name) and not node.keywords and len(node.args) == count
        elif isinstance(node, ast.Constant):
            known = isinstance(node.value, (int, float)) and not isinstance(node.value, bool)
        if not known:
            part = ast.get_source_segment(self.text.strip(), node) or type(node).__name__
            raise UserError(f"{self.name} = {self.text!r} holds {shown(part)}: it may hold {_ALLOWED}")

    def evaluate(self, values: Mapping[str, FloatArray]) -> FloatArray:
        """Return the value for arrays of equal shape by name; raise `UserError` where it is not finite."""
        with np.errstate(all="ignore"):
            try:
                found = np.asarray(self._value(self._tree, values), dtype=np.float64)
            except OverflowError:
                found = np.asarray(np.inf)
        if not np.all(np.isfinite(found)):
            raise UserError(f"{self.name} = {self.text!r} is not finite in every run")
        return found

    def _value(self, node: ast.AST, values: Mapping[str, FloatArray]) -> Any:
        if isinstance(node, ast.Constant):
            # NumPy's numbers divide by zero and overflow as arrays do.
            return np.float64(node.value)  # type: ignore[arg-type]
        if isinstance(node, ast.Name):
            return values[node.id]
        if isinstance(node, ast.UnaryOp):
            return _OPERATORS[type(node.op)](self._value(node.operand, values))
        if isinstance(node, ast.BinOp):
            left, right = self._value(node.left, values), self._value(node.right, values)
            return _OPERATORS[type(node.op)](left, right)
        assert isinstance(node, ast.Call)
        assert isinstance(node.func, ast.Name)
        return _FUNCTIONS[node.func.id](*(self._value(each, values) for each in node.args))


#: Design kinds: every combination; points of a sequence, of a Latin hypercube, or random ones; file rows.
DesignKind = Literal["grid", "sobol", "latin_hypercube", "random", "table"]

KEPT = ("waveform", "stderr", "components", "echoes", "truth")  #: Store contents that a campaign may keep.
MOST_RUNS, MOST_SHOTS = 10**7, 10_000  #: Most runs in a campaign, and most shots in a run.

#: Most values in all parameters and runs, and in a table file, a million rows of ten numbers.
_MOST_VALUES, _MOST_CELLS = 10**8, 2 * 10**7

_LARGEST_TABLE = 2**27  #: Largest table of runs [bytes].

Column = npt.NDArray[Any]

#: Allowed for a design parameter: a range, or values.
_Free = Union["Range", tuple[Any, ...]]

#: Allowed for a parameter that varies.
_Varied = Union["Range", tuple[Any, ...], Expression]


@dataclass(frozen=True)
class Range(Plan):
    """Range of a parameter, uniform in the value or in its logarithm."""

    low: Annotated[float, Option("Low end")]
    high: Annotated[float, Option("High end, more than the low one")]
    scale: Annotated[Literal["linear", "log"], Option("Scale in which the range is uniform")] = "linear"
    steps: Annotated[int | None, Option("Number of values in a grid, both ends among them", 2, 10**6)] = None

    @classmethod
    def of_parameter(cls, name: str, given: Mapping[str, Any]) -> Range:
        """Check a range of a file; raise `UserError` if it is empty, or not a range."""
        found = cls.of(given, f"parameters.{name}", f"{name}.")
        if not found.low < found.high:
            raise UserError(f"{name} has the empty range {found.low:g} to {found.high:g}: low must be less than high")
        if found.scale == "log" and found.low <= 0:
            raise UserError(f"{name}.low = {found.low:g} must be positive for the scale 'log'")
        return found

    def at(self, shares: FloatArray) -> FloatArray:
        """Return the values at shares of the range, 0 to 1."""
        if self.scale == "log":
            return np.asarray(np.exp(math.log(self.low) + shares * (math.log(self.high) - math.log(self.low))))
        return self.low + shares * (self.high - self.low)


@dataclass(frozen=True)
class Design(Plan):
    """Choice of a campaign's runs."""

    kind: Annotated[DesignKind, Option("Kind, by default table with a file")] = "sobol"
    count: Annotated[int | None, Option("Number of runs", 1, MOST_RUNS)] = None
    shots: Annotated[int, Option("Places on each sea", 1, MOST_SHOTS)] = 1
    seed: Seed = 0
    file: Annotated[str | None, Option("CSV file with a row for each run", form="the name of a CSV file")] = None

    def __post_init__(self) -> None:
        super().__post_init__()
        if (self.file is not None) != (self.kind == "table"):
            raise UserError(
                f"design.file = {shown(self.file)} must name a CSV file for kind = 'table', and only for it"
            )
        if (self.count is None) == (self.kind not in ("grid", "table")):
            needs = "needs a number of runs" if self.count is None else "has the number of runs that its values give"
            raise UserError(f"design.count = {shown(self.count)}: a design of kind {self.kind!r} {needs}")


@dataclass(frozen=True, kw_only=True)
class Campaign(Plan):
    """A campaign, as its file describes it; its relative paths start from `folder`.

    A parameter that varies is a `Range`, a tuple of values, or an `Expression` of the others. `text` is the campaign as
    JSON, from which `from_json` returns it.
    """

    scene: Annotated[str, Option("Scene", form="the name of a shipped scene or the path of an XML file")]
    target_error: Annotated[float, positive_option("Relative standard error of each run's median bin")] = 0.05
    max_time: Annotated[
        float | None,
        positive_option("Longest time for the passes of each run; one that it ends has other bits elsewhere", "s"),
    ] = None
    light: LightOption = "merging"
    keep: Annotated[tuple[str, ...], Option(f"Store contents, of {', '.join(KEPT)}")] = ("waveform", "truth")
    instrument: Annotated[str | None, Option("Instrument instead of the scene's lidar")] = None
    derivatives: Annotated[
        tuple[str, ...], Option("Parameters by which waveforms are differentiated, kept as waveform_derivative")
    ] = ()
    receiver: Annotated[str | None, Option("Receiver chain of every pixel, whose noisy signal is kept as well")] = None
    gain: Annotated[Setting, Option("Factor of its gain", 0, above=True)] = 1.0
    optical_density: Annotated[Setting, Option("Optical density of its filter", 0, 12)] = 0.0
    background_power_w: BackgroundPower = 0.0
    fixed: Annotated[Mapping[str, Any], Option("Parameters of the scene that are the same in all runs")] = field(
        default_factory=dict
    )
    parameters: Annotated[Mapping[str, _Varied], Option("Parameters that vary")] = field(default_factory=dict)
    design: Annotated[Design, Option("Choice of the runs")]
    folder: Path = Path()
    text: str = ""

    def __post_init__(self) -> None:
        super().__post_init__()
        if self.light == "maps" and self.derivatives:
            raise UserError("light = 'maps' has no derivatives: use light = 'merging'")
        if not self.keep:
            raise UserError(f"keep = [] must be a list of {', '.join(KEPT)}")
        if unknown := [name for name in self.keep if name not in KEPT]:
            raise UserError(f"keep holds {shown(unknown[0])}: allowed are {', '.join(KEPT)}")
        object.__setattr__(self, "keep", tuple(name for name in KEPT if name in self.keep))
        if twice := [name for name in self.parameters if name in self.fixed]:
            raise UserError(f"parameter {twice[0]!r} is in [fixed] and in [parameters]: leave out one of them")

    @classmethod
    def read(cls, path: str | os.PathLike[str]) -> Campaign:
        """Read a TOML file; raise `UserError` if it cannot be read, is not TOML, or describes no campaign."""
        return cls.of_file(parse_toml(read_text(path), path), Path(path).resolve().parent)

    @classmethod
    def of_file(cls, given: Mapping[str, Any], folder: Path | None = None) -> Campaign:
        """Check a campaign given as a dict with its file's contents; raise `UserError` if it is invalid."""
        folder = Path.cwd() if folder is None else folder
        values = dict(given)
        if isinstance(values.get("scene"), (str, os.PathLike)):
            values["scene"] = _resolved(os.fspath(values["scene"]), folder)
        if isinstance(design := values.get("design"), Mapping) and "file" in design:
            values["design"] = {"kind": "table", **design}
        varied = table("parameters", values.get("parameters", {}))
        values["parameters"] = {name: _parameter(name, value) for name, value in varied.items()}
        try:
            text = json.dumps(_plain(given))
        except (TypeError, ValueError, RecursionError):
            raise UserError("the campaign must hold numbers, texts, lists and tables only") from None
        campaign = cls.of(values, "a campaign", folder=folder, text=text)
        if campaign.receiver is None and (
            told := [name for name in ("gain", "optical_density", "background_power_w") if name in given]
        ):
            raise UserError(f'{told[0]} = {shown(given[told[0]])} needs a receiver, as in receiver = "apd"')
        return campaign

    @classmethod
    def from_json(cls, text: str) -> Campaign:
        """Return the campaign of a `text`."""
        return cls.of_file(json.loads(text))

    def lit_by(self, light: str | None) -> Campaign:
        """Return the campaign with another `light`; itself if None."""
        return self if light is None else Campaign.of_file({**json.loads(self.text), "light": light}, self.folder)

    @property
    def needed_names(self) -> set[str]:
        """Names of the scene parameters that the runs set, without a table's."""
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
        """Return the columns of a design's table."""
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
            raise UserError(f"{path} is not a CSV file") from error
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
    """Return the number of runs in a design other than a table."""
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
    """Return points in the unit cube, shape (count, dimensions)."""
    rng = np.random.default_rng(seed)
    if kind == "random":
        return rng.random((count, dimensions))
    from scipy.stats import qmc

    if kind == "latin_hypercube":
        return np.asarray(qmc.LatinHypercube(dimensions, seed=rng).random(count))
    # Whole powers of two keep the sequence balanced; the first points of the next one are taken.
    sampler = qmc.Sobol(dimensions, seed=rng)
    return np.asarray(sampler.random_base2(max(count - 1, 0).bit_length())[:count])


def _grid_axis(one: _Free) -> Column:
    """Return the values of a parameter in a grid, which has steps."""
    if not isinstance(one, Range):
        return np.array(one)
    assert one.steps is not None
    return one.at(np.linspace(0, 1, one.steps))


def _parameter(name: str, value: Any) -> _Varied:
    """Return a parameter's range, values, or expression."""
    if isinstance(value, Mapping):
        return Range.of_parameter(name, value)
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


def _resolved(name: str, folder: Path) -> str:
    """Return the absolute path of a file beside the campaign's, and any other name unchanged."""
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
