"""Sea surface mesh, a fine square patch among cells that grow towards the horizon, and its automatic size and cells."""

from __future__ import annotations

import math
from collections.abc import Sequence
from dataclasses import dataclass, replace

import numpy as np
import numpy.typing as npt

from mitransient_lidar.core.parameters.fields import AUTO, Read
from mitransient_lidar.core.validation import FloatArray, IntArray, require_memory
from mitransient_lidar.physics.lidar.level_sea import read_divergence

_GROWTH = 1.3  #: Ratio between the lengths of neighbouring cells outside the fine patch.

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

    `cells`: cells per side in the fine patch, even. `extent`: side of the whole mesh in these cells, at least `cells`.
    `growth`: ratio between the lengths of neighbouring cells outside the patch, above 1. `meshes`: number of such
    meshes made at a time.

    Result: symmetric about 0, one apart inside the patch; integers, so that all heights are points of the fine grid.
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

    Cells are split along the diagonal from (i+1, j) to (i, j+1), as `wave_spectrum.facet_slope_variance` assumes.

    `heights`: elevation [m], shape (len(y), len(x)). `x`, `y`: grid line positions [m], increasing. `wind_direction`:
    direction of the first texture coordinate [rad], counter-clockwise from +x.
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


#: Shortest wave, and sides of cell and patch without a lidar [m].
_DEFAULT_WAVE, _DEFAULT_CELL, _DEFAULT_SIZE = 1.0, 0.125, 32.0

#: Pixel sides per shortest wave, and limits of the shortest wave [m].
_PIXELS_PER_WAVE, _SMALLEST_WAVE, _LARGEST_WAVE = 4.0, 0.08, 2.0

#: Cells in a beam's shortest wave, fewer where the patch would have too many, and cells per pixel side.
_CELLS_PER_WAVE, _FEWEST_CELLS_PER_WAVE, _CELLS_PER_PIXEL = 12.0, 4.0, 2.0

_SMALLEST_CELL, _LARGEST_CELL = 0.02, 0.25  #: Limits for automatic cells [m].

#: Cells per side in an automatic patch above which waves have fewer cells, and largest number.
_MANY_CELLS, _MOST_CELLS = 512, 1024

#: Side of the patch: factor on the footprint, and margin [m] for scattered light.
_SIZE_PER_FOOTPRINT, SIZE_MARGIN = 1.25, 8.0

#: Side of the surface: least length [m], and factor on the footprints with the margin.
_LEAST_SURFACE, _SURFACE_PER_SIZE = 1000.0, 2.0

_BEAM_HALF_WIDTH = 3.0  #: Half angle of a beam, in standard deviations.
_DIVERGENCE, _FIELD_OF_VIEW = 10e-3, 30e-3  #: Full angles [rad] of beam and field of view unless they are given.


@dataclass(frozen=True)
class Footprint:
    """Footprint of a laser or a receiver on the sea."""

    aim: tuple[float, float]  #: Point where its axis meets the mean sea level [m].
    altitude: float  #: Height above the mean sea level [m].
    off_nadir: float  #: Angle of the axis from the vertical, at most 89.9 degrees [rad].
    is_laser: bool
    half_angle: float  #: Half of the full angle of the light or the field of view [rad].
    detail: float  #: Beam standard deviation, or pixel side [rad].

    @classmethod
    def laser(
        cls, aim: tuple[float, float], altitude: float, off_nadir: float, spreads: tuple[float, float]
    ) -> Footprint:
        """Return the footprint of a laser whose beam has the given narrowest and widest standard deviation [rad]."""
        narrow, wide = spreads
        return cls(aim, altitude, off_nadir, True, _BEAM_HALF_WIDTH * wide, narrow)

    @classmethod
    def receiver(
        cls, aim: tuple[float, float], altitude: float, off_nadir: float, field_of_view: float, pixel: float
    ) -> Footprint:
        """Return the footprint of a receiver from its full angle and typical pixel side [rad]."""
        return cls(aim, altitude, off_nadir, False, 0.5 * field_of_view, pixel)

    @property
    def wave(self) -> float:
        """Shortest wave that it needs [m]: the beam's standard deviation on the sea, or four pixels."""
        return self.altitude / math.cos(self.off_nadir) * self.detail * (1.0 if self.is_laser else _PIXELS_PER_WAVE)

    def cell(self, patch: float) -> float:
        """Return the cell side that it needs [m] in a patch with a side [m]."""
        if not self.is_laser:
            return self.wave / (_PIXELS_PER_WAVE * _CELLS_PER_PIXEL)
        return max(self.wave / _CELLS_PER_WAVE, min(self.wave / _FEWEST_CELLS_PER_WAVE, patch / _MANY_CELLS))

    @property
    def half_side(self) -> float:
        """Half the side of the square about the aim point that contains its footprint [m]."""
        half = min(self.half_angle, math.pi / 4)
        # Towards the horizon a footprint is unbounded; the square is limited to four times the horizontal range.
        tan = math.tan(self.off_nadir)
        far = min(math.tan(min(self.off_nadir + half, math.radians(89.9))), 4 * tan + 1)
        along = self.altitude * max(far - tan, tan - math.tan(self.off_nadir - half))
        return max(along, self.altitude / math.cos(self.off_nadir) * math.tan(half))


@dataclass(frozen=True)
class Resolution:
    """Position, sizes and cells of a sea [m]."""

    centre: tuple[float, float]  #: Position of the fine patch.
    cell_size: float  #: Largest cell side in the patch.
    refined_size: float  #: Patch side.
    size: float  #: Side of the whole surface.
    shortest_wave: float  #: Shortest wavelength.
    beam_wave: float  #: The shortest waves that the beam alone needs, not shorter than those.
    footprint: float  #: Side of the square of the footprints, and a quarter of it.

    @classmethod
    def read(cls, read: Read, footprints: Sequence[Footprint]) -> Resolution:
        """Read the parameters of the plugin ``ocean_surface``, and choose those that are ``auto``.

        Raises UserError if a value is not positive or out of range.

        `read`: parameter reader. `footprints`: footprints of the lasers and receivers above the sea. Values of the
        parameters ``altitude``, ``off_nadir_deg``, ``divergence_mrad`` (or another definition) and
        ``field_of_view_mrad`` replace theirs.
        """
        names = ("cell_size", "refined_size", "size", "shortest_wave")
        cell, side, size, wave = (None if value == AUTO else value for value in map(read, names))
        found = _with_own_values(read, footprints)
        areas = [_square(found), _square([each for each in found if each.is_laser] or found)]
        centre = tuple(
            automatic if value == AUTO else value
            for value, automatic in zip(map(read, ("centre_x", "centre_y")), areas[0][:2], strict=True)
        )
        everything, lit = (_SIZE_PER_FOOTPRINT * area[2] + SIZE_MARGIN for area in areas)
        size = size or max(_LEAST_SURFACE, _SURFACE_PER_SIZE * everything)
        waves, lit_waves = (
            min((each.wave for each in some), default=_DEFAULT_WAVE)
            for some in (found, [each for each in found if each.is_laser] or found)
        )
        # A beam must not lie within one facet.
        longest = min((each.wave for each in found if each.is_laser), default=math.inf)
        wanted = min((each.cell(side or everything) for each in found), default=_DEFAULT_CELL)
        wanted = min(wanted, math.inf if wave is None else wave / _CELLS_PER_WAVE)
        finest = cell or min(max(wanted, _SMALLEST_CELL), _LARGEST_CELL, longest)
        # Too many cells: the patch gives up the view beyond the beam, then cells grow, then the patch shrinks.
        patch = side or min(everything, max(lit, _MOST_CELLS * finest))
        cell = cell or max(finest, patch / _MOST_CELLS)
        if side is None and cell > longest:
            cell = max(finest, longest)
            patch = min(patch, _MOST_CELLS * cell)
        # The waves do not depend on the cells: finer cells show the same sea.
        own, beam = (wave or min(max(one, _SMALLEST_WAVE), _LARGEST_WAVE) for one in (waves, lit_waves))
        return cls((centre[0], centre[1]), cell, patch, size, own, beam, _SIZE_PER_FOOTPRINT * areas[0][2])


def _square(footprints: Sequence[Footprint]) -> tuple[float, float, float]:
    """Return centre (x, y) and side [m] of the square that holds the footprints."""
    if not footprints:
        return 0.0, 0.0, (_DEFAULT_SIZE - SIZE_MARGIN) / _SIZE_PER_FOOTPRINT
    low, high = (
        [pick(each.aim[axis] + sign * each.half_side for each in footprints) for axis in (0, 1)]
        for pick, sign in ((min, -1), (max, 1))
    )
    if len({each.aim for each in footprints}) == 1:
        return *footprints[0].aim, 2 * max(each.half_side for each in footprints)
    return 0.5 * (low[0] + high[0]), 0.5 * (low[1] + high[1]), max(high[0] - low[0], high[1] - low[1])


def _with_own_values(read: Read, footprints: Sequence[Footprint]) -> list[Footprint]:
    """Return the footprints with the values that the sea's own parameters give."""
    altitude, off_nadir, field = (read(name) for name in ("altitude", "off_nadir_deg", "field_of_view_mrad"))
    off_nadir = None if off_nadir is None else math.radians(off_nadir)
    field = None if field is None else 1e-3 * field
    divergence = read_divergence(read)
    found = list(footprints)
    if altitude is not None and not found:
        pose = (0.0, 0.0), altitude, math.radians(20.0)
        spread = 0.5 * _DIVERGENCE
        found = [Footprint.laser(*pose, (spread, spread)), Footprint.receiver(*pose, _FIELD_OF_VIEW, math.inf)]
    own = []
    for each in found:
        each = replace(each, altitude=altitude or each.altitude)
        each = each if off_nadir is None else replace(each, off_nadir=off_nadir)
        if each.is_laser and divergence is not None:
            spread = 0.5 * divergence
            each = Footprint.laser(each.aim, each.altitude, each.off_nadir, (spread, spread))
        elif not each.is_laser and field is not None:
            each = replace(each, half_angle=0.5 * field)
        own.append(each)
    return own
