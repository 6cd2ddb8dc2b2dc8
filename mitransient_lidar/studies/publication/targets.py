"""Statements about a square target in 2x2 and in 1x4 pixels: figures 13 and 14."""

from __future__ import annotations

import numpy as np

from mitransient_lidar.studies.publication.echoes import RANDOM
from mitransient_lidar.studies.publication.measures import Waveform, estimate
from mitransient_lidar.studies.publication.renders import (
    Renders,
    as_series,
    described,
    echo_gate,
    geometry_of,
    joined,
)
from mitransient_lidar.studies.publication.statements import Statement

SQUARE, STRIPS = "fig13_2x2", "fig14_1x4"

#: Depths between which the backscatter above the target is compared [m].
_COLUMN = (2.0, 6.5)

_STEERED = "waves steer the beam, and with it the echo"


def near_share(one: Waveform) -> float:
    """Return the share of blue and black in the energy that the target reflects."""
    energy = one.parts["target"].sum(axis=1)
    return float(energy[2:].sum() / energy.sum())


def square_statements(renders: Renders) -> list[Statement]:
    """Return the statements about 2x2 pixels (figure 13)."""
    return [_near_statement(renders, SQUARE, "fig13", "2x2 pixels")]


def strip_statements(renders: Renders) -> list[Statement]:
    """Return the statements about 1x4 pixels (figure 14)."""
    result = renders.shot(STRIPS)
    others = joined([as_series(one) for one in renders.random(STRIPS, move_target=True)])
    geometry, where = geometry_of(result), described(result)
    start, end = (float(geometry.time_of_depth(depth)) for depth in _COLUMN)
    gate = echo_gate(result, float(result.attrs["scene.target_depth"]), 14.0)

    def column(one: Waveform, outer: int, inner: int) -> float:
        power = one.inside((start, end))
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

    found = [_near_statement(renders, STRIPS, "fig14", "1x4 pixels")]
    for outer, inner, name in ((0, 1, "red over green"), (3, 2, "black over blue")):

        def ratio(one: Waveform, outer: int = outer, inner: int = inner) -> float:
            return column(one, outer, inner)

        found.append(
            Statement(
                "fig14",
                "the outer strips receive much less backscatter from above 8 m",
                f"mean power from {_COLUMN[0]:g} to {_COLUMN[1]:g} m, {name}",
                "much less than 1",
                *estimate(ratio, as_series(result)),
                (0.0, 0.5),
                where,
                float(np.mean(others.each(ratio) < 0.5)),
                RANDOM,
            )
        )
    found += [
        Statement(
            "fig14",
            "the target's echo in black is almost as strong as in blue",
            "highest point of the target's light, black over blue",
            "almost 1",
            *estimate(echoes, as_series(result)),
            (0.75, 1.25),
            where,
            float(np.mean(np.abs(others.each(echoes) - 1) <= 0.25)),
            f"{RANDOM}, the target below the aim of each",
            f"{_STEERED}; the sea of the scene was chosen for this statement",
        ),
        Statement(
            "fig14",
            "black is the better pixel for detecting the target against the backscatter",
            "target over other light at its highest point, black over blue",
            "> 1",
            *estimate(contrasts, as_series(result)),
            (1.0, np.inf),
            where,
            float(np.mean(others.each(contrasts) > 1)),
            f"{RANDOM}, the target below the aim of each",
        ),
    ]
    return found


def _near_statement(renders: Renders, scene: str, figure: str, pixels: str) -> Statement:
    result = renders.shot(scene)
    others = joined([as_series(one) for one in renders.random(scene, move_target=True)])
    return Statement(
        figure,
        f"the near pixels hold the largest part of the target's echo: {pixels}",
        "share of blue and black in the energy that the target reflects",
        "> 0.5",
        *estimate(near_share, as_series(result)),
        (0.5, 1.0),
        described(result),
        float(np.mean(others.each(near_share) > 0.5)),
        f"{RANDOM}, the target below the aim of each",
        _STEERED,
    )
