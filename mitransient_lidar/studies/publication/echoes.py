"""Statements about a flat bottom, a sphere and a mast: figures 1, 2, 4 and 9."""

from __future__ import annotations

from collections.abc import Callable

import numpy as np
import xarray as xr

from mitransient_lidar.core.validation import FloatArray
from mitransient_lidar.studies.publication.measures import Series, Waveform, decay, estimate, half_width, rise_time
from mitransient_lidar.studies.publication.renders import (
    RANDOM_PLACES,
    SEAS,
    Renders,
    as_series,
    described,
    echo_gate,
    geometry_of,
    joined,
)
from mitransient_lidar.studies.publication.statements import Statement

SINGLE, FOUR, MINE, MAST = "fig09_1x1", "fig09_2x2", "fig02_mine", "fig04_mast"

#: Depths between which the decay of the backscatter is fitted [m].
_COLUMN = (2.0, 6.5)

#: Other places of a scene.
RANDOM = f"{RANDOM_PLACES * len(SEAS)} random places on {len(SEAS)} seas"


def far_after_near(waveform: Waveform, gate: tuple[float, float], origin: str = "") -> float:
    """Return the delay of the mean highest point of the far pixels after that of the near ones [ns]."""
    times = waveform.highest(gate, origin)[1]
    return float(times[:2].mean() - times[2:].mean())


def decay_statements(renders: Renders) -> list[Statement]:
    """Return the statements about the decay of the backscatter (figure 1b)."""
    result = renders.shot(SINGLE)
    series, geometry = as_series(result), geometry_of(result)
    start, end = (float(geometry.time_of_depth(depth)) for depth in _COLUMN)
    per_metre = 2 * geometry.metres_per_ns
    absorption = float(result.attrs["scene.attenuation"]) - float(result.attrs["scene.scattering"])

    def absorbed(one: Waveform) -> float:
        return absorption * per_metre / decay(one, (start, end))[0]

    rest = estimate(lambda one: decay(one, (start, end))[1], series)
    others = joined([as_series(one) for one in renders.random(FOUR)])
    shares = others.each(absorbed)
    rests = others.each(lambda one: decay(one, (start, end))[1])
    where = f"least squares of the logarithm from {_COLUMN[0]:g} to {_COLUMN[1]:g} m; {described(result)}"
    return [
        Statement(
            "fig01b",
            "backscatter decays about exponentially with depth",
            "rms residual of an exponential (1)",
            "",
            *rest,
            (0.0, 0.1),
            where,
            float(np.mean(rests < 0.1)),
            RANDOM,
            "waves focus the light at some depths",
        ),
        Statement(
            "fig01b",
            "absorption explains the decay",
            "absorption over the decay along the path, most of it from 0.5 on",
            "",
            *estimate(absorbed, series),
            (0.5, 1.0),
            f"{where}; absorption {absorption:g} per metre",
            float(np.mean((shares >= 0.5) & (shares <= 1))),
            RANDOM,
            "scattering out of the field of view, and the spreading of the light, add to absorption",
        ),
    ]


def target_statements(renders: Renders) -> list[Statement]:
    """Return the statement about the sphere at 9 m (figure 2)."""
    result = renders.shot(MINE)
    gate, geometry = echo_gate(result, 9.0), geometry_of(result)
    depth = estimate(lambda one: float(geometry.depth_of_time(one.highest(gate, "target")[1][0])), as_series(result))
    size = float(result.attrs["scene.target_size"])
    return [
        Statement(
            "fig02",
            "a sphere of 1 m at 9 m gives an echo between surface and bottom",
            "depth of the highest point of its echo on the axis (m)",
            "9",
            *depth,
            (9.0 - 0.5 * size, 9.0 + 0.5 * size),
            f"light that the sphere reflects; {described(result)}",
            difference="the published echo is a measurement with another system over unknown water",
        )
    ]


def mast_statements(renders: Renders) -> list[Statement]:
    """Return the statement about the target below a mast (figure 4)."""
    result = renders.shot(MAST)
    geometry = geometry_of(result)
    start, end = (float(geometry.time_of_depth(depth)) for depth in (0.5, 1.5))

    def echo_share(one: Waveform) -> float:
        total = one.total()
        inside = (one.time >= start) & (one.time <= end)
        return float(total.parts["target"][0, inside].sum() / total.power[0, inside].sum())

    return [
        Statement(
            "fig04",
            "a target of 1 m^2 1 m below the surface is detected at a grazing angle of 5.4 degrees",
            "share of the target in the light between 0.5 and 1.5 m",
            "",
            *estimate(echo_share, as_series(result)),
            (0.1, 1.0),
            f"light by its origin, four pixels together; {described(result)}",
            difference="the published echo is a measurement; range, beam and water are not given",
        )
    ]


def pixel_statements(renders: Renders) -> list[Statement]:
    """Return the statements about four pixels and one over a flat bottom (figure 9)."""
    four, single = renders.shot(FOUR), renders.shot(SINGLE)
    others = joined([as_series(one) for one in renders.random(FOUR)])
    where = described(four)
    return [
        *_delays(four, others, where),
        *_shares(four, single, others, where),
        *_smearing(four, single, others, where),
        Statement(
            "fig09",
            "one pixel takes 1 s to 1 min of computation",
            "time of the renders of figure 9a for each pixel (s)",
            "1 to 60",
            float(four.attrs["elapsed_s"]) / four.sizes["pixel"],
            0.0,
            (0.0, 60.0),
            f"clock of this machine, as busy as it was, four pixels at once; {where}",
        ),
    ]


def _delays(four: xr.Dataset, others: Series, where: str) -> list[Statement]:
    found = []
    depth = float(four.attrs["scene.bottom_depth"])
    for name, level in (("surface", 0.0), ("bottom", depth)):
        gate = echo_gate(four, level)

        def delay(one: Waveform, gate: tuple[float, float] = gate) -> float:
            return far_after_near(one, gate)

        found.append(
            Statement(
                "fig09",
                f"the {name} echo arrives earlier in the near pixels",
                "delay of red and green after blue and black (ns)",
                "> 0",
                *estimate(delay, as_series(four)),
                (0.0, np.inf),
                f"highest points of the waveforms; {where}",
                float(np.mean(others.each(delay) > 0)),
                RANDOM,
            )
        )
    return found


def _shares(four: xr.Dataset, single: xr.Dataset, others: Series, where: str) -> list[Statement]:
    found = []

    def pixel_shares(one: Waveform) -> FloatArray:
        energy = one.power.sum(axis=1)
        return np.asarray(energy / energy.sum())

    for name, pick in (("least", np.min), ("largest", np.max)):

        def share(one: Waveform, pick: Callable[[FloatArray], float] = pick) -> float:
            return float(pick(pixel_shares(one)))

        places = others.each(share)
        found.append(
            Statement(
                "fig09",
                "each pixel receives about a quarter of the single pixel's light",
                f"{name} share of the four pixels in their energy",
                "0.25",
                *estimate(share, as_series(four)),
                (0.2, 0.3),
                f"energy of the whole record; {where}",
                float(np.mean((places > 0.2) & (places < 0.3))),
                RANDOM,
                "waves turn the glint of a pixel on or off",
            )
        )
    total, one = four["waveform"].sum("pixel").values, single["waveform"].values[:, 0]
    found.append(
        Statement(
            "fig09",
            "on the same sea the four pixels add up to the single one exactly",
            "largest difference of sum and single pixel over the highest power",
            "0",
            float(np.abs(total - one).max() / one.max()),
            0.0,
            (0.0, 1e-12),
            f"renders with the same random numbers, every bin; {where}",
        )
    )
    return found


def _smearing(four: xr.Dataset, single: xr.Dataset, others: Series, where: str) -> list[Statement]:
    """Return the statements about the duration of short echoes in the pixels and in their sum."""
    found = []
    depth = float(four.attrs["scene.bottom_depth"])
    for name, level, measure in (("rise of the surface echo", 0.0, rise_time), ("bottom echo", depth, half_width)):
        gate = echo_gate(four, level)

        def ratio(pixels: Waveform, gate: tuple[float, float] = gate, measure: Callable[..., float] = measure) -> float:
            mean = np.mean([measure(pixels, number, gate) for number in range(4)])
            return float(mean / measure(pixels.total(), 0, gate))

        kind = "10 to 90 % rise" if level == 0 else "full width at half height"
        found.append(
            Statement(
                "fig09",
                f"2x2 pixels avoid the smearing of a short echo: {name}",
                f"{kind}, mean of the pixels over the single pixel",
                "< 1",
                *estimate(ratio, as_series(four)),
                (0.0, 1.0),
                f"single pixel as the sum of the four; {where}",
                float(np.mean(others.each(ratio) < 1)),
                RANDOM,
            )
        )
    return found
