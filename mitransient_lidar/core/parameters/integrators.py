"""Integrator parameters."""

from __future__ import annotations

from mitransient_lidar.core.parameters.fields import Parameter, count, number, plugin, switch, text

# A parameter a row, which the formatter would spread over five.
# fmt: off

_FEWEST, _MOST = 1024, 2**28

_UNLESS = "unless the sample count per pixel (``spp``) is given to ``mi.render``"


def _guiding(name: str, default: float, meaning: str) -> Parameter:
    return number(name, default, "1", 0, 0.99, meaning)


def _roulette(default: float, meaning: str) -> Parameter:
    return number("roulette_threshold", default, "1", 0, 1, meaning)


_PATHS = count("paths_per_pass", 2**18, _FEWEST, _MOST, f"Paths of one pass, {_UNLESS}")
_SCATTERINGS = count("max_scatterings", -1, -1, 2**30, "Largest number of scattering events in the water, -1 for any")
LIDAR_MERGING = plugin(
    "lidar_merging",
    count("paths_per_pass", None, _FEWEST, _MOST, f"Paths from the receiver in one pass, {_UNLESS}",
        otherwise="``32768``, or 16 a pixel up to 2^21, from 4096 pixels on 32 a pixel up to 2^20"),
    count("photons_per_pass", None, _FEWEST, _MOST, "Paths from the laser in one pass",
        otherwise="``32768``, or ``65536`` from 4096 pixels on"),
    number("cell_size", 0.0, "m", 0, 1e4,
        "Horizontal cell width on the beam's axis at the surface, within 2e-6 to 2 standard deviations of the beam "
        "there; 0: from footprint, sea facets, field of view and attenuation. Smaller cells have less bias and more "
        "noise", by_id=True),
    number("point_spacing", 0.0, "m", 0, 1e4,
        "Distance between points along a path; 0: a fourteenth of the distance to the bottom or to the depth that the "
        "time axis allows, a tenth from 4096 pixels on"),
    text("solids", "auto",
        "``merged`` with light, or ``connected`` to the laser as by ``lidar_volpath``, which keeps gaps that laser and "
        "receiver share; ``auto``: connected where the scene has a ``canopy``", ("auto", "merged", "connected")),
)

LIDAR_VOLPATH = plugin(
    "lidar_volpath",
    _PATHS,
    _SCATTERINGS,
    _roulette(0.001,
        "Throughput below which Russian roulette begins. A path that was scattered back carries little throughput and "
        "much signal, so this is low"),
    _guiding("guiding_probability", 0.4,
        "Probability, at scattering events and at hits on rough solids under water, that the direction is drawn from "
        "a broad lobe towards the laser instead of the phase function or BSDF: every echo needs one large scattering "
        "angle, which is rare"),
    switch("complement_only", False,
        "Whether to leave out the paths of ``lidar_merging``: echoes with one vertex in the air, all paths that "
        "scatter in the water and meet no solid, and those whose first solid is under water and not a mirror"),
)

PASSIVE_VOLPATH = plugin(
    "passive_volpath",
    _PATHS,
    _guiding("guiding_probability", 0.15,
        "Probability, at scattering events, that the direction is drawn from a lobe towards the sun. Large values give "
        "a few paths very large weights. Without a sun there is no lobe"),
    _guiding("solid_guiding_probability", 0.9,
        "The same at hits on rough solids under water, with a narrower lobe, times the share of the sunlight that is "
        "scattered above the solid"),
    _roulette(0.1,
        "Expected contribution below which Russian roulette begins: throughput times radiance under water, relative to "
        "its mean over all directions, which is assumed to be largest about the refracted sun"),
    _SCATTERINGS,
)
