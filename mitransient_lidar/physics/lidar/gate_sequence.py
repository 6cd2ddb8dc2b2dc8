"""Times and places of the pulses of a gated camera: which pulse belongs to which gate of which frame."""

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
    """Pulses of the gates of several frames, by a laser of a constant pulse rate.

    An image is what the camera reads out for one gate of one frame: the sum of `pulses` pulses. In the order
    ``in_order``, all pulses of a gate come before those of the next one; in ``random``, too, with the gates of each
    frame in an order of its own; in ``interleaved``, each pulse belongs to the gate after that of the last pulse, and
    the images of a frame are read out together.
    """

    gates: int = checked(integer, 1, 100_000)  #: Gates of a frame.
    pulses: int = checked(integer, 1, 10**9)  #: Pulses of an image.
    frames: int = checked(integer, 1, 100_000)  #: Frames.
    pulse_rate_hz: float = checked(positive)  #: Pulses a second, greater than 0.
    gate_order: str = "in_order"  #: One of `ORDERS`.
    readout_s: float = checked(least_zero, default=0.0)  #: Time without pulses for each read-out [s].
    speed: float = checked(least_zero, default=0.0)  #: Speed of the platform [m/s].
    heading_deg: float = checked(finite, default=0.0)  #: Its direction, from +y (north) clockwise towards +x.
    seed: int = checked(integer, 0, 2**53, default=0)  #: Seed of random orders.

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
        """Return the times of pulses [s] of an image since the first pulse of all, by their numbers in it."""
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
        """Return the pulse of an image that pass `number` of `passes` renders, from uniform numbers in [0, 1).

        Each pass draws from its own part of the pulses, all parts of equal length, so that the mean over the passes has
        the mean over all pulses as its expected value.
        """
        part = (number + np.asarray(uniform)) / passes * self.pulses
        return np.minimum(part.astype(np.int64), self.pulses - 1)
