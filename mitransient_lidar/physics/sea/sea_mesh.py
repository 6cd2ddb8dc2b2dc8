"""Triangle mesh of a sea surface: a fine square patch, surrounded by cells that grow towards the horizon."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np
import numpy.typing as npt

from mitransient_lidar.core.validation import FloatArray, IntArray, require_memory

#: Ratio between the lengths of neighbouring cells outside the fine patch.
_GROWTH = 1.3

#: Memory of a cell: its heights, triangles, their copy in Mitsuba and the tree in which rays meet them [bytes].
_BYTES_PER_CELL = 280


@dataclass(frozen=True)
class SeaMesh:
    """Triangle mesh for a height field."""

    vertices: FloatArray  #: Positions [m], shape (vertices, 3).
    faces: npt.NDArray[np.uint32]  #: Indices of the corners, counter-clockwise seen from the air, shape (faces, 3).
    texcoords: FloatArray  #: Coordinates along and across the wind [m], axes of the ripples, shape (vertices, 2).
    foam: FloatArray | None = None  #: Foam share of each face [1], shape (faces,); None for a sea without foam.


def grid_indices(cells: int, extent: int, growth: float = _GROWTH, meshes: int = 1) -> IntArray:
    """Return grid line positions in cells of the fine patch, counted from its centre.

    Raises UserError if the meshes exceed the memory.

    Parameters
    ----------
    cells
        Cells per side in the fine patch, even.
    extent
        Side of the whole mesh in these cells, at least `cells`.
    growth
        Ratio between the lengths of neighbouring cells outside the patch, above 1.
    meshes
        Number of such meshes made at a time.

    Returns
    -------
    ndarray of int
        Symmetric about 0, one apart inside the patch; integers, so that all heights are points of the fine grid.
    """
    outer, step, end = [], 1.0, cells // 2
    while end < extent / 2:
        step *= growth
        end = min(end + int(step), -(-extent // 2))
        outer.append(end)
    side = cells + 2 * len(outer)
    size = _BYTES_PER_CELL * float(meshes) * side**2
    require_memory(f"{meshes} meshes of {side} x {side} cells", size, "take larger cells or a smaller refined_size")
    inner, right = np.arange(-(cells // 2), cells // 2 + 1, dtype=np.int64), np.array(outer, dtype=np.int64)
    return np.concatenate([-right[::-1], inner, right])


def joined(meshes: Sequence[SeaMesh]) -> SeaMesh:
    """Return one mesh from several."""
    counts = np.cumsum([0, *(len(mesh.vertices) for mesh in meshes)], dtype=np.uint32)
    return SeaMesh(
        np.concatenate([mesh.vertices for mesh in meshes]),
        np.concatenate([mesh.faces + first for mesh, first in zip(meshes, counts, strict=False)]),
        np.concatenate([mesh.texcoords for mesh in meshes]),
        None if meshes[0].foam is None else np.concatenate([mesh.foam for mesh in meshes if mesh.foam is not None]),
    )


def triangulate(heights: FloatArray, x: FloatArray, y: FloatArray, wind_direction: float) -> SeaMesh:
    """Return the triangle mesh for heights on grid lines.

    Cells are split along the diagonal from (i+1, j) to (i, j+1), as `realization.facet_slope_variance` assumes.

    Parameters
    ----------
    heights
        Elevation [m], shape (len(y), len(x)).
    x, y
        Grid line positions [m], increasing.
    wind_direction
        Direction of the first texture coordinate [rad], counter-clockwise from +x.
    """
    east, north = np.meshgrid(x, y)
    vertices = np.stack([east, north, heights], axis=-1).reshape(-1, 3)
    cos, sin = np.cos(wind_direction), np.sin(wind_direction)
    texcoords = np.stack([cos * east + sin * north, cos * north - sin * east], axis=-1).reshape(-1, 2)
    return SeaMesh(vertices, grid_faces(len(y), len(x)), texcoords)


def grid_faces(rows: int, columns: int) -> npt.NDArray[np.uint32]:
    """Return the triangles of a grid of points in rows: indices of their corners, shape (faces, 3)."""
    starts = columns * np.arange(rows - 1, dtype=np.uint32)
    corner = (starts[:, None] + np.arange(columns - 1, dtype=np.uint32)).ravel()
    faces = np.empty((len(corner), 2, 3), dtype=np.uint32)
    faces[:, 0] = np.stack([corner, corner + 1, corner + columns], axis=-1)
    faces[:, 1] = np.stack([corner + 1, corner + columns + 1, corner + columns], axis=-1)
    return faces.reshape(-1, 3)
