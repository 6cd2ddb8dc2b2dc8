"""When the echoes of a scene arrive, found with a few rays: the window in which a waveform's error is judged."""

from __future__ import annotations

from dataclasses import dataclass

import drjit as dr
import mitsuba as mi
import numpy as np
from numpy.typing import NDArray

from mitransient_lidar.optics.water import C0
from mitransient_lidar.transport.opaque import opaque_point
from mitransient_lidar.transport.path import optical_length
from mitransient_lidar.transport.receiving import ViewSampler
from mitransient_lidar.transport.streams import pass_streams
from mitransient_lidar.transport.system import LidarScene

#: Rays that probe a scene, and the share of the beam at either end of an echo that is left out of its window.
_RAYS = 2**16
_TAIL = 0.05

#: Receivers of more pixels are probed as a whole: a pixel would get too few rays.
_MOST_PIXELS = 1024


@dataclass(frozen=True)
class EchoProbe:
    """Where echoes are expected, weighted by the laser's beam.

    Attributes
    ----------
    surface_ns
        Earliest and mean arrival of the surface echo for each pixel [ns], shape (pixels, 2); NaN where it sees none.
    bottom_ns
        Mean and latest arrival of the echo from the first solid under water [ns], shape (pixels, 2); NaN without.
    missed_beam
        Share of the beam inside the field of view that passes beside the surface.
    pierced
        Solids that the receiver sees both in the air and through the sea, and whether each is larger than what it sees.
    """

    surface_ns: NDArray[np.float64]
    bottom_ns: NDArray[np.float64]
    missed_beam: float
    pierced: list[tuple[mi.Shape, bool]]


def probe_echoes(system: LidarScene, view: ViewSampler) -> EchoProbe:
    """Trace rays through the facets of the surface, without ripples and scattering, and time where they get to."""
    start = view.sample(dr.arange(mi.UInt32, _RAYS), _RAYS, pass_streams(0, 0, _RAYS))
    beam = start.weight * system.transmitter.intensity(start.direction)
    laser = opaque_point(system.transmitter.pose.origin)
    ray = mi.Ray3f(opaque_point(system.receiver.pose.origin), start.direction)
    first = system.scene.ray_intersect(ray, start.weight > 0)
    at_sea = first.is_valid() & system.is_surface(first.shape)
    air = first.t + dr.norm(laser - first.p)

    # Refract at the facet and go on to whatever lies under it.
    cosine = -dr.dot(start.direction, first.n)
    eta = 1 / system.refractive_index
    root = dr.safe_sqrt(1 - eta * eta * (1 - cosine * cosine))
    down = dr.normalize(eta * start.direction + (eta * cosine - root) * mi.Vector3f(first.n))
    below = system.scene.ray_intersect(first.spawn_ray(down), at_sea)
    solid = at_sea & below.is_valid() & ~system.is_surface(below.shape)
    water = 2 * optical_length(system, below.t, True)

    pixel, weight = np.array(start.pixel), np.array(beam, dtype=np.float64)
    surface, bottom = np.array(at_sea), np.array(solid)
    pixels = system.receiver.pixels.count
    count = pixels if pixels <= _MOST_PIXELS else 1
    pixel = pixel if count > 1 else np.zeros_like(pixel)
    per_ns = 1e9 / C0
    beside = ~surface if system.surfaces else np.zeros_like(surface)
    total = weight.sum()
    return EchoProbe(
        np.broadcast_to(_quantiles(np.array(air) * per_ns, weight * surface, pixel, count, (_TAIL, None)), (pixels, 2)),
        np.broadcast_to(
            _quantiles(np.array(air + water) * per_ns, weight * bottom, pixel, count, (None, 1 - _TAIL)), (pixels, 2)
        ),
        float(weight[beside].sum() / total) if total > 0 else 1.0,
        _pierced(system, first, below, at_sea, solid),
    )


def _pierced(
    system: LidarScene,
    first: mi.SurfaceInteraction3f,
    below: mi.SurfaceInteraction3f,
    at_sea: mi.Bool,
    under_water: mi.Bool,
) -> list[tuple[mi.Shape, bool]]:
    """Return the solids that rise through the sea where the receiver looks, and whether each is larger than that."""
    wet = np.array(first.p)[:2, np.array(at_sea)]
    pierced = []
    # What is seen beside a small patch lies lower.
    lowest = min((float(surface.bbox().min.z) for surface in system.surfaces), default=0.0)
    in_air = first.is_valid() & (first.p.z > lowest)
    for solid in system.solids if wet.size else []:
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
