"""Validators of numeric parameters: each returns the clean value or raises ``ValueError`` in one sentence."""

import math

import numpy as np
import numpy.typing as npt

FloatArray = npt.NDArray[np.float64]


def finite(name: str, value: object) -> float:
    """Return `value` as a float; reject anything that is not a finite number."""
    try:
        number = float(value)  # type: ignore[arg-type]
    except (TypeError, ValueError):
        raise ValueError(f"{name} = {value!r} must be a number") from None
    if not math.isfinite(number):
        raise ValueError(f"{name} = {number} must be finite")
    return number


def positive(name: str, value: object) -> float:
    """Return `value` as a float above 0."""
    number = finite(name, value)
    if number <= 0:
        raise ValueError(f"{name} = {number:g} must be greater than 0")
    return number


def non_negative(name: str, value: object) -> float:
    """Return `value` as a float of at least 0."""
    number = finite(name, value)
    if number < 0:
        raise ValueError(f"{name} = {number:g} must not be negative")
    return number


def in_range(name: str, value: object, low: float, high: float) -> float:
    """Return `value` as a float in the closed interval [`low`, `high`]."""
    number = finite(name, value)
    if not low <= number <= high:
        raise ValueError(f"{name} = {number:g} must lie between {low:g} and {high:g}")
    return number


def whole(name: str, value: object, low: int, high: int) -> int:
    """Return `value` as a whole number in the closed interval [`low`, `high`]."""
    number = in_range(name, value, low, high)
    if number != int(number):
        raise ValueError(f"{name} = {number:g} must be a whole number")
    return int(number)


def finite_array(name: str, values: npt.ArrayLike) -> FloatArray:
    """Return `values` as a new float64 array without NaN or infinity."""
    try:
        array = np.array(values, dtype=np.float64)
    except (TypeError, ValueError):
        raise ValueError(f"{name} = {values!r} must hold numbers only") from None
    if not np.all(np.isfinite(array)):
        bad = array[~np.isfinite(array)][0]
        raise ValueError(f"{name} holds {bad} but every value must be finite")
    return array


def samples(times_ns: npt.ArrayLike, name: str, values: npt.ArrayLike) -> tuple[FloatArray, FloatArray]:
    """Return strictly increasing times and as many values at them, two or more."""
    t, v = finite_array("times_ns", times_ns), finite_array(name, values)
    if t.ndim != 1 or t.size < 2 or t.shape != v.shape:
        raise ValueError(f"times_ns of shape {t.shape} and {name} of shape {v.shape} must be equal lists of 2 or more")
    if np.any(np.diff(t) <= 0):
        raise ValueError("times_ns must increase strictly")
    return t, v
