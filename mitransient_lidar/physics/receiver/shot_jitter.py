"""Random energy and time of each recorded shot."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass
from typing import Annotated, Any

import numpy as np

from mitransient_lidar.core.options import Option, Plan
from mitransient_lidar.core.validation import FloatArray


@dataclass(frozen=True)
class ShotJitter(Plan):
    """Fluctuation of pulse energy, trigger and clocks from shot to shot.

    Times are normally distributed. A time error sigma is a range error c sigma / (2 n) from the lidar, n the group
    index: 1.1 cm for 0.1 ns in water. It does not change depths between surface and bottom in one channel.
    """

    energy_rms: Annotated[
        float, Option("Standard deviation of the pulse energy over its mean; the energy is gamma-distributed", 0, 1)
    ] = 0.0
    trigger_ns: Annotated[
        float,
        Option("Standard deviation of the record's start against the pulse, the same in all channels", 0, unit="ns"),
    ] = 0.0
    clock_ns: Annotated[
        float, Option("Standard deviation of each channel's sample times against the other channels", 0, unit="ns")
    ] = 0.0

    def draw(
        self, shots: int, records: tuple[int, ...], series: bool, seed: int, common_seed: int
    ) -> tuple[FloatArray, FloatArray]:
        """Draw the shots' energy and time.

        `shots`: shots per record. `records`: shape of the records. `series`: whether the first axis counts different
        shots instead of channels. `seed`, `common_seed`: seeds for a channel's own numbers, and for numbers that all
        channels share.

        Returns `energy`, shape ``(shots, *records)``: energy over its mean. `delay_ns`, shape ``(shots, *records)``:
        delay of the record's light [ns].
        """
        shared = (shots, *(size if series and axis == 0 else 1 for axis, size in enumerate(records)))
        whole = (shots, *records)
        of_energy, of_trigger, of_clock = (
            # Keys with two numbers differ from the noise's keys.
            np.random.default_rng(np.random.SeedSequence(one, spawn_key=(0, kind)))
            for kind, one in enumerate((common_seed, common_seed, seed))
        )
        energy = np.ones(shared)
        if self.energy_rms > 0:
            energy = of_energy.gamma(self.energy_rms**-2, self.energy_rms**2, shared)
        delay = self.trigger_ns * of_trigger.standard_normal(shared) + self.clock_ns * of_clock.standard_normal(whole)
        return np.broadcast_to(energy, whole), np.broadcast_to(delay, whole)


def delayed(power: FloatArray, bins: FloatArray) -> FloatArray:
    """Return means over bins that are delayed by fractions of bins.

    `power`: means over bins, constant within a bin and 0 before and after the record, shape (records, time). `bins`:
    delays in bins, of either sign, shape (shots, records).

    Result, shape (shots, records, time): the integral and the first moment are exact, except for light that leaves the
    record. A delay by the fraction f of a bin widens an echo by a variance of f (1 - f) bins squared.
    """
    whole = np.floor(bins).astype(np.int64)
    later = (bins - whole)[..., np.newaxis]
    time = np.arange(power.shape[-1]) - whole[..., np.newaxis]
    padded = np.pad(power, ((0, 0), (2, 2)))
    rows = np.arange(len(power))[:, np.newaxis]
    # The bins outside of the record are the zeros at its ends.
    first = np.clip(time + 2, 1, padded.shape[-1] - 1)
    return np.asarray((1 - later) * padded[rows, first] + later * padded[rows, first - 1])


def timing_jitter(attributes: Mapping[str, Any]) -> tuple[float, float]:
    """Return the trigger and clock standard deviations [ns] that a record's attributes state, or 0."""
    trigger, clock = (float(attributes.get(f"receiver.jitter.{name}", 0.0)) for name in ("trigger_ns", "clock_ns"))
    return trigger, clock
