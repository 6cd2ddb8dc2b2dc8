"""Quantities for each figure's statements, by their names in the table `statements.csv`."""

from __future__ import annotations

import functools
import math
from collections.abc import Callable, Sequence
from typing import Any

import numpy as np
import xarray as xr

from mitransient_lidar.core.validation import FloatArray
from mitransient_lidar.studies.publication import scenes, statements
from mitransient_lidar.studies.publication.scenes import PLACES_OF_SLOPE, SEAS, Renders, as_series
from mitransient_lidar.studies.publication.statements import Measured, Series, Waveform
from mitransient_lidar.studies.shots import depth_bias
from mitransient_lidar.transport.sensor.outlines import enclosed_area

#: Quantities by their names.
Quantities = dict[str, Measured]

_COLUMN = (2.0, 6.5)  #: Depths between which the decay of the backscatter is fitted, and backscatter is compared [m].

_LEAST_FIELD_OF_VIEW = 0.010  #: Least field of view in the publication's table 1 [rad].

#: Other locations with the slopes of two shots.
_COMBINATIONS = f"combinations of {PLACES_OF_SLOPE * len(SEAS)} places of each slope on {len(SEAS)} seas"

#: Reason for differences between single locations on waves.
_FACETS = "at places of the same mean slope, a few facets make the echo, so that places differ"


def _measured(measure: Callable[..., float], result: xr.Dataset, others: Series | None = None, **more: Any) -> Measured:
    """Return a measure of a result's waveforms, and of each of others, for texts with further words."""
    elsewhere = None if others is None else others.each(measure)
    words = {"shot": scenes.described(result), "random": scenes.RANDOM, **more}
    return Measured(*statements.estimate(measure, as_series(result)), elsewhere, words)


def _column(result: xr.Dataset) -> tuple[float, float]:
    """Return the times of the column's depths [ns]."""
    start, end = (float(scenes.geometry_of(result).time_of_depth(depth)) for depth in _COLUMN)
    return start, end


def backscatter(renders: Renders) -> Quantities:
    """Return the backscatter decay (figure 1b)."""
    result, others = renders.shot(scenes.SINGLE), renders.random(scenes.FOUR)
    gate, per_metre = _column(result), 2 * scenes.geometry_of(result).metres_per_ns
    absorption = float(result.attrs["scene.attenuation"]) - float(result.attrs["scene.scattering"])
    return {
        "residual": _measured(lambda one: statements.decay(one, gate)[1], result, others),
        "absorption": _measured(
            lambda one: absorption * per_metre / statements.decay(one, gate)[0], result, others, absorption=absorption
        ),
    }


def sphere(renders: Renders) -> Quantities:
    """Return the depth of the sphere at 9 m (figure 2)."""
    result = renders.shot(scenes.MINE)
    gate, geometry = scenes.echo_gate(result, 9.0), scenes.geometry_of(result)
    return {"sphere": _measured(lambda one: float(geometry.depth_of_time(one.highest(gate, "target")[1][0])), result)}


def mast(renders: Renders) -> Quantities:
    """Return the light of the target below a mast (figure 4)."""
    result = renders.shot(scenes.MAST)
    start, end = (float(scenes.geometry_of(result).time_of_depth(depth)) for depth in (0.5, 1.5))

    def echo_share(one: Waveform) -> float:
        total = one.total()
        inside = (one.time >= start) & (one.time <= end)
        return float(total.parts["target"][0, inside].sum() / total.power[0, inside].sum())

    return {"mast": _measured(echo_share, result)}


def system(_renders: Renders) -> Quantities:
    """Return the system's angle, footprint and view, from its scene parameters (figure 5)."""
    one = scenes.System.of(scenes.FOUR)
    ranges = {"nearest": 1 / one.divergence, "furthest": 2 / one.divergence}
    return {
        "angle": Measured(math.degrees(one.angle_in_water)),
        "footprint": Measured(one.slant_range * one.divergence, words=ranges),
        "view": Measured(_LEAST_FIELD_OF_VIEW * one.slant_range),
    }


def pixel_shapes(renders: Renders) -> Quantities:
    """Return the solid angles of outer and inner strips (figure 8)."""
    outlines = scenes.outlines(renders, scenes.STRIPS)
    red, green, *_ = (sum(abs(enclosed_area(line)) for line in lines) for lines in outlines)
    return {"areas": Measured(red / green)}


def pixels_over_bottom(renders: Renders) -> Quantities:
    """Return delays, shares and durations of echoes in four pixels and one over a flat bottom (figure 9)."""
    four, single = renders.shot(scenes.FOUR), renders.shot(scenes.SINGLE)
    measured = functools.partial(_measured, result=four, others=renders.random(scenes.FOUR))
    surface, bottom = (scenes.echo_gate(four, depth) for depth in (0.0, float(four.attrs["scene.bottom_depth"])))

    def shares(one: Waveform) -> FloatArray:
        energy = one.power.sum(axis=1)
        return np.asarray(energy / energy.sum())

    def ratio(one: Waveform, gate: tuple[float, float], measure: Callable[..., float]) -> float:
        mean = np.mean([measure(one, number, gate) for number in range(4)])
        return float(mean / measure(one.total(), 0, gate))

    total, one = four["waveform"].sum("pixel").values, single["waveform"].values[:, 0]
    words = {"shot": scenes.described(four)}
    return {
        "surface_delay": measured(lambda pixels: statements.far_after_near(pixels, surface)),
        "bottom_delay": measured(lambda pixels: statements.far_after_near(pixels, bottom)),
        "least_share": measured(lambda pixels: float(shares(pixels).min())),
        "largest_share": measured(lambda pixels: float(shares(pixels).max())),
        "sum": Measured(float(np.abs(total - one).max() / one.max()), words=words),
        "rise": measured(lambda pixels: ratio(pixels, surface, statements.rise_time)),
        "width": measured(lambda pixels: ratio(pixels, bottom, statements.half_width)),
        "time": Measured(float(four.attrs["elapsed_s"]) / four.sizes["pixel"], words=words),
    }


def surface_echoes(renders: Renders) -> Quantities:
    """Return strengths and times of three shots' surface echoes (figure 10)."""
    shots, slopes = scenes.three_shots(renders), scenes.shot_slopes(renders)
    places = renders.of_slopes(scenes.SHOTS[0], slopes)
    gate = scenes.echo_gate(shots[0], 0.0, 11.5)
    words = {"shot": scenes.described(shots[0]), "facets": _FACETS, "combinations": _COMBINATIONS, "seas": len(SEAS)}

    def strength(one: Waveform) -> float:
        return float(one.highest(gate)[0].sum())

    def separation(one: Waveform) -> float:
        return statements.far_after_near(one, gate)

    def red_to_green(one: Waveform) -> float:
        red, green, *_ = one.highest(gate)[1]
        return float(green - red)

    found = {}
    for other in (1, 2):
        value, ratios = _pair(shots, places, strength, (0, other), np.divide)
        more = {"share": 100 * np.mean(ratios > 1), "ratio": np.exp(np.nanmean(np.log(ratios)))}
        found[f"brighter_{other + 1}"] = Measured(*value, ratios, words | more)
    for near, far in ((0, 1), (1, 2), (0, 2)):
        value, changes = _pair(shots, places, separation, (far, near), np.subtract)
        found[f"closer_{near + 1}{far + 1}"] = Measured(*value, changes, words)
    words |= {"sideways": np.degrees(np.arctan(slopes[0][1])), "places": len(places[0])}
    found["sideways"] = _measured(red_to_green, shots[0], places[0], **words)
    delays = [one.each(separation) for one in places]
    along = np.concatenate([np.full(len(one), pair[0]) for one, pair in zip(delays, slopes, strict=True)])
    delay = np.concatenate(delays)
    known = np.isfinite(delay)
    correlation = float(np.corrcoef(along[known], delay[known])[0, 1])
    error = float((1 - correlation**2) / np.sqrt(known.sum() - 2))
    return {**found, "correlation": Measured(correlation, error, words={"places": known.sum()})}


def bottom_echoes(renders: Renders) -> Quantities:
    """Return strengths and depths of three shots' bottom echoes in the red pixel (figure 11)."""
    shots = scenes.three_shots(renders)
    places = renders.of_slopes(scenes.SHOTS[0], scenes.shot_slopes(renders))
    gate = scenes.echo_gate(shots[0], float(shots[0].attrs["scene.bottom_depth"]), 12.0)
    metres = scenes.geometry_of(shots[0]).depth_per_ns
    words = {"shot": scenes.described(shots[2]), "facets": _FACETS, "combinations": _COMBINATIONS}

    def height(one: Waveform) -> float:
        return float(one.highest(gate)[0][0])

    def depth(one: Waveform) -> float:
        return float(metres * one.highest(gate)[1][0])

    found = {}
    for other in (0, 1):
        value, ratios = _pair(shots, places, height, (2, other), np.divide)
        found[f"stronger_{other + 1}"] = Measured(*value, ratios, {**words, "ratio": np.nanmean(ratios)})
        value, changes = _pair(shots, places, depth, (2, other), np.subtract)
        more = {"share": 100 * np.mean(changes < 0), "change": np.nanmean(changes)}
        found[f"shallower_{other + 1}"] = Measured(*value, changes, {**words, **more})
    return found


def _pair(
    shots: Sequence[xr.Dataset],
    places: Sequence[Series],
    measure: Callable[[Waveform], float],
    pair: tuple[int, int],
    join: np.ufunc,
) -> tuple[tuple[float, float], FloatArray]:
    """Return the joined measures of two shots, with the error, and at all combinations of locations with their slopes.

    The latter are NaN where a location has no measure.
    """
    value = statements.estimate(
        lambda a, b: join(measure(a), measure(b)), *(as_series(shots[number]) for number in pair)
    )
    one, other = (places[number].each(measure) for number in pair)
    return value, np.asarray(join.outer(one, other)).ravel()


def paths(renders: Renders) -> Quantities:
    """Return the error of the depth by refraction below a slope (figure 12)."""
    one = scenes.System.of(scenes.SHOTS[0])
    along = np.array([pair[0] for pair in scenes.shot_slopes(renders)])
    bias = depth_bias(along, one.bottom_depth, one.off_nadir, one.refractive_index)
    slopes = ", ".join(f"{value:.1f}" for value in np.degrees(np.arctan(along)))
    return {
        "refraction": Measured(float(bias[2] - bias[:2].mean()), words={"slopes": slopes, "depth": one.bottom_depth})
    }


def square_target(renders: Renders) -> Quantities:
    """Return the target's echo in 2x2 pixels (figure 13)."""
    others = renders.random(scenes.SQUARE, move_target=True)
    return {"near_share": _measured(statements.near_share, renders.shot(scenes.SQUARE), others)}


def strip_target(renders: Renders) -> Quantities:
    """Return the target's echo and the backscatter in 1x4 pixels (figure 14)."""
    result = renders.shot(scenes.STRIPS)
    measured = functools.partial(_measured, result=result, others=renders.random(scenes.STRIPS, move_target=True))
    column, gate = _column(result), scenes.echo_gate(result, float(result.attrs["scene.target_depth"]), 14.0)

    def backscatter_ratio(one: Waveform, outer: int, inner: int) -> float:
        power = one.inside(column)
        return float(power[outer] / power[inner])

    def echoes(one: Waveform) -> float:
        height = one.highest(gate, "target")[0]
        return float(height[3] / height[2])

    def contrasts(one: Waveform) -> float:
        echo = np.nanmax(one.parts["target"], axis=1)
        times = np.argmax(one.parts["target"], axis=1)
        background = np.take_along_axis(one.power - one.parts["target"], times[:, None], axis=1)[:, 0]
        contrast = echo / background
        return float(contrast[3] / contrast[2])

    return {
        "near_share": measured(statements.near_share),
        "red_over_green": measured(lambda one: backscatter_ratio(one, 0, 1)),
        "black_over_blue": measured(lambda one: backscatter_ratio(one, 3, 2)),
        "echoes": measured(echoes),
        "contrasts": measured(contrasts),
    }


def layer_delays(renders: Renders) -> Quantities:
    """Return delays of the surface echo and of the water's change in the near pixels (figure 15)."""
    four, others = renders.shot(scenes.LAYERED_FOUR), renders.random(scenes.LAYERED_FOUR)
    gate, middles = scenes.echo_gate(four, 0.0), scenes.layer_times(four)

    def layer(one: Waveform) -> float:
        times = np.array([np.mean(statements.change(one, pixel, middle)) for pixel, middle in enumerate(middles)])
        return float(times[:2].mean() - times[2:].mean())

    return {
        "surface_delay": _measured(lambda one: statements.far_after_near(one, gate), four, others),
        "layer_delay": _measured(layer, four, others),
    }


def layer_durations(renders: Renders) -> Quantities:
    """Return durations of the water's change (figure 16)."""
    four, single = renders.shot(scenes.LAYERED_FOUR), renders.shot(scenes.LAYERED_SINGLE)
    middles, middle = scenes.layer_times(four), float(scenes.layer_times(single)[0])
    # Two pulse standard deviations [ns].
    shortest = 2 * float(single.attrs["pulse_fwhm_ns"]) / math.sqrt(8 * math.log(2))

    def mean_ratio(one: Waveform) -> float:
        pixels = np.array([statements.duration(one, pixel, time) for pixel, time in enumerate(middles)])
        return float(pixels.mean() / statements.duration(one.total(), 0, middle))

    return {
        "ratio": _measured(mean_ratio, four, renders.random(scenes.LAYERED_FOUR)),
        "duration": _measured(lambda one: statements.duration(one, 0, middle), single, shortest=shortest),
    }
