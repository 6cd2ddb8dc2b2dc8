"""Validators of numeric parameters: each returns the clean value or raises ``UserError`` with one sentence."""

import contextlib
import logging
import math
import operator
import os
import resource
from collections.abc import Callable
from dataclasses import MISSING, dataclass, field, fields
from pathlib import Path
from typing import Any

import numpy as np
import numpy.typing as npt
from numpy.typing import ArrayLike as ArrayLike

from mitransient_lidar.core.errors import UserError

FloatArray = npt.NDArray[np.float64]
IntArray = npt.NDArray[np.int64]
BoolArray = npt.NDArray[np.bool_]

_LOG = logging.getLogger(__name__)


def finite(name: str, value: object) -> float:
    """Return a number, or its text, as a float; reject NaN, infinity and other types."""
    number: float | None
    try:
        number = float(value)  # type: ignore[arg-type]
    except (TypeError, ValueError):
        number = None
    except OverflowError:
        number = math.inf
    if number is None or isinstance(value, bool) or getattr(value, "ndim", 0) > 0:
        raise UserError(f"{name} = {shown(value)} must be a number")
    if not math.isfinite(number):
        raise UserError(f"{name} = {number} must be finite")
    return number


def positive(name: str, value: object) -> float:
    """Return `value` as a float above 0."""
    return number_within(name, value, 0, above=True)


def non_negative(name: str, value: object) -> float:
    """Return `value` as a float of at least 0."""
    number = finite(name, value)
    if number < 0:
        raise UserError(f"{name} = {number:g} must not be negative")
    return number


def relative_error(name: str, value: object) -> float:
    """Return `value`, a share and not a percentage, as a float above 0, at most 1."""
    number = positive(name, value)
    if number > 1:
        raise UserError(
            f"{name} = {number:g} is an error of {100 * number:g} % but must be at most 1: did you mean "
            f"{number / 100:g}, which is {number:g} %?"
        )
    return number


def in_range(name: str, value: object, low: float, high: float) -> float:
    """Return `value` as a float in the closed interval [`low`, `high`]; `high` may be infinite."""
    number = finite(name, value)
    if not low <= number <= high:
        limits = f"be at least {low:g}" if high == math.inf else f"lie between {low:g} and {high:g}"
        raise UserError(f"{name} = {number:g} must {limits}")
    return number


def number_within(
    name: str, value: object, low: float = -math.inf, high: float = math.inf, *, above: bool = False
) -> float:
    """Return `value` as a float from `low`, or `above` it, to `high`; limits may be infinite."""
    if above:
        number = finite(name, value)
        if not low < number <= high:
            most = "" if high == math.inf else f" and at most {high:g}"
            raise UserError(f"{name} = {number:g} must be greater than {low:g}{most}")
        return number
    if (low, high) == (0, math.inf):
        return non_negative(name, value)
    return finite(name, value) if low == -math.inf else in_range(name, value, low, high)


def integer(name: str, value: Any, low: int, high: int) -> int:
    """Return `value`, an integer or a float without decimals but no text, as an integer in [`low`, `high`]."""
    if isinstance(value, np.ndarray) and value.ndim == 0:
        value = value.item()
    if isinstance(value, (float, np.floating)) and value.is_integer():
        value = int(value)
    try:
        number = None if isinstance(value, bool) or getattr(value, "ndim", 0) > 0 else operator.index(value)
    except TypeError:
        number = None
    if number is None:
        raise UserError(f"{name} = {shown(value)} must be an integer between {low} and {high}")
    if not low <= number <= high:
        raise UserError(f"{name} = {shown(number)} must lie between {low} and {high}")
    return number


def shown(value: object) -> str:
    """Return the text of a value for a message, shortened, on one line."""
    if isinstance(value, int) and abs(value) > 10**30:
        return f"{'-' if value < 0 else ''}1e{int(math.log10(abs(value)))}"
    text = " ".join(repr(value).split())
    return text if len(text) <= 80 else f"{text[:77]}..."


def finite_array(name: str, values: ArrayLike) -> FloatArray:
    """Return `values` as a new float64 array without NaN or infinity."""
    try:
        array = np.array(values, dtype=np.float64)
    except (TypeError, ValueError, OverflowError):
        raise UserError(f"{name} = {shown(values)} must hold numbers only") from None
    if not np.all(np.isfinite(array)):
        bad = array[~np.isfinite(array)][0]
        raise UserError(f"{name} holds {bad} but every value must be finite")
    return array


def number_list(name: str, given: object) -> FloatArray:
    """Return one number, a sequence, or a text with numbers separated by commas or spaces, shape (N,), N > 0.

    Raises `UserError` if there is no number, an entry is empty or not a number, or a number is not finite.
    """
    values: Any = given
    if isinstance(given, str):
        entries = [entry.split() for entry in given.split(",")]
        if not all(entries):
            missing = "has an empty entry" if any(entries) else "is empty"
            raise UserError(f"{name} = {shown(given)} {missing}: it must be numbers separated by commas")
        values = [word for entry in entries for word in entry]
        if any(not is_number(word) for word in values):
            raise UserError(f"{name} = {shown(given)} must hold numbers only, separated by commas")
    array = np.atleast_1d(finite_array(name, values))
    if array.ndim != 1 or array.size == 0:
        raise UserError(f"{name} = {shown(given)} must hold at least one number")
    return array


def is_number(text: str) -> bool:
    """Return whether a text is a number, which may be NaN or infinite."""
    try:
        float(text)
    except ValueError:
        return False
    return True


def non_negative_array(name: str, values: ArrayLike) -> FloatArray:
    """Return `values` as a new float64 array with finite numbers of at least 0."""
    array = finite_array(name, values)
    if np.any(array < 0):
        raise UserError(f"{name} = {array.min():g} must not be negative")
    return array


def increasing_array(name: str, values: ArrayLike) -> FloatArray:
    """Return `values` as a new one-dimensional float64 array of 2 or more strictly increasing numbers."""
    array = finite_array(name, values)
    if array.ndim != 1 or array.size < 2:
        raise UserError(f"{name} of shape {array.shape} must be a list of at least 2 numbers")
    for i in np.flatnonzero(np.diff(array) <= 0)[:1]:
        raise UserError(f"{name} must increase strictly, but {array[i]:g} is followed by {array[i + 1]:g}")
    return array


def time_samples(times_ns: ArrayLike, name: str, values: ArrayLike) -> tuple[FloatArray, FloatArray]:
    """Return strictly increasing times, 2 or more, and one value for each."""
    t, v = increasing_array("times_ns", times_ns), finite_array(name, values)
    if t.shape != v.shape:
        raise UserError(f"times_ns of shape {t.shape} and {name} of shape {v.shape} must have equal lengths")
    return t, v


def checked(check: Callable[..., object], *limits: float, default: Any = MISSING) -> Any:
    """Return a field of a dataclass `Checked` whose value a validator must accept, with its limits."""
    return field(default=default, metadata={"check": lambda name, value: check(name, value, *limits)})


@dataclass(frozen=True)
class Checked:
    """Dataclass whose fields by `checked` contain their validators' results; None may stay where it is the default."""

    def __post_init__(self) -> None:
        for one in fields(self):
            value = getattr(self, one.name)
            if "check" in one.metadata and not (value is None and one.default is None):
                object.__setattr__(self, one.name, one.metadata["check"](one.name, value))


def usable_memory() -> float:
    """Return the memory that large arrays may take [bytes]: half of what machine and limits give this process."""
    limits = [float(os.sysconf("SC_PAGE_SIZE") * os.sysconf("SC_PHYS_PAGES"))]
    soft = [resource.getrlimit(kind)[0] for kind in (resource.RLIMIT_AS, resource.RLIMIT_DATA)]
    limits += [float(limit) for limit in soft if limit != resource.RLIM_INFINITY]
    # Limit in a container: a number, or "max".
    with contextlib.suppress(OSError, ValueError):
        limits.append(float(Path("/sys/fs/cgroup/memory.max").read_text("ascii")))
    return min(limits) / 2


def require_memory(what: str, size: float, advice: str, least: float | None = None) -> float:
    """Raise `UserError` if arrays with a size [bytes] exceed `usable_memory`; `what` is their name in the plural.

    Return their size: arrays that work with less, down to `least`, are cut to that memory.
    """
    most = usable_memory()
    taken = size if least is None else max(min(size, most), least)
    _LOG.debug("%s take %g bytes", what, taken)
    if taken > most:
        raise UserError(f"{what} take {taken / 1e9:.3g} GB of memory, and at most {most / 1e9:.3g} GB may be: {advice}")
    return taken
