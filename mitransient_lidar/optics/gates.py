"""Trains of gates: when a gated receiver is open, and how much of an echo each gate collects.

A gated receiver takes one image a gate, and moves the gate from image to image. Gate k is open as the first gate was,
k steps later. It collects the energy int P(t) G_k(t) dt of the received power P, from every pulse that it is open for.
"""

from __future__ import annotations

from dataclasses import dataclass, field
from typing import NamedTuple

import numpy as np
import numpy.typing as npt

from .checks import FloatArray, finite, finite_array, in_range, non_negative, positive, whole
from .gate_images import Contrast, RangeImage, contrast, range_from_gates
from .gate_shape import GateShape
from .pulse import FWHM_PER_SIGMA, Pulse
from .water import C0

__all__ = [
    "Contrast",
    "GateShape",
    "GateTrain",
    "RangeImage",
    "ResponseTable",
    "contrast",
    "depth_of_time",
    "range_from_gates",
    "time_of_depth",
]

#: Points of a table of weights within the shortest time that shapes it, and most points in all.
_POINTS, _LONGEST_TABLE = 128, 2**18

_MOST_BINS = 10**9

#: Gates that touch within this part of a step do not overlap.
_ROUNDING = 1e-9


class ResponseTable(NamedTuple):
    """Weight with which an ideal echo counts in the first gate, against the time of its arrival.

    Attributes
    ----------
    start_ns, step_ns : float
        Arrival time of the first value and time between values [ns].
    values : ndarray, shape (N,)
        Weights, 0 to 1; 0 at both ends.
    """

    start_ns: float
    step_ns: float
    values: FloatArray

    @property
    def end_ns(self) -> float:
        """Arrival time of the last value [ns]."""
        return self.start_ns + (self.values.size - 1) * self.step_ns

    def at(self, time_ns: npt.ArrayLike) -> FloatArray:
        """Weights at arrival times [ns], linear between the values and 0 outside."""
        times = self.start_ns + self.step_ns * np.arange(self.values.size)
        return np.asarray(np.interp(np.asarray(time_ns, dtype=np.float64), times, self.values, left=0.0, right=0.0))


@dataclass(frozen=True)
class GateTrain:
    """Gates of one shape, each a step later than the one before.

    Times count from when the pulse's peak leaves the transmitter. Build a train of a measured gate with `measured`,
    and one that starts at a depth with `from_depth`.

    Parameters
    ----------
    start_ns : float
        Half height of the first gate's rising edge [ns].
    width_ns : float
        Time between the half heights of a gate's edges [ns], greater than 0.
    step_ns : float
        Time from gate to gate [ns], greater than 0: gates overlap when it is below their width.
    count : int
        Number of gates, 1 to 100 000.
    rise_ns, fall_ns : float
        10-90 % times of the raised-cosine edges [ns], at least 0 and together at most 1.18 width_ns; 0 is sharp.
    pulses : int
        Pulses that a gate adds up, 1 to 10^9.
    profile : GateShape, optional
        Measured gate instead of raised-cosine edges; `width_ns`, `rise_ns` and `fall_ns` must be its own.

    Raises
    ------
    ValueError
        If a value is out of range.
    """

    start_ns: float
    width_ns: float
    step_ns: float
    count: int
    rise_ns: float = 0.0
    fall_ns: float = 0.0
    pulses: int = 1
    profile: GateShape | None = None
    shape: GateShape = field(init=False, repr=False, compare=False)

    def __post_init__(self) -> None:
        shape = self.profile
        if shape is None:
            shape = GateShape.edges(self.width_ns, self.rise_ns, self.fall_ns)
        elif (self.width_ns, self.rise_ns, self.fall_ns) != (shape.width_ns, shape.rise_ns, shape.fall_ns):
            raise ValueError(
                f"width_ns = {self.width_ns:g}, rise_ns = {self.rise_ns:g} and fall_ns = {self.fall_ns:g} must be "
                f"those of the profile, {shape.width_ns:g}, {shape.rise_ns:g} and {shape.fall_ns:g}"
            )
        checked = {
            "start_ns": finite("start_ns", self.start_ns),
            "width_ns": shape.width_ns,
            "step_ns": positive("step_ns", self.step_ns),
            "count": whole("count", self.count, 1, 100_000),
            "rise_ns": shape.rise_ns,
            "fall_ns": shape.fall_ns,
            "pulses": whole("pulses", self.pulses, 1, 10**9),
            "shape": shape,
        }
        for name, value in checked.items():
            object.__setattr__(self, name, value)

    @classmethod
    def measured(cls, profile: GateShape, start_ns: float, step_ns: float, count: int, pulses: int = 1) -> GateTrain:
        """Train of a measured gate (`GateShape.sampled` or `GateShape.from_file`)."""
        width, rise, fall = profile.width_ns, profile.rise_ns, profile.fall_ns
        return cls(start_ns, width, step_ns, count, rise, fall, pulses, profile)

    @classmethod
    def from_depth(
        cls,
        start_depth_m: float,
        *,
        surface_time_ns: float,
        group_index: float,
        cos_water: float,
        width_ns: float,
        step_ns: float,
        count: int,
        rise_ns: float = 0.0,
        fall_ns: float = 0.0,
        pulses: int = 1,
        profile: GateShape | None = None,
    ) -> GateTrain:
        """Train whose first gate starts at a depth [m] on the depth axis.

        The depth may be negative: above the surface. `surface_time_ns`, `group_index` and `cos_water` are as in
        `time_of_depth`, the rest as in the class.
        """
        depth = finite("start_depth_m", start_depth_m)
        start = float(time_of_depth(depth, surface_time_ns, group_index, cos_water))
        return cls(start, width_ns, step_ns, count, rise_ns, fall_ns, pulses, profile)

    @property
    def starts_ns(self) -> FloatArray:
        """Half heights of the rising edges [ns], shape (count,)."""
        return np.asarray(self.start_ns + self.step_ns * np.arange(self.count))

    @property
    def middles_ns(self) -> FloatArray:
        """Middles of the gates [ns], between their half heights, shape (count,)."""
        return np.asarray(self.starts_ns + 0.5 * self.width_ns)

    @property
    def spans_ns(self) -> FloatArray:
        """First and last time at which each gate lets light through [ns], shape (count, 2)."""
        return np.asarray(self.starts_ns[:, None] + np.array(self.shape.span_ns))

    def number_of_overlaps(self) -> int:
        """Return the largest number of gates that let light through at one time: 1 when no two gates overlap."""
        first, last = self.shape.span_ns
        return min(self.count, max(1, int(np.ceil((last - first) / self.step_ns - _ROUNDING))))

    def transmission(self, time_ns: npt.ArrayLike, gate: int | None = None) -> FloatArray:
        """Transmission of one gate, or of all.

        Parameters
        ----------
        time_ns : array_like
            Times [ns].
        gate : int, optional
            Number of the gate, 0 to count - 1; all gates by default.

        Returns
        -------
        ndarray
            0 to 1, in the shape of `time_ns`; for all gates with one more axis, (..., gate).

        Raises
        ------
        ValueError
            If there is no such gate.
        """
        t = np.asarray(time_ns, dtype=np.float64)
        if gate is None:
            return self.shape.transmission(t[..., None] - self.starts_ns)
        return self.shape.transmission(t - self.start_ns - self.step_ns * whole("gate", gate, 0, self.count - 1))

    def gate_bins(self, gate: int, time_start_ns: float, bin_width_ns: float, bin_count: int) -> tuple[int, FloatArray]:
        """Mean transmission of a gate in the bins of a record that it touches.

        Parameters
        ----------
        gate : int
            Number of the gate, 0 to count - 1.
        time_start_ns, bin_width_ns : float
            Start of the first bin and width of the bins [ns].
        bin_count : int
            Number of bins, 1 to 10^9.

        Returns
        -------
        first : int
            First bin that the gate touches.
        weights : ndarray, shape (M,)
            Exact means of the transmission over bins first to first + M - 1; M is 0 outside the record.

        Raises
        ------
        ValueError
            If an argument is out of range.
        """
        start, width = finite("time_start_ns", time_start_ns), positive("bin_width_ns", bin_width_ns)
        bins = whole("bin_count", bin_count, 1, _MOST_BINS)
        opens = self.start_ns + self.step_ns * whole("gate", gate, 0, self.count - 1)
        first, last = (opens + np.array(self.shape.span_ns) - start) / width
        low, high = int(np.clip(np.floor(first), 0, bins)), int(np.clip(np.ceil(last), 0, bins))
        edges = start - opens + width * np.arange(low, max(low, high) + 1)
        return low, np.asarray(np.clip(np.diff(self.shape.open_time(edges)) / width, 0, 1))

    def bin_weights(self, time_start_ns: float, bin_width_ns: float, bin_count: int) -> FloatArray:
        """Mean transmission of every gate in every bin of a record, shape (bin, gate); as `gate_bins`."""
        weights = np.zeros((whole("bin_count", bin_count, 1, _MOST_BINS), self.count))
        for gate in range(self.count):
            first, column = self.gate_bins(gate, time_start_ns, bin_width_ns, bin_count)
            weights[first : first + column.size, gate] = column
        return weights

    def response_weights(
        self, pulse: Pulse, response_time_ns: float = 0.0, step_ns: float | None = None
    ) -> ResponseTable:
        """Weight with which light that arrives at a time, before pulse and response, counts in the first gate.

        An ideal echo at t is spread by the pulse and the receiver's response, of together unit area h(tau). What the
        gate lets through of it is W(t) = int h(tau) G_0(t + tau) dtau; in gate k it is W(t - k step_ns). `pulses` does
        not count in it.

        Parameters
        ----------
        pulse : Pulse
            Transmitted pulse.
        response_time_ns : float
            Time constant of the receiver's single-pole response [ns], at least 0.
        step_ns : float, optional
            Time between the values of the table [ns], greater than 0. By default 1/128 of the shortest of pulse, edges
            and width: linear interpolation is then right to 1e-5.

        Returns
        -------
        ResponseTable

        Raises
        ------
        ValueError
            If a time is out of range, or the step would need more than 2^18 values.
        """
        from scipy.signal import fftconvolve

        opens, closes = self.shape.span_ns
        gaussian = pulse.shape == "gaussian"
        pulse_length = 14 * pulse.fwhm_ns / FWHM_PER_SIGMA if gaussian else float(np.ptp(pulse.times_ns))
        longest = closes - opens + pulse_length + 30 * non_negative("response_time_ns", response_time_ns)
        if step_ns is None:
            # A sampled pulse may have features shorter than its width.
            shortest = pulse.fwhm_ns if gaussian else float(np.diff(pulse.times_ns).min())
            times = (shortest, self.width_ns, self.rise_ns or shortest, self.fall_ns or shortest)
            step = max(min(times) / _POINTS, 2 * longest / _LONGEST_TABLE)
        else:
            step = positive("step_ns", step_ns)
        if longest / step > _LONGEST_TABLE:
            raise ValueError(
                f"step_ns = {step:g} needs {longest / step:.0f} values and must not need more than {_LONGEST_TABLE}"
            )
        lag, kernel = pulse.kernel(step, response_time_ns)
        cells = int(np.ceil((closes - opens) / step)) + 3
        # The gate's mean over cells of one step, from a cell before it opens to one after it has closed.
        edges = opens + step * (np.arange(cells + 1) - 1.5)
        gate = np.diff(self.shape.open_time(edges)) / step
        values = np.clip(fftconvolve(gate, kernel[::-1]), 0, 1)
        values[0] = values[-1] = 0
        start = self.start_ns + opens - step - step * (lag + kernel.size - 1)
        return ResponseTable(start, step, values)


def time_of_depth(depth_m: npt.ArrayLike, surface_time_ns: float, group_index: float, cos_water: float) -> FloatArray:
    """Time of an echo on the depth axis.

    Parameters
    ----------
    depth_m : array_like
        Depth below the surface [m]; negative above it, where the axis is that of the water continued.
    surface_time_ns : float
        Time of the surface echo [ns].
    group_index : float
        Group index of the water, 1 to 2.
    cos_water : float
        Cosine of the receiver axis' angle from the vertical in the water, greater than 0 and at most 1.

    Returns
    -------
    ndarray
        Time [ns], surface_time + 2 n_g depth / (c0 cos_water).

    Raises
    ------
    ValueError
        If an argument is out of range.
    """
    delay = finite_array("depth_m", depth_m) / _speed(group_index, cos_water)
    return np.asarray(finite("surface_time_ns", surface_time_ns) + delay)


def depth_of_time(time_ns: npt.ArrayLike, surface_time_ns: float, group_index: float, cos_water: float) -> FloatArray:
    """Depth [m] on the depth axis at which an echo at `time_ns` [ns] lies; the inverse of `time_of_depth`."""
    delay = finite_array("time_ns", time_ns) - finite("surface_time_ns", surface_time_ns)
    return np.asarray(delay * _speed(group_index, cos_water))


def _speed(group_index: float, cos_water: float) -> float:
    """Depth that an echo gains in a nanosecond [m]."""
    cosine = in_range("cos_water", positive("cos_water", cos_water), 0, 1)
    return 0.5e-9 * C0 / in_range("group_index", group_index, 1, 2) * cosine
