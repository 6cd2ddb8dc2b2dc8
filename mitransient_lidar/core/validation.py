"""Validators of numeric parameters: each returns the clean value or raises ``UserError`` with one sentence."""

import math

import numpy as np
import numpy.typing as npt

from mitransient_lidar.core.errors import UserError

FloatArray = npt.NDArray[np.float64]
IntArray = npt.NDArray[np.int64]


def finite(name: str, value: object) -> float:
    """Return `value` as a float; reject anything that is not a finite number."""
    try:
        number = float(value)  # type: ignore[arg-type]
    except (TypeError, ValueError):
        raise UserError(f"{name} = {value!r} must be a number") from None
    if not math.isfinite(number):
        raise UserError(f"{name} = {number} must be finite")
    return number


def positive(name: str, value: object) -> float:
    """Return `value` as a float above 0."""
    number = finite(name, value)
    if number <= 0:
        raise UserError(f"{name} = {number:g} must be greater than 0")
    return number


def non_negative(name: str, value: object) -> float:
    """Return `value` as a float of at least 0."""
    number = finite(name, value)
    if number < 0:
        raise UserError(f"{name} = {number:g} must not be negative")
    return number


def in_range(name: str, value: object, low: float, high: float) -> float:
    """Return `value` as a float in the closed interval [`low`, `high`]; `high` may be infinite."""
    number = finite(name, value)
    if not low <= number <= high:
        limits = f"be at least {low:g}" if high == math.inf else f"lie between {low:g} and {high:g}"
        raise UserError(f"{name} = {number:g} must {limits}")
    return number


def integer(name: str, value: object, low: int, high: int) -> int:
    """Return `value` as an integer in the closed interval [`low`, `high`]."""
    number = in_range(name, value, low, high)
    if number != int(number):
        raise UserError(f"{name} = {number:g} must be an integer")
    return int(number)


def finite_array(name: str, values: npt.ArrayLike) -> FloatArray:
    """Return `values` as a new float64 array without NaN or infinity."""
    try:
        array = np.array(values, dtype=np.float64)
    except (TypeError, ValueError):
        raise UserError(f"{name} = {values!r} must hold numbers only") from None
    if not np.all(np.isfinite(array)):
        bad = array[~np.isfinite(array)][0]
        raise UserError(f"{name} holds {bad} but every value must be finite")
    return array


def non_negative_array(name: str, values: npt.ArrayLike) -> FloatArray:
    """Return `values` as a new float64 array of finite numbers of at least 0."""
    array = finite_array(name, values)
    if np.any(array < 0):
        raise UserError(f"{name} = {array.min():g} must not be negative")
    return array


def increasing_array(name: str, values: npt.ArrayLike) -> FloatArray:
    """Return `values` as a new one-dimensional float64 array of 2 or more strictly increasing numbers."""
    array = finite_array(name, values)
    if array.ndim != 1 or array.size < 2:
        raise UserError(f"{name} of shape {array.shape} must be a list of at least 2 numbers")
    for i in np.flatnonzero(np.diff(array) <= 0)[:1]:
        raise UserError(f"{name} must increase strictly, but {array[i]:g} is followed by {array[i + 1]:g}")
    return array


def time_samples(times_ns: npt.ArrayLike, name: str, values: npt.ArrayLike) -> tuple[FloatArray, FloatArray]:
    """Return strictly increasing times, 2 or more, and one value for each."""
    t, v = increasing_array("times_ns", times_ns), finite_array(name, values)
    if t.shape != v.shape:
        raise UserError(f"times_ns of shape {t.shape} and {name} of shape {v.shape} must have equal lengths")
    return t, v
