"""Options of functions, and tables of files: meanings and ranges, from which checks and documentation follow."""

from __future__ import annotations

import contextlib
import functools
import html
import importlib
import inspect
import math
import re
import sys
import textwrap
import time
import types
from collections.abc import Callable, Iterable, Iterator, Mapping, Sequence
from contextvars import ContextVar
from dataclasses import MISSING, Field, dataclass, fields
from typing import (
    Annotated,
    Any,
    ClassVar,
    Literal,
    ParamSpec,
    Self,
    TypeVar,
    Union,
    get_args,
    get_origin,
    get_type_hints,
)

import numpy as np

from mitransient_lidar.core.errors import UserError
from mitransient_lidar.core.formats.documents import check_keys, required, table
from mitransient_lidar.core.validation import (
    FloatArray,
    finite_array,
    integer,
    number_list,
    number_within,
    relative_error,
    shown,
)

#: Shortest time between two states that are shown [s].
_INTERVAL_S = 0.2

#: Whether a public function runs: of one that calls others, the notebook shows the whole alone.
_running: ContextVar[bool] = ContextVar("running", default=False)


@contextlib.contextmanager
def progress_of(given: Callable[[Any], None] | None) -> Iterator[Callable[[Any], None] | None]:
    """Yield the function that takes the progress of a call: the given one, or one that shows it in a notebook.

    It is None outside notebooks. The states have ``done``, ``planned`` (None if unknown), and a text. IPython's display
    needs no widgets, unlike the bars of rich and tqdm; it is removed when the call ends.
    """
    shell = getattr(sys.modules.get("IPython"), "get_ipython", lambda: None)()
    shown = given is None and hasattr(shell, "kernel") and not _running.get()
    token = _running.set(True)
    try:
        with _bar() if shown else contextlib.nullcontext(given) as show:
            yield show
    finally:
        _running.reset(token)


@contextlib.contextmanager
def _bar() -> Iterator[Callable[[Any], None]]:
    """Show the latest state as a bar with its text."""
    display: Any = importlib.import_module("IPython.display")
    handle, latest = display.display(display.HTML("preparing"), display_id=True), [0.0]

    def show(state: Any) -> None:
        if (now := time.monotonic()) - latest[0] >= _INTERVAL_S:
            latest[0] = now
            share = "" if state.planned is None else f' value="{state.done}" max="{state.planned}"'
            handle.update(display.HTML(f"<progress{share}></progress> {html.escape(str(state))}"))

    try:
        yield show
    finally:
        handle.update(display.HTML(""))


_P = ParamSpec("_P")
_R = TypeVar("_R")

#: Numbers in a list or an array, shape (N,).
Numbers = Sequence[float] | FloatArray


@dataclass(frozen=True)
class Option:
    """Meaning and range of a parameter, in the annotation of a public function."""

    meaning: str  #: Verb or quantity, without unit and range; may have several sentences, the last one without a stop.
    #: Limits of a number, or of each number in a list; None where there is none. `low` itself is excluded if `above`.
    low: float | None = None
    high: float | None = None
    unit: str = ""  #: Unit of numbers.
    above: bool = False
    ascending: bool = False  #: Whether the numbers in a list must increase.
    #: Form of a text that stands for the value on the command line, e.g. ``N,N,...``; empty for types that are read as
    #: they are. Words such as ``linear|log`` are the only ones allowed.
    form: str = ""
    flag: str = ""  #: Option name in commands, where it differs from the parameter's name.
    is_argument: bool = False  #: Whether commands take it by its place.

    def range(self) -> str:
        """Return the allowed numbers as text, empty without limits."""
        if self.low is None:
            return ""
        low, high = _number(self.low), "" if self.high is None else _number(self.high)
        if self.above:
            text = f"greater than {low}" + (f", at most {high}" if high else "")
        else:
            text = f"{low} to {high}" if high else f"at least {low}"
        return text + ", ascending" * self.ascending

    def help(self) -> str:
        """Return meaning, unit and range as a sentence."""
        limits, clause = self.range(), re.split("(?=[,;.])", self.meaning, maxsplit=1)
        meaning = f"{clause[0]} [{self.unit}]{''.join(clause[1:])}" if self.unit else self.meaning
        return f"{meaning}{f' ({limits})' if limits else ''}."

    def check(self, name: str, value: Any, kind: Any) -> Any:
        """Return a typed value as a number or a list of numbers; raise `UserError` if it is out of range."""
        kinds = parts(kind)
        if "|" in self.form and self.form.islower():
            return one_of(name, value, self.form.split("|"))
        if self.low is None or (isinstance(value, str) and value == "auto" and "auto" in kinds):
            return value
        if (isinstance(value, (list, tuple, np.ndarray)) or not {int, float} & {*kinds}) and _is_list(kinds):
            return self._check_list(name, value)
        return self.number(name, value, int in kinds)

    def number(self, name: str, value: Any, whole: bool = False) -> float | int:
        """Return a number, or a whole one; raise `UserError` if it is out of range."""
        low, high = -math.inf if self.low is None else self.low, math.inf if self.high is None else self.high
        if whole:
            return integer(name, value, int(low), int(high))
        if self.above and high == 1 and name.endswith("error"):
            return relative_error(name, value)
        return number_within(name, value, low, high, above=self.above)

    def _check_list(self, name: str, values: Any) -> list[float]:
        numbers, low = number_list(name, values), self.low or 0
        inside = (numbers > low if self.above else numbers >= low) & (numbers <= (self.high or np.inf))
        if not inside.all() or (self.ascending and np.any(np.diff(numbers) <= 0)):
            raise UserError(f"{name} = {numbers.tolist()} must be numbers ({self.range()})")
        return list(values) if isinstance(values, (list, tuple)) else [float(number) for number in numbers]


def positive_option(meaning: str, unit: str = "") -> Option:
    """Return the declaration for a number greater than 0."""
    return Option(meaning, 0, unit=unit, above=True)


#: Arguments and options that functions share.
Scene = Annotated[Any, Option("Name of a shipped scene, or path of a Mitsuba XML file", form="SCENE", is_argument=True)]
SceneOrResult = Annotated[
    Any,
    Option(
        "Name of a shipped scene, path of a Mitsuba XML file, or result (.nc, .exr) to render again with its own "
        "options, unless others are given",
        form="SCENE",
        is_argument=True,
    ),
]
Seed = Annotated[int, Option("Random seed", 0, 2**53)]
FewerPasses = Annotated[float | None, positive_option("Stop before this many seconds, with fewer passes")]
TargetId = Annotated[str, Option("Id of the target's shape")]
BackgroundPower = Annotated[float, Option("Daylight power on each pixel", 0, unit="W")]
Instrument = Annotated[
    str | None, Option("Instrument that replaces the scene's lidar, as listed by scenes instruments")
]
Infrared = Annotated[
    bool, Option("Also render the instrument's infrared channel; -D infrared.NAME sets its parameters")
]
Sensor = Annotated[str | None, Option("Id of the scene's receiver, by default the first one")]

#: Meanings of arguments that are no options of commands, for the documentation.
_COMMON = {
    "params": Option("Values of the scene's parameters by name, as for `rendering.render.render`"),
    "integrator": Option("Integrator instead of the scene's, as for `rendering.render.render`"),
    "progress": Option("Called with a `rendering.passes.Progress` after every pass, render or case"),
}

#: Beginning of a receiver's meaning.
RECEIVERS = (
    "Receiver: ideal, photodiode, pmt, pmt_log, apd, sipm, spad or spad_array, the name of an instrument, or a TOML "
    "file"
)
#: The same where gates may be recorded.
RECEIVERS_OR_CAMERAS = (
    "Receiver of waveforms: ideal, photodiode, pmt, pmt_log, apd, sipm, spad or spad_array, or the name of an "
    "instrument; camera for gates: iccd, icmos, ebcmos, emccd, spad_camera or gated_cmos; or a TOML file of either"
)


def declared(function: Callable[..., Any]) -> dict[str, tuple[Any, Option]]:
    """Return types and `Option` for those parameters of a function, or fields of a class, that have one."""
    found: dict[str, tuple[Any, Option]] = {}
    hinted: Any = inspect.unwrap(function)
    if isinstance(function, type):
        hints = get_type_hints(function, include_extras=True)
    else:  # other types are not evaluated: checkers alone may know them, and help does without xarray
        given = {name: str(text) for name, text in hinted.__annotations__.items() if name != "return"}
        hints = {name: eval(text, hinted.__globals__) for name, text in given.items() if _may_have(text, hinted)}
    for name, hint in hints.items():
        if get_origin(hint) is Annotated:
            kind, *others = get_args(hint)
            found.update((name, (kind, one)) for one in others if isinstance(one, Option))
    return found


def _may_have(text: str, function: Any) -> bool:
    """Return whether an annotation as text may have an `Option`: a name, also in a module of the package, or a type."""
    if dotted := re.fullmatch(r"(\w+)\.[\w.]+", text):
        return getattr(function.__globals__.get(dotted[1]), "__name__", "").startswith("mitransient_lidar.")
    return text.isidentifier() or text.startswith("Annotated[")


def checked(function: Callable[_P, _R]) -> Callable[_P, _R]:
    """Return a function that checks its arguments by the `Option` of their annotations; None may stay where allowed.

    A notebook shows the progress of a function that has the parameter ``progress``, unless one is given.

    Its signature shows their types alone, and its documentation the options that it does not describe, for the help of
    Python. Raises `UserError` if a number is out of range; the sentence names the parameter.
    """
    signature, options = inspect.signature(function), declared(function)

    @functools.wraps(function)
    def run(*args: _P.args, **kwargs: _P.kwargs) -> _R:
        given = signature.bind(*args, **kwargs)
        for name, value in given.arguments.items():
            default = signature.parameters[name].default
            is_unset = (value is None and default is None) or (default == () and len(value) == 0)
            if name in options and not is_unset:
                kind, option = options[name]
                given.arguments[name] = option.check(name, value, kind)
        if "progress" not in signature.parameters:
            return function(*given.args, **given.kwargs)
        with progress_of(given.arguments.get("progress")) as given.arguments["progress"]:
            return function(*given.args, **given.kwargs)

    shown = [
        one.replace(annotation=options[name][0]) if name in options else one
        for name, one in signature.parameters.items()
    ]
    run.__signature__ = signature.replace(parameters=shown)  # type: ignore[attr-defined]
    meanings = {name: option for name, (_, option) in options.items()}
    run.__doc__ = _documented(function.__doc__ or "", meanings, signature.parameters)
    return run


def _documented(text: str, options: Mapping[str, Option], names: Iterable[str]) -> str:
    """Return a documentation whose section of parameters has all options, and others by their `names`.

    Those that it describes stay.
    """
    beginning, heading, rest = text.partition("Parameters\n    ----------\n")
    described, blank, end = rest.partition("\n\n")
    known = {name for line in described.splitlines() if line[4:5].strip() for name in re.findall(r"\w+", line)}
    listed = {**options, **{name: _COMMON[name] for name in names if name in _COMMON}}
    added = [f"\n    {name}\n{_indented(option.help())}" for name, option in listed.items() if name not in known]
    if not heading:
        return documented_parameters(text, listed)
    return f"{beginning}{heading}{described}{''.join(added)}{blank}{end}"


def documented_parameters(text: str, options: Mapping[str, Option]) -> str:
    """Return a documentation with a parameter section, after its first paragraphs."""
    if not options:
        return text
    beginning, *sections = re.split(r"\n\n(?=    \w+\n    -{4,}\n)", text.rstrip())
    listed = "\n".join(f"    {name}\n{_indented(option.help())}" for name, option in options.items())
    return "\n\n".join([beginning, f"    Parameters\n    ----------\n{listed}", *sections]) + "\n    "


def _indented(text: str) -> str:
    return textwrap.fill(text, 120, initial_indent=" " * 8, subsequent_indent=" " * 8)


def _is_list(kinds: tuple[Any, ...]) -> bool:
    """Return whether one of the types is a list or array type."""
    origins = [get_origin(one) for one in kinds]
    return any(isinstance(one, type) and issubclass(one, Sequence | np.ndarray) for one in origins)


def parts(kind: Any) -> tuple[Any, ...]:
    """Return the types in a union, and the words in a literal."""
    if get_origin(kind) in (Union, types.UnionType, Literal):
        return tuple(part for one in get_args(kind) for part in parts(one))
    return (kind,)


def _number(value: float) -> str:
    """Return a limit as text: 100 000, 10^9, 2^53, 2^63 - 1, 1/512, 0.01 or 1e-12."""
    if isinstance(value, int):
        size, sign = abs(value), "-" * (value < 0)
        if size > 10**6 and (power := len(str(size)) - 1) and size == 10**power:
            return f"{sign}10^{power}"
        if size > 10**6 and (bits := (size + 1).bit_length() - 1) and size in (2**bits - 1, 2**bits):
            return f"{sign}2^{bits}{' - 1' if size < 2**bits else ''}"
        return f"{value:,}".replace(",", " ") if size >= 10**4 else str(value)
    if 0 < value < 0.01 and (1 / value).is_integer() and int(1 / value).bit_count() == 1:
        return f"1/{1 / value:g}"
    return f"{value:g}".replace("e-0", "e-")


_AnyPlan = TypeVar("_AnyPlan", bound="Plan")


@dataclass(frozen=True)
class Plan:
    """Base of frozen dataclasses whose fields have types and an `Option` in their annotations.

    Values are checked and converted when an object is made, and documented as parameters. None stays where it is the
    default. Fields without an `Option` are not checked, and are no keys of a file.
    """

    _kinds: ClassVar[Mapping[str, tuple[Any, Option]]] = {}

    def __init_subclass__(cls) -> None:
        super().__init_subclass__()
        cls._kinds = declared(cls)
        own = {name: option for name, (_, option) in cls._kinds.items() if name in cls.__annotations__}
        cls.__doc__ = documented_parameters(cls.__doc__ or "", own)

    def __post_init__(self) -> None:
        for one in fields(self):
            if one.name in self._kinds:
                value = _checked(one, getattr(self, one.name), one.name, *self._kinds[one.name])
                object.__setattr__(self, one.name, value)

    @classmethod
    def keys(cls) -> list[str]:
        """Return a table's keys, in their order."""
        return [one.name for one in fields(cls) if one.name in cls._kinds]

    @classmethod
    def of(cls, given: object, where: str = "", prefix: str = "", **others: Any) -> Self:
        """Return the object for a table in a file.

        In messages the table is `where`, such as ``[design]``, and names of values begin with `prefix`, such as
        ``design.``. `others` are fields that are no keys. Raises `UserError` if it is no table, a key is unknown or
        missing, or a value is not allowed.
        """
        where = where or f"[{cls.__name__.lower()}]"
        values = table(where, given)
        check_keys(where, values, cls.keys())
        found = {}
        for one in fields(cls):
            if one.name in values:
                found[one.name] = _checked(one, values[one.name], f"{prefix}{one.name}", *cls._kinds[one.name])
            elif one.name in cls._kinds and one.default is MISSING and one.default_factory is MISSING:
                required(where, values, one.name)
        return cls(**found, **others)


def of_kind(name: str, given: object, kinds: Mapping[str, type[_AnyPlan]]) -> _AnyPlan:
    """Return the object for a plan table whose ``kind`` names its class; raise `UserError` as `Plan.of`."""
    values = dict(table(name, given))
    kind = required(f"[{name}]", values, "kind")
    if not isinstance(kind, str) or kind not in kinds:
        raise UserError(f"kind = {shown(kind)} of a {name} must be one of {', '.join(kinds)}")
    return kinds[kind].of({key: value for key, value in values.items() if key != "kind"}, f"a {name} of kind {kind!r}")


def one_of(name: str, value: Any, allowed: Any) -> Any:
    """Return a text; raise `UserError` unless it is one of those allowed."""
    if not isinstance(value, str) or value not in allowed:
        raise UserError(f"{name} = {shown(value)} must be one of {', '.join(allowed)}")
    return value


def _checked(field: Field[Any], value: Any, name: str, kind: Any, option: Option) -> Any:
    """Return a typed value, or its field's default; raise `UserError` for another."""
    default = field.default
    if type(value) is type(default) and value == default:
        return value
    kinds = parts(kind)
    words = [one for one in kinds if isinstance(one, str)]
    if value is not None and isinstance(value, str) and value in words:
        return value
    if bool in kinds:
        if not isinstance(value, bool):
            raise UserError(f"{name} = {shown(value)} must be true or false")
        return value
    if int in kinds or float in kinds:
        if words and (isinstance(value, (bool, str)) or not isinstance(value, (int, float, np.number))):
            raise UserError(f"{name} = {shown(value)} must be a number or {' or '.join(words)}")
        return option.number(name, value, int in kinds)
    return one_of(name, value, words) if words else _composed(name, value, kinds[0], option)


def _composed(name: str, value: Any, kind: Any, option: Option) -> Any:
    """Return a table, a list, a text, or an object of another class."""
    if isinstance(kind, type) and issubclass(kind, Plan):
        return value if isinstance(value, kind) else kind.of(table(name, value), f"[{name}]", f"{name}.")
    if get_origin(kind) is tuple and {str, float} & {*get_args(kind)}:
        return _list(name, value, get_args(kind), option)
    if get_origin(kind) is not None and issubclass(get_origin(kind), Mapping):
        return table(name, value)
    if kind is str and not isinstance(value, str):
        raise UserError(f"{name} = {shown(value)} must be {option.form or 'a name'}")
    return option.check(name, value, kind)


def _list(name: str, value: Any, kinds: tuple[Any, ...], option: Option) -> tuple[Any, ...]:
    """Return a list of texts, or of numbers that may be as many as their types."""
    if str in kinds:
        names = [value] if isinstance(value, str) else value
        if not isinstance(names, (list, tuple)) or not all(isinstance(one, str) for one in names):
            raise UserError(f"{name} = {shown(value)} must be a list of names")
        return tuple(names)
    ends = finite_array(name, value)
    if ends.ndim != 1 or (Ellipsis not in kinds and ends.size != len(kinds)):
        raise UserError(f"{name} = {shown(value)} must be {option.form or 'a list of numbers'}")
    return tuple(option.number(name, end) for end in ends.tolist())
