"""Depths under the beam, by rays traced through the facets of the true sea to the true bottom."""

from __future__ import annotations

import json

import mitsuba as mi
import numpy as np
from matplotlib.path import Path


def depths_under_beam(scene, dataset, pose, rays=200_000, seed=0):
    """Return means over the beam in each pixel: depth of the bottom and height of the sea [m], and share of the rays.

    Rays leave the lidar with the density of the Gaussian beam, or evenly over the pixels of an imager, whose beam is a
    weight. Each is refracted by the facet that it meets, without ripples. `pose` is origin, axis, far and left.
    """
    rng = np.random.default_rng(seed)
    sigma, half = 0.5e-3 * dataset.attrs["divergence_mrad"], 0.5e-3 * dataset.attrs["field_of_view_mrad"]
    imager = "row" in dataset.dims
    angles = rng.uniform(-half, half, (rays, 2)) if imager else rng.normal(0, sigma, (rays, 2))
    weight = np.exp(-0.5 * (angles**2).sum(axis=1) / sigma**2) if imager else np.ones(rays)
    origin, axis, far, left = np.reshape(pose, (4, 3))
    ray = axis + angles[:, :1] * far + angles[:, 1:] * left
    ray /= np.linalg.norm(ray, axis=1, keepdims=True)
    sea, normal = _meet(scene, np.broadcast_to(origin, ray.shape), ray)
    n = dataset.attrs["refractive_index"]
    cosine = -(ray * normal).sum(axis=1, keepdims=True)
    ray = ray / n + (cosine / n - np.sqrt(1 - (1 - cosine**2) / n**2)) * normal
    bottom, _ = _meet(scene, sea + 2e-3 * ray, ray)
    pixel, count = _pixels(dataset, angles)
    seen = (pixel >= 0) & np.isfinite(bottom).all(axis=1)

    def total(values):
        return np.bincount(pixel[seen], (weight * values)[seen], count)

    light = total(np.ones(rays))
    with np.errstate(invalid="ignore"):
        return total(-bottom[:, 2]) / light, total(sea[:, 2]) / light, light / light.sum()


def _meet(scene, points, directions):
    """Return the points where rays meet the scene, NaN if nowhere, and the normals that face upwards."""
    vectors = [
        [mi.Float(np.ascontiguousarray(values[:, i], dtype=np.float32)) for i in range(3)]
        for values in (points, directions)
    ]
    found = scene.ray_intersect(mi.Ray3f(mi.Point3f(*vectors[0]), mi.Vector3f(*vectors[1])))
    place, normal = (np.array(one, dtype=np.float64).T for one in (found.p, found.n))
    place[~np.array(found.is_valid())] = np.nan
    return place, normal * np.sign(normal[:, 2:])


def _pixels(dataset, angles):
    """Return the number of the pixel of each ray, -1 outside, and the number of pixels."""
    if "row" in dataset.dims:
        size, side = dataset.sizes["row"], 1e-3 * dataset.attrs["field_of_view_mrad"]
        # Row 0 is the far edge, +angle_x; column 0 the left one, +angle_y.
        row, column = (np.clip((0.5 - one / side) * size, 0, size - 1).astype(int) for one in angles.T)
        return row * size + column, size**2
    pixel = np.full(len(angles), -1)
    outlines = json.loads(dataset.attrs["pixel_outlines"])
    for number, lines in enumerate(outlines):
        for line in lines:
            pixel[Path(1e-3 * np.reshape(line, (-1, 2))).contains_points(angles)] = number
    return pixel, len(outlines)
