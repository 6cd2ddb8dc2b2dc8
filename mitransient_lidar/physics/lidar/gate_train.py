"""Gates of a gated receiver: transmission against time, trains with an echo's weight in each gate, and pulse times.

A gated receiver takes one image per gate and shifts the gate by one step from image to image. Gate k collects the
energy int P(t) G_k(t) dt from the received power P of every pulse, where G_k(t) = G_0(t - k step).
"""

from __future__ import annotations

import math
from dataclasses import dataclass, replace
from functools import cached_property
from os import PathLike
from typing import NamedTuple

import numpy as np

from mitransient_lidar.core.constants import C0
from mitransient_lidar.core.errors import UserError
from mitransient_lidar.core.tables.headings import UNITLESS, Column
from mitransient_lidar.core.tables.text_tables import read_time_samples
from mitransient_lidar.core.validation import (
    ArrayLike,
    Checked,
    FloatArray,
    IntArray,
    checked,
    finite,
    in_range,
    integer,
    non_negative,
    positive,
    time_samples,
)
from mitransient_lidar.core.validation import non_negative as least_zero
from mitransient_lidar.physics.lidar.pulse import FWHM_PER_SIGMA, Pulse
from mitransient_lidar.physics.lidar.time_axis import TimeAxis
from mitransient_lidar.physics.piecewise_linear import first_crossing, integral

_POINTS, _MOST_POINTS = 128, 2**17  #: Points in a weight table per shortest time scale, and largest number of points.

#: Full length of a raised-cosine edge over its 10-90 % time: sin^2 passes 0.1 and 0.9 at 0.2048 and 0.7952 of it.
_EDGE_PER_RISE = float(np.pi / (np.pi - 2 * np.arccos(0.8)))

_CELLS_OF_BIN = 33  #: Cells per bin that give the error of cut gates.

#: Samples per standard deviation in a jittered edge, and standard deviations on each side.
_JITTER_POINTS, _JITTER_REACH = 32, 6.0

_ROUNDING = 1e-9  #: Relative tolerance for half edges against the width, for rounded decimals.

_TRANSMISSION = Column("transmission", ("transmittance", "gate", "gain", "value"), UNITLESS)


@dataclass(frozen=True, eq=False)
class GateShape:
    """Transmission of a gate whose rising edge is half open at t = 0.

    Build one with `edges`, `sampled` or `from_file`.

    An edge with full length L is sin^2(pi u / (2 L)) for 0 <= u <= L, half open in its middle. It is smooth and finite,
    with an integral in closed form, R(t) = (u - L/pi sin(pi u/L)) / 2 for u = t + L/2. A gate is the difference between
    two such edges, its integral the difference between theirs. Edges of 0 ns are sharp; the gate is then half open as
    bins are, [0, width).
    """

    width_ns: float  #: Time between the half heights of the two edges [ns].
    #: Rising edge time from 10 to 90 %, and falling edge time from 90 to 10 % [ns].
    rise_ns: float
    fall_ns: float
    #: Samples of a measured gate, linear between them and 0 outside; empty for a gate with raised-cosine edges, shape
    #: (S,).
    times_ns: FloatArray
    values: FloatArray
    jitter_ns: float = 0.0  #: Standard deviation of the gate's opening [ns], which the samples include.

    @classmethod
    def edges(cls, width_ns: float, rise_ns: float = 0.0, fall_ns: float = 0.0) -> GateShape:
        """Gate with raised-cosine edges.

        `width_ns`: time between half heights [ns], greater than 0. `rise_ns`, `fall_ns`: 10-90 % times of the edges
        [ns], at least 0; the gate must reach 1 between them: rise_ns + fall_ns at most 1.18 width_ns.
        """
        longest = 2 * width_ns / _EDGE_PER_RISE
        if rise_ns + fall_ns > longest * (1 + _ROUNDING):
            raise UserError(
                f"rise_ns = {rise_ns:g} and fall_ns = {fall_ns:g} must add up to at most {longest:g} ns for a gate of "
                f"width_ns = {width_ns:g} to open fully"
            )
        return cls(width_ns, rise_ns, fall_ns, np.zeros(0), np.zeros(0))

    @classmethod
    def sampled(cls, times_ns: ArrayLike, transmission: ArrayLike) -> GateShape:
        """Measured gate; its width and edge times follow from the samples.

        `times_ns`: strictly increasing times [ns], at least 2, shape (S,). They are shifted so that the transmission
        first reaches half its maximum at 0. `transmission`: transmission, 0 to 1, not all 0, shape (S,).
        """
        t, g = time_samples(times_ns, "transmission", transmission)
        for extreme in (g.min(), g.max()):
            in_range("transmission", extreme, 0, 1)
        if g.max() == 0:
            raise UserError("transmission must be greater than 0 somewhere")
        half = g.max() / 2
        opens, closes = first_crossing(t, g, half), -first_crossing(-t[::-1], g[::-1], half)
        if closes <= opens:
            raise UserError("transmission must stay above half its maximum for some time")
        rise = first_crossing(t, g, 1.8 * half) - first_crossing(t, g, 0.2 * half)
        fall = first_crossing(-t[::-1], g[::-1], 1.8 * half) - first_crossing(-t[::-1], g[::-1], 0.2 * half)
        return cls(float(closes - opens), float(rise), float(fall), t - opens, g)

    @classmethod
    def from_file(cls, path: str | PathLike[str]) -> GateShape:
        """Read a measured gate, times and transmissions as for `sampled`, from a text file.

        Columns as in `core.tables.text_tables.read_time_samples`; a transmission may be in %.
        """
        return cls.sampled(*read_time_samples(path, _TRANSMISSION))

    def jittered(self, jitter_ns: float) -> GateShape:
        """Return the mean gate for pulses at which the gate opens early or late, the shape over a Gaussian.

        Its width and edges remain those for one pulse, and its time 0 is the mean opening time.

        `jitter_ns`: standard deviation of the opening time [ns], at least 0.
        """
        if non_negative("jitter_ns", jitter_ns) == 0:
            return self
        from scipy.ndimage import gaussian_filter1d

        opens, closes = self.span_ns
        reach = _JITTER_REACH * jitter_ns
        step = max(jitter_ns / _JITTER_POINTS, (closes - opens + 2 * reach) / _MOST_POINTS)
        t = np.arange(opens - reach - step, closes + reach + 2 * step, step)
        cells = np.diff(self.open_time(np.append(t, t[-1] + step) - 0.5 * step)) / step
        values = np.clip(gaussian_filter1d(cells, jitter_ns / step, truncate=_JITTER_REACH, mode="constant"), 0, 1)
        bent = np.abs(np.diff(values, 2, prepend=1, append=1)) > 1e-9
        return replace(self, times_ns=t[bent], values=values[bent], jitter_ns=jitter_ns)

    @property
    def span_ns(self) -> tuple[float, float]:
        """First and last time at which the transmission is above 0 [ns]."""
        if self.times_ns.size:
            return float(self.times_ns[0]), float(self.times_ns[-1])
        return -0.5 * _EDGE_PER_RISE * self.rise_ns, self.width_ns + 0.5 * _EDGE_PER_RISE * self.fall_ns

    def open_time(self, t_ns: ArrayLike) -> FloatArray:
        """Integrated transmission [ns] up to the times `t_ns` [ns] after the rising edge's half height."""
        t = np.asarray(t_ns, dtype=np.float64)
        if self.times_ns.size:
            return integral(self.times_ns, self.values, t)
        return np.asarray(_edge_integral(t, self.rise_ns) - _edge_integral(t - self.width_ns, self.fall_ns))


def _edge_integral(t: FloatArray, rise: float) -> FloatArray:
    """Integral of an edge from 0 to 1, half open at t = 0, up to t."""
    length = _EDGE_PER_RISE * rise
    if length == 0:
        return np.maximum(t, 0)
    u = np.clip(t / length + 0.5, 0, 1)
    return np.asarray(0.5 * length * (u - np.sin(np.pi * u) / np.pi) + np.maximum(t - 0.5 * length, 0))


class ResponseTable(NamedTuple):
    """Weight of an ideal echo in the first gate against its arrival time."""

    start_ns: float  #: Arrival time of the first value [ns].
    step_ns: float  #: Time between values [ns].
    values: FloatArray  #: Weights, shape (N,), 0 to 1, linear between them; 0 at both ends.


@dataclass(frozen=True)
class GateTrain(Checked):
    """Gates with one shape at equal time steps.

    Times count from the moment when the pulse peak leaves the transmitter. `measured` builds a train from a measured
    gate.
    """

    start_ns: float = checked(finite)  #: Half-height time of the first gate's rising edge [ns].
    width_ns: float = checked(positive)  #: Time between the half heights of a gate's edges [ns], greater than 0.
    #: Time from gate to gate [ns], greater than 0: gates overlap when it is below their width.
    step_ns: float = checked(positive)
    count: int = checked(integer, 1, 100_000)  #: Number of gates, 1 to 100 000.
    #: 10-90 % times of the raised-cosine edges [ns], at least 0 and together at most 1.18 width_ns; 0 is sharp.
    rise_ns: float = checked(non_negative, default=0.0)
    fall_ns: float = checked(non_negative, default=0.0)
    pulses: int = checked(integer, 1, 10**9, default=1)  #: Pulses that each gate accumulates, 1 to 10^9.
    #: Measured gate instead of raised-cosine edges; `width_ns`, `rise_ns` and `fall_ns` must equal its own values.
    profile: GateShape | None = None

    def __post_init__(self) -> None:
        super().__post_init__()
        shape = self.shape
        if (self.width_ns, self.rise_ns, self.fall_ns) != (shape.width_ns, shape.rise_ns, shape.fall_ns):
            raise UserError(
                f"width_ns = {self.width_ns:g}, rise_ns = {self.rise_ns:g} and fall_ns = {self.fall_ns:g} must be "
                f"those of the profile, {shape.width_ns:g}, {shape.rise_ns:g} and {shape.fall_ns:g}"
            )

    @classmethod
    def measured(cls, profile: GateShape, start_ns: float, step_ns: float, count: int, pulses: int = 1) -> GateTrain:
        """Gate train with a shape, such as `GateShape.from_file`; other parameters as in the class."""
        width, rise, fall = profile.width_ns, profile.rise_ns, profile.fall_ns
        return cls(start_ns, width, step_ns, count, rise, fall, pulses, profile if profile.times_ns.size else None)

    @cached_property
    def shape(self) -> GateShape:
        """Shape of the first gate, half open at t = 0."""
        return self.profile or GateShape.edges(self.width_ns, self.rise_ns, self.fall_ns)

    @property
    def starts_ns(self) -> FloatArray:
        """Half-height times of the rising edges [ns], shape (count,)."""
        return np.asarray(self.start_ns + self.step_ns * np.arange(self.count))

    @property
    def middles_ns(self) -> FloatArray:
        """Midpoints between the half heights of the gates [ns], shape (count,)."""
        return np.asarray(self.starts_ns + 0.5 * self.width_ns)

    @property
    def spans_ns(self) -> FloatArray:
        """First and last time at which the transmission of each gate is above 0 [ns], shape (count, 2)."""
        return np.asarray(self.starts_ns[:, None] + np.array(self.shape.span_ns))

    def gate_bins(self, gate: int, time_start_ns: float, bin_width_ns: float, bin_count: int) -> tuple[int, FloatArray]:
        """Mean gate transmission in the time bins that the gate overlaps.

        `gate`: gate index, 0 to count - 1. `time_start_ns`, `bin_width_ns`: start of the first bin, and bin width [ns].
        `bin_count`: number of bins, 1 to 10^9.

        Returns `first`: first bin that the gate overlaps. `weights`, shape (M,): exact means of the transmission over
        bins first to first + M - 1; M is 0 for a gate outside the axis.
        """
        start, width = finite("time_start_ns", time_start_ns), positive("bin_width_ns", bin_width_ns)
        bins = integer("bin_count", bin_count, 1, 10**9)
        opens = self.start_ns + self.step_ns * integer("gate", gate, 0, self.count - 1)
        first, last = (opens + np.array(self.shape.span_ns) - start) / width
        low, high = int(np.clip(np.floor(first), 0, bins)), int(np.clip(np.ceil(last), 0, bins))
        edges = start - opens + width * np.arange(low, max(low, high) + 1)
        return low, np.asarray(np.clip(np.diff(self.shape.open_time(edges)) / width, 0, 1))

    def response_weights(self, pulse: Pulse, response_time_ns: float = 0.0) -> ResponseTable:
        """Return an ideal echo's weight in the first gate against its arrival time.

        Pulse and receiver response spread an echo at t with the unit-area kernel h(tau). The first gate transmits W(t)
        = int h(tau) G_0(t + tau) dtau of it, and gate k transmits W(t - k step_ns), for one pulse. Values are 1/128 of
        the shortest of pulse, edges and width apart, with which linear interpolation is accurate to 1e-5. They are
        farther apart where there would be more than 2^17.

        `pulse`: transmitted pulse. `response_time_ns`: time constant of the receiver's single-pole response [ns], at
        least 0.
        """
        opens, closes = self.shape.span_ns
        gaussian = pulse.shape == "gaussian"
        pulse_length = 14 * pulse.fwhm_ns / FWHM_PER_SIGMA if gaussian else float(np.ptp(pulse.times_ns))
        longest = closes - opens + pulse_length + 30 * non_negative("response_time_ns", response_time_ns)
        # Features of a sampled pulse may be shorter than its width.
        shortest = pulse.fwhm_ns if gaussian else float(np.diff(pulse.times_ns).min())
        times = (shortest, self.width_ns, self.rise_ns or shortest, self.fall_ns or shortest)
        step = max(min(times) / _POINTS, longest / _MOST_POINTS)
        lag, kernel = pulse.kernel(step, response_time_ns)
        cells = int(np.ceil((closes - opens) / step)) + 3
        # Mean transmission over one-step cells, with one cell of margin at each end.
        edges = opens + step * (np.arange(cells + 1) - 1.5)
        gate = np.diff(self.shape.open_time(edges)) / step
        values = np.clip(_convolved(gate, kernel[::-1]), 0, 1)
        values[0] = values[-1] = 0
        start = self.start_ns + opens - step - step * (lag + kernel.size - 1)
        return ResponseTable(start, step, values)

    def bin_weights(self, pulse: Pulse, response_time_ns: float, axis: TimeAxis) -> FloatArray:
        """Return each gate's weight for light that arrives in each bin, all pulses together, shape (bin, gate).

        Light is spread evenly over its bin; pulse and response time [ns] are as for `response_weights`.
        """
        table = self.response_weights(pulse, response_time_ns)
        times = table.start_ns + table.step_ns * np.arange(table.values.size)
        integral = np.concatenate([[0.0], np.cumsum(0.5 * (table.values[1:] + table.values[:-1]) * table.step_ns)])
        shifts = self.step_ns * np.arange(self.count)
        within = np.interp(axis.edges_ns[:, None] - shifts, times, integral)
        return np.asarray(np.diff(within, axis=0) * (self.pulses / axis.bin_width_ns))

    def cutting_error(self, pulse: Pulse, response_time_ns: float, bin_width_ns: float) -> float:
        """Return the largest error of an echo's energy in a gate that is cut from a waveform, over the largest energy.

        A waveform moves echoes to the centres of their bins, and averages over bins, as `gate_bins` does. Echo and gate
        may lie at any time in their bins; pulse and response time [ns] are as for `response_weights`.
        """
        size, (opens, closes) = _CELLS_OF_BIN, self.shape.span_ns
        cell = bin_width_ns / size
        lag, kernel = pulse.kernel(cell, response_time_ns)
        worst = largest = 0.0
        for phase in range(0, size, size // 8):
            cells = size * (int((closes - opens) / bin_width_ns) + 3)
            gate = np.diff(self.shape.open_time(opens + cell * (np.arange(cells + 1) - phase - 1))) / cell
            in_bins = np.repeat(gate.reshape(-1, size).mean(axis=1), size)
            exact, cut = (_convolved(each, kernel[::-1]) for each in (gate, in_bins))
            arrival = np.arange(exact.size) - (kernel.size - 1) - lag
            centre = np.clip(arrival // size * size + size // 2 - arrival[0], 0, exact.size - 1)
            worst = max(worst, float(np.abs(cut[centre] - exact).max()))
            largest = max(largest, float(exact.max()))
        return worst / largest


def _convolved(values: FloatArray, kernel: FloatArray) -> FloatArray:
    """Return the full convolution, as `scipy.signal.fftconvolve`, which takes a second to import."""
    from scipy.fft import irfft, next_fast_len, rfft

    size = values.size + kernel.size - 1
    length = next_fast_len(size, real=True)
    return np.asarray(irfft(rfft(values, length) * rfft(kernel, length), length)[:size])


def range_time_ns(slant_range: float, to_sea: float, group_index: float) -> float:
    """Return when an echo arrives from a range on the axis [m]: in air up to the sea [m], with its index beyond."""
    in_air = min(slant_range, to_sea)
    return 2e9 / C0 * (in_air + group_index * (slant_range - in_air))


@dataclass(frozen=True)
class GatePlan:
    """Gates of a scene: a train whose start is replaced by one given in time, in depth or in range."""

    train: GateTrain
    given: str  #: Name of the film parameter: ``gate_start_ns``, ``gate_start_depth`` or ``gate_start_range``.
    #: Its value: half-height time of the first gate's rising edge [ns]; or the depth below the mean sea level, or range
    #: from the lidar [m], from which echoes on the receiver's axis arrive then.
    start: float


ORDERS = ("in_order", "interleaved", "random")  #: Orders in which a camera takes the gates of a frame.


@dataclass(frozen=True)
class GateSequence(Checked):
    """Pulses of several frames' gates, from a laser with a constant pulse rate.

    An image is the camera's read-out for one gate in one frame: the sum of `pulses` pulses. The order ``in_order`` puts
    all pulses of a gate before the next gate's pulses. The order ``random`` does the same, with each frame's gates in
    an order of their own. In ``interleaved``, successive pulses belong to successive gates, and a frame's images are
    read out together.
    """

    gates: int = checked(integer, 1, 100_000)  #: Gates per frame.
    pulses: int = checked(integer, 1, 10**9)  #: Pulses per image.
    frames: int = checked(integer, 1, 100_000)  #: Frames.
    pulse_rate_hz: float = checked(positive)  #: Pulses a second, greater than 0.
    gate_order: str = "in_order"  #: An entry of `ORDERS`.
    readout_s: float = checked(least_zero, default=0.0)  #: Time without pulses for each read-out [s].
    speed: float = checked(least_zero, default=0.0)  #: Platform speed [m/s].
    heading_deg: float = checked(finite, default=0.0)  #: Its direction, from +y (north) clockwise towards +x.
    seed: int = checked(integer, 0, 2**53, default=0)  #: Random seed for orders.

    def __post_init__(self) -> None:
        super().__post_init__()
        if self.gate_order not in ORDERS:
            raise UserError(f"gate_order = {self.gate_order!r} must be one of {', '.join(ORDERS)}")

    @cached_property
    def places(self) -> IntArray:
        """Place of each gate in its frame, shape (frame, gate)."""
        shape = self.frames, self.gates
        in_order = np.broadcast_to(np.arange(self.gates), shape)
        return np.random.default_rng(self.seed).permuted(in_order, axis=1) if self.gate_order == "random" else in_order

    def times(self, frame: IntArray, gate: IntArray, pulse: IntArray | int = 0) -> FloatArray:
        """Return the times [s] of an image's pulses since the first pulse of all, given their numbers in the image."""
        readouts = frame * self.gates + self.places[frame, gate]
        number = readouts * self.pulses + pulse
        if self.gate_order == "interleaved":
            readouts, number = frame, (frame * self.pulses + pulse) * self.gates + gate
        return np.asarray(number / self.pulse_rate_hz + readouts * self.readout_s)

    def displacements(self, times_s: FloatArray) -> FloatArray:
        """Return how far the platform has come at times [s], along x and y [m], shape (..., 2)."""
        heading = math.radians(self.heading_deg)
        direction = np.array([math.sin(heading), math.cos(heading)])
        return np.asarray(self.speed * np.asarray(times_s)[..., None] * direction)

    def sampled_pulse(self, number: int, passes: int, uniform: FloatArray) -> IntArray:
        """Return the image pulse that pass `number` of `passes` renders, from uniform numbers in [0, 1).

        Each pass draws from its own part of the pulses. All parts are equally long: the expected mean over passes is
        the mean over all pulses.
        """
        part = (number + np.asarray(uniform)) / passes * self.pulses
        return np.minimum(part.astype(np.int64), self.pulses - 1)
