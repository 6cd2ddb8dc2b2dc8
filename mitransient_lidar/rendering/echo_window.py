"""Expected arrival of the echoes of a scene, estimated with rays."""

from __future__ import annotations

from dataclasses import dataclass

import drjit as dr
import mitsuba as mi
import numpy as np
from numpy.typing import NDArray

from mitransient_lidar.core.constants import C0
from mitransient_lidar.transport.opaque import opaque_point
from mitransient_lidar.transport.rng import pass_streams
from mitransient_lidar.transport.scene import LidarScene
from mitransient_lidar.transport.sensor.receiver import SensorSampler
from mitransient_lidar.transport.snell import refract

#: Number of rays, and share of the beam excluded at either end of an echo.
_RAYS = 2**16
_TAIL = 0.05

#: Largest number of pixels; with more, each would get too few rays, and the receiver is treated as one pixel.
_MOST_PIXELS = 1024


@dataclass(frozen=True)
class SolidEcho:
    """Mean and latest arrival of the direct echo of a solid over all pixels [ns]."""

    shape: mi.Shape
    mean_ns: float
    latest_ns: float


@dataclass(frozen=True)
class EchoProbe:
    """Expected arrival of echoes, weighted by the laser's beam.

    Attributes
    ----------
    surface_ns, bottom_ns
        Earliest and mean arrival of the surface echo, and mean and latest arrival of the echo of the first solid under
        water [ns], shape (pixels, 2) each; NaN without one.
    missed_beam
        Share of the beam inside the field of view that passes outside the surface mesh.
    pierced
        Solids visible both in the air and through the sea, and whether each is larger than the field of view.
    solids
        Echoes of the solids that rays of beam and view meet, in the air and under water.
    """

    surface_ns: NDArray[np.float64]
    bottom_ns: NDArray[np.float64]
    missed_beam: float
    pierced: list[tuple[mi.Shape, bool]]
    solids: list[SolidEcho]


def probe_echoes(scene: LidarScene, sampler: SensorSampler) -> EchoProbe:
    """Trace rays through the facets of the surface, without ripples and scattering."""
    start = sampler.sample(dr.arange(mi.UInt32, _RAYS), _RAYS, pass_streams(0, 0, _RAYS))
    beam = start.weight * scene.transmitter.intensity(start.direction)
    laser = opaque_point(scene.transmitter.pose.origin)
    ray = mi.Ray3f(opaque_point(scene.receiver.pose.origin), start.direction)
    first = scene.ray_intersect(ray, start.weight > 0)
    at_sea = first.is_valid() & scene.is_surface(first.shape)
    air = first.t + dr.norm(laser - first.p)

    # Refract at the facet.
    down = -dr.normalize(refract(-start.direction, first.n, 1 / scene.refractive_index))
    below = scene.ray_intersect(first.spawn_ray(down), at_sea)
    solid = at_sea & below.is_valid() & ~scene.is_surface(below.shape)
    water = 2 * below.t * scene.group_index
    # At once: each array that is read alone would trace all rays again.
    dr.eval(start, beam, first, below, at_sea, solid, air, water)

    pixel, weight = np.array(start.pixel), np.array(beam, dtype=np.float64)
    surface, pixels = np.array(at_sea), scene.receiver.pixels.count
    count = pixels if pixels <= _MOST_PIXELS else 1
    pixel = pixel if count > 1 else np.zeros_like(pixel)
    per_ns = 1e9 / C0
    arrivals = (
        _quantiles(np.array(air) * per_ns, weight * surface, pixel, count, (_TAIL, None)),
        _quantiles(np.array(air + water) * per_ns, weight * np.array(solid), pixel, count, (None, 1 - _TAIL)),
    )
    outside = ~surface if scene.surfaces else np.zeros_like(surface)
    missed = float(weight[outside].sum() / weight.sum()) if weight.sum() > 0 else 1.0
    surface_ns, bottom_ns = (np.broadcast_to(times, (pixels, 2)) for times in arrivals)
    met = dr.select(solid, below.shape, first.shape)
    length = air + dr.select(solid, water, 0)
    of_solid = solid | (first.is_valid() & ~at_sea)
    solids = _solid_echoes(scene, met, np.array(length) * per_ns, weight * np.array(of_solid))
    return EchoProbe(surface_ns, bottom_ns, missed, _pierced(scene, first, below, at_sea, solid), solids)


def _solid_echoes(
    scene: LidarScene, met: mi.ShapePtr, times_ns: NDArray[np.floating], weight: NDArray[np.float64]
) -> list[SolidEcho]:
    """Return the echoes of the solids that rays of some weight meet."""
    numbers, echoes = np.array(dr.reinterpret_array(mi.UInt32, met)), []
    for solid in scene.solids:
        own = weight * (numbers == np.array(dr.reinterpret_array(mi.UInt32, mi.ShapePtr(solid))))
        mean, latest = _quantiles(times_ns, own, np.zeros(len(own), dtype=np.int64), 1, (None, 1 - _TAIL))[0]
        if np.isfinite(mean):
            echoes.append(SolidEcho(solid, float(mean), float(latest)))
    return echoes


def _pierced(
    scene: LidarScene,
    first: mi.SurfaceInteraction3f,
    below: mi.SurfaceInteraction3f,
    at_sea: mi.Bool,
    under_water: mi.Bool,
) -> list[tuple[mi.Shape, bool]]:
    """Return the solids that rise through the sea in the field of view, and whether each is larger than it."""
    wet = np.array(first.p)[:2, np.array(at_sea)]
    pierced = []
    # Solids visible outside a small surface mesh lie lower.
    lowest = min((float(surface.bbox().min.z) for surface in scene.surfaces), default=0.0)
    in_air = first.is_valid() & (first.p.z > lowest)
    for solid in scene.solids if wet.size else []:
        pointer = mi.ShapePtr(solid)
        if dr.any(in_air & (first.shape == pointer)) and dr.any(under_water & (below.shape == pointer)):
            box = solid.bbox()
            low, high = np.array(box.min)[:2], np.array(box.max)[:2]
            pierced.append((solid, bool(np.all(low < wet.min(axis=1)) and np.all(high > wet.max(axis=1)))))
    return pierced


def _quantiles(
    values: NDArray[np.floating],
    weight: NDArray[np.float64],
    pixel: NDArray[np.integer],
    count: int,
    wanted: tuple[float | None, float | None],
) -> NDArray[np.float64]:
    """Return weighted quantiles (None: the mean) for each pixel, shape (pixels, 2)."""
    result = np.full((count, 2), np.nan)
    seen = weight > 0
    order = np.lexsort((values[seen], pixel[seen]))
    values, weight, pixel = values[seen][order], weight[seen][order], pixel[seen][order]
    edges = np.searchsorted(pixel, np.arange(count + 1))
    for index in np.flatnonzero(np.diff(edges)):
        part = slice(edges[index], edges[index + 1])
        cumulative = np.cumsum(weight[part])
        for column, share in enumerate(wanted):
            if share is None:
                result[index, column] = np.average(values[part], weights=weight[part])
            else:
                result[index, column] = values[part][np.searchsorted(cumulative, share * cumulative[-1])]
    return result
