"""Statements about water in two layers: figures 15 and 16."""

from __future__ import annotations

import math

import numpy as np
import xarray as xr

from mitransient_lidar.core.validation import FloatArray
from mitransient_lidar.studies.publication.echoes import RANDOM, far_after_near
from mitransient_lidar.studies.publication.measures import Waveform, change, estimate
from mitransient_lidar.studies.publication.renders import (
    Renders,
    as_series,
    described,
    echo_gate,
    joined,
)
from mitransient_lidar.studies.publication.statements import Statement

FOUR, SINGLE = "fig15_2x2", "fig15_1x1"

#: Depth of the change of the water [m].
LAYER_DEPTH = 3.0


def layer_times(result: xr.Dataset) -> FloatArray:
    """Return when light from the change at 3 m is expected in each pixel [ns]."""
    return np.asarray(result["surface_time"].values + LAYER_DEPTH / result["depth_per_ns"].values)


def duration(one: Waveform, pixel: int, middle: float) -> float:
    """Return the time from the start to the stop of the change [ns]."""
    start, stop = change(one, pixel, middle)
    return stop - start


def delay_statements(renders: Renders) -> list[Statement]:
    """Return the statements about times (figure 15)."""
    four = renders.shot(FOUR)
    others = joined([as_series(one) for one in renders.random(FOUR)])
    gate, middles = echo_gate(four, 0.0), layer_times(four)

    def surface(one: Waveform) -> float:
        return far_after_near(one, gate)

    def layer(one: Waveform) -> float:
        times = np.array([np.mean(change(one, pixel, middle)) for pixel, middle in enumerate(middles)])
        return float(times[:2].mean() - times[2:].mean())

    texts = {
        "the surface echo": (surface, "highest points of the waveforms"),
        "the change at 3 m": (
            layer,
            "middle between start and stop of the change, the extremes of the curvature of the logarithm",
        ),
    }
    return [
        Statement(
            "fig15",
            f"{name} arrives earlier in the near pixels",
            "delay of red and green after blue and black (ns)",
            "> 0",
            *estimate(measure, as_series(four)),
            (0.0, np.inf),
            f"{how}; {described(four)}",
            float(np.mean(others.each(measure) > 0)),
            RANDOM,
        )
        for name, (measure, how) in texts.items()
    ]


def duration_statements(renders: Renders) -> list[Statement]:
    """Return the statements about the duration of the change (figure 16)."""
    four, single = renders.shot(FOUR), renders.shot(SINGLE)
    others = joined([as_series(one) for one in renders.random(FOUR)])
    middles, middle = layer_times(four), float(layer_times(single)[0])

    def pixels(one: Waveform) -> FloatArray:
        return np.array([duration(one, pixel, time) for pixel, time in enumerate(middles)])

    def mean_ratio(one: Waveform) -> float:
        return float(pixels(one).mean() / duration(one.total(), 0, middle))

    how = f"from start to stop, the extremes of the curvature of the logarithm; {described(four)}"
    found = [
        Statement(
            "fig16",
            "2x2 pixels resolve the change at 3 m better than one",
            "duration of the change, mean of the pixels over the single one",
            "< 1",
            *estimate(mean_ratio, as_series(four)),
            (0.0, 1.0),
            f"{how}; the single pixel is the sum of the four",
            float(np.mean(others.each(mean_ratio) < 1)),
            RANDOM,
        )
    ]
    found.append(
        Statement(
            "fig16",
            "the sudden change at 3 m is smeared over a time in the single pixel's waveform",
            "duration of the change in the single pixel (ns)",
            "",
            *estimate(lambda one: duration(one, 0, middle), as_series(single)),
            (_pulse_deviations(single), np.inf),
            "from start to stop; longer than two standard deviations of the pulse, which a small sudden step gives; "
            f"{described(single)}",
        )
    )
    return found


def _pulse_deviations(result: xr.Dataset) -> float:
    """Return two standard deviations of the pulse [ns]."""
    return 2 * float(result.attrs["pulse_fwhm_ns"]) / math.sqrt(8 * math.log(2))
