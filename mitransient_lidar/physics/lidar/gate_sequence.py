"""Times and locations of a gated camera's pulses: which pulse belongs to which gate in which frame."""

from __future__ import annotations

import math
from dataclasses import dataclass
from functools import cached_property

import numpy as np

from mitransient_lidar.core.errors import UserError
from mitransient_lidar.core.validation import Checked, FloatArray, IntArray, checked, finite, integer, positive
from mitransient_lidar.core.validation import non_negative as least_zero

#: Orders in which a camera takes the gates of a frame.
ORDERS = ("in_order", "interleaved", "random")


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
