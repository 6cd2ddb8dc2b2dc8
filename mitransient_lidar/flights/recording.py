"""Recording rendered pulses: a flight's receiver, whose automatic settings are chosen once for all pulses."""

from __future__ import annotations

from collections.abc import Mapping

import numpy as np
import xarray as xr

from mitransient_lidar.analysis.receiver import detect_waveforms, receiver_of_result, shared_settings
from mitransient_lidar.campaigns.design import Column
from mitransient_lidar.flights.plan import FlightPlan
from mitransient_lidar.physics.receiver.receiver_files import ReceiverChannels

#: Names of the inputs of pulses that hold a setting of a channel, which end in its number.
SETTINGS = {"receiver_gain_": "factor of the gain", "receiver_density_": "optical density of the filter"}


def record(series: xr.Dataset, plan: FlightPlan, inputs: Mapping[str, Column]) -> xr.Dataset:
    """Return the record for pulses rendered together, as from `detect_waveforms`, with the settings in inputs.

    Channels whose settings the inputs do not hold choose them for these pulses alone.
    """
    return detect_waveforms(
        series,
        _receiver(series, plan).with_channel_settings(_stored(inputs)),
        seed=int(np.random.SeedSequence([plan.seed, int(inputs["pulse"][0]), 1]).generate_state(1)[0]),
        background_power=plan.receiver.background_power_w,
        advice=False,
    )


def chosen_settings(pilots: xr.Dataset, plan: FlightPlan) -> dict[str, float]:
    """Return automatic channels' settings for a flight's rendered pilot pulses, as inputs of its pulses."""
    found = shared_settings(pilots, _receiver(pilots, plan), plan.receiver.background_power_w)
    return {f"{name}{number}": one for number, used in found.items() for name, one in zip(SETTINGS, used, strict=True)}


def saturated_pulses(pilots: xr.Dataset, plan: FlightPlan, settings: Mapping[str, float]) -> int:
    """Return how many rendered pulses have saturated samples, with the automatic channels' settings."""
    inputs = {"pulse": np.zeros(1, dtype=np.int64), **{name: np.array([value]) for name, value in settings.items()}}
    saturated = record(pilots, plan, inputs)["saturated"]
    return int(np.count_nonzero(saturated.any([dim for dim in saturated.dims if dim != "shot"])))


def _receiver(series: xr.Dataset, plan: FlightPlan) -> ReceiverChannels:
    """Return a flight's receiver with its settings; some may be automatic."""
    own = plan.receiver
    return receiver_of_result(series, own.chain, own.gain, own.optical_density)


def _stored(inputs: Mapping[str, Column]) -> dict[int, tuple[float, float]]:
    """Return gains and optical densities in the pulses' inputs, by channel number."""
    gain, density = SETTINGS
    numbers = [int(name.removeprefix(gain)) for name in inputs if name.startswith(gain)]
    return {number: (float(inputs[f"{gain}{number}"][0]), float(inputs[f"{density}{number}"][0])) for number in numbers}
