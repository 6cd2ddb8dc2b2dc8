"""Statements about three shots on the slopes of waves: figures 10 and 11."""

from __future__ import annotations

from collections.abc import Callable

import numpy as np
import xarray as xr

from mitransient_lidar.core.validation import FloatArray
from mitransient_lidar.studies.publication.echoes import far_after_near
from mitransient_lidar.studies.publication.geometry import SHOT_SCENES, shot_slopes
from mitransient_lidar.studies.publication.measures import Series, Waveform, estimate
from mitransient_lidar.studies.publication.renders import (
    PLACES_OF_SLOPE,
    SEAS,
    Renders,
    as_series,
    described,
    echo_gate,
    geometry_of,
)
from mitransient_lidar.studies.publication.statements import Statement

#: Bins of the renders of the three shots [ns].
BIN_WIDTH_NS = 0.25

_OTHERS = "combinations of {} places of each slope on {} seas"

#: Reason for differences of single places.
_FACETS = "at places of the same mean slope, a few facets make the echo, so that places differ"


def shots(renders: Renders) -> list[xr.Dataset]:
    """Return the renders of the three shots, which figures 10 and 11 share."""
    return [renders.shot(scene, bin_width_ns=BIN_WIDTH_NS) for scene in SHOT_SCENES]


def surface_statements(renders: Renders) -> list[Statement]:
    """Return the statements about the surface echoes (figure 10)."""
    results = shots(renders)
    first, second, third = (as_series(one) for one in results)
    slopes = shot_slopes(renders)
    places = renders.of_slopes(SHOT_SCENES[0], slopes)
    gate = echo_gate(results[0], 0.0, 11.5)
    others = _OTHERS.format(PLACES_OF_SLOPE * len(SEAS), len(SEAS))
    where = f"highest points of the waveforms; {described(results[0])}"

    def strength(one: Waveform) -> float:
        return float(one.highest(gate)[0].sum())

    def separation(one: Waveform) -> float:
        return far_after_near(one, gate)

    def red_to_green(one: Waveform) -> float:
        times = one.highest(gate)[1]
        return float(times[1] - times[0])

    found = []
    for number, other in ((2, second), (3, third)):
        ratios = _pairs(places, strength, (0, number - 1), np.divide)
        found.append(
            Statement(
                "fig10",
                f"the surface echo of shot 1, whose slope faces the lidar, is 4 to 5 times that of shot {number}",
                f"sum of the pixels' maxima of shot 1 over that of shot {number}",
                "4 to 5",
                *estimate(lambda a, b: strength(a) / strength(b), first, other),
                (4.0, 5.0),
                where,
                float(np.mean((ratios >= 4) & (ratios <= 5))),
                others,
                f"{_FACETS}: shot 1 is the brighter one in {100 * np.mean(ratios > 1):.0f} % of the combinations, and "
                f"{np.exp(np.nanmean(np.log(ratios))):.1f} times as bright in the geometric mean",
            )
        )
    for name, a, b, pair, picked in (
        ("shot 1 are closer together than those of shot 2", first, second, (0, 1), 2),
        ("shot 2 are closer together than those of shot 3", second, third, (1, 2), 3),
        ("shot 1 are closer together than those of shot 3", first, third, (0, 2), 3),
    ):
        changes = -_pairs(places, separation, pair, np.subtract)
        found.append(
            Statement(
                "fig10",
                f"the echoes of {name}",
                f"delay of far after near pixels of shot {picked}, less that of shot {pair[0] + 1} (ns)",
                "> 0",
                *estimate(lambda one, two: separation(two) - separation(one), a, b),
                (0.0, np.inf),
                where,
                float(np.mean(changes > 0)),
                others,
                _FACETS,
            )
        )
    sideways = places[0].each(red_to_green)
    found.append(
        Statement(
            "fig10",
            "the sideways slope of shot 1 shows in the earlier echo of red",
            "delay of green after red (ns)",
            "> 0",
            *estimate(red_to_green, first),
            (0.0, np.inf),
            f"{where}; mean slope {np.degrees(np.arctan(slopes[0][1])):.1f} degrees, higher on red's side",
            float(np.mean(sideways > 0)),
            f"{len(places[0])} places of this slope on {len(SEAS)} seas",
            _FACETS,
        )
    )
    delays = [one.each(separation) for one in places]
    along = np.concatenate([np.full(len(one), pair[0]) for one, pair in zip(delays, slopes, strict=True)])
    delay = np.concatenate(delays)
    known = np.isfinite(delay)
    correlation = float(np.corrcoef(along[known], delay[known])[0, 1])
    found.append(
        Statement(
            "fig10",
            "the slope of the surface can be estimated within one shot",
            "correlation of the delay of far after near pixels with the slope towards the lidar",
            "< 0",
            correlation,
            float((1 - correlation**2) / np.sqrt(known.sum() - 2)),
            (-1.0, -0.5),
            f"highest points of the waveforms at {known.sum()} places of the slopes of shots 1 to 3",
            difference="delay alone; the limit -0.5 is a choice, a quarter of the variance",
        )
    )
    return found


def bottom_statements(renders: Renders) -> list[Statement]:
    """Return the statements about the bottom echo of the red pixel (figure 11)."""
    results = shots(renders)
    series = [as_series(one) for one in results]
    places = renders.of_slopes(SHOT_SCENES[0], shot_slopes(renders))
    gate = echo_gate(results[0], float(results[0].attrs["scene.bottom_depth"]), 12.0)
    metres = geometry_of(results[0]).depth_per_ns
    others = _OTHERS.format(PLACES_OF_SLOPE * len(SEAS), len(SEAS))
    where = f"highest point of red; {described(results[2])}"

    def height(one: Waveform) -> float:
        return float(one.highest(gate)[0][0])

    def depth(one: Waveform) -> float:
        return float(metres * one.highest(gate)[1][0])

    found = []
    for number in (1, 2):
        other = series[number - 1]
        ratios = _pairs(places, height, (2, number - 1), np.divide)
        changes = _pairs(places, depth, (2, number - 1), np.subtract)
        strongest = f"the mean ratio is {np.nanmean(ratios):.2f}"
        shallower = f"the mean difference is {np.nanmean(changes):+.3f} m"
        found += [
            Statement(
                "fig11",
                f"the bottom echo of shot 3, whose slope faces away, is slightly stronger than that of shot {number}",
                f"maximum of shot 3 over that of shot {number}",
                "> 1",
                *estimate(lambda a, b: height(a) / height(b), series[2], other),
                (1.0, np.inf),
                where,
                float(np.mean(ratios > 1)),
                others,
                f"{_FACETS}: {strongest}",
            ),
            Statement(
                "fig11",
                f"the bottom echo of shot 3 is shallower by about 0.1 m than that of shot {number}",
                f"depth of shot 3 less that of shot {number} (m)",
                "-0.1",
                *estimate(lambda a, b: depth(a) - depth(b), series[2], other),
                (-0.15, -0.05),
                where,
                float(np.mean((changes >= -0.15) & (changes <= -0.05))),
                others,
                f"{_FACETS}, and heights of the waves shift echoes: shot 3 is shallower in "
                f"{100 * np.mean(changes < 0):.0f} % of the combinations, and {shallower}",
            ),
        ]
    return found


def _pairs(
    places: list[Series], measure: Callable[[Waveform], float], pair: tuple[int, int], join: np.ufunc
) -> FloatArray:
    """Return what joins the measures of all combinations of places of two kinds, NaN where one has none."""
    one, other = (places[number].each(measure) for number in pair)
    return np.asarray(join.outer(one, other)).ravel()
