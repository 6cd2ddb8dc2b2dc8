"""Shape plugin ``seabed``: a bottom with tilt, curvature, sand ripples or measured heights, and patches."""

from __future__ import annotations

import math
from collections.abc import Callable
from dataclasses import dataclass
from typing import Any

import mitsuba as mi
import numpy as np

from mitransient_lidar.core.errors import UserError
from mitransient_lidar.core.validation import FloatArray, finite, in_range, non_negative, positive
from mitransient_lidar.physics.sea.height_maps import HeightMap, read_height_map
from mitransient_lidar.physics.sea.sea_mesh import grid_indices, triangulate

#: Steepest tilt [deg] and steepest ripples, height over length: with either alone no facet is steeper than 45 degrees.
_STEEPEST_TILT, _STEEPEST_RIPPLE = 45.0, 0.3

#: Most cells a side of the fine square: 8 million triangles.
_MOST_CELLS = 2048

#: Longest cell [m] that is chosen, and cells in the length of a ripple and in the radius of a patch.
_LARGEST_CELL, _CELLS_PER_RIPPLE, _CELLS_PER_RADIUS = 0.25, 8.0, 8.0

#: A ripple of fewer cells than this is not there.
_FEWEST_CELLS_PER_RIPPLE = 4.0

#: Side of the fine square where neither a height map nor patches tell it [m].
_DEFAULT_SIZE = 20.0

#: Name of the mesh attribute that holds the reflectance.
REFLECTANCE = "vertex_reflectance"

Get = Callable[[str, Any], Any]


@dataclass(frozen=True)
class Patch:
    """Disc of another reflectance: middle [m], radius [m], reflectance 0 to 1."""

    x: float
    y: float
    radius: float
    reflectance: float

    def reach(self, centre: tuple[float, float]) -> float:
        """Return half the side of the square about a centre that holds it [m]."""
        return max(abs(self.x - centre[0]), abs(self.y - centre[1])) + self.radius


@dataclass(frozen=True)
class Bottom:
    """Height and reflectance of a bottom.

    Attributes
    ----------
    depth
        Depth at x = y = 0 of the plane that everything else is added to [m].
    slope
        Rise of that plane along x and y [m/m].
    curvature
        Curvature of the bowl (positive) or mound (negative) about the middle [1/m].
    ripple_height, ripple_length, ripple_bearing
        Sand ripples, trough to crest [m], crest to crest [m], and direction across the crests [rad].
    terrain
        Height map that is added, if any.
    centre, refined_size, cell_size, size
        Middle of the fine square [m], its side [m], the side of its cells [m] (infinite for a plane), and the side of
        the whole [m].
    reflectance, patches
        Lambertian reflectance, and discs in which it is another; where they overlap the last one counts.
    """

    depth: float
    slope: tuple[float, float]
    curvature: float
    ripple_height: float
    ripple_length: float
    ripple_bearing: float
    terrain: HeightMap | None
    centre: tuple[float, float]
    refined_size: float
    cell_size: float
    size: float
    reflectance: float
    patches: tuple[Patch, ...]

    @classmethod
    def read(cls, get: Get) -> Bottom:
        """Read the parameters of the plugin.

        Raises
        ------
        UserError
            If a parameter lies outside its range, the height map cannot be read, cells are too coarse or too many,
            or the bottom lies above the sea in its middle.
        """
        path, map_size = get("filename", ""), get("map_size", None)
        if map_size is not None and not path:
            raise UserError(f"map_size = {map_size} needs a height map: give its filename")
        terrain = read_height_map(path, map_size) if path else None
        # A map may count its heights from the sea level.
        depth = (positive if terrain is None else non_negative)("depth", get("depth", 8.0))
        slope = tuple(
            math.tan(math.radians(in_range(name, get(name, 0.0), -_STEEPEST_TILT, _STEEPEST_TILT)))
            for name in ("slope_x_deg", "slope_y_deg")
        )
        ripple_height = non_negative("ripple_height", get("ripple_height", 0.0))
        ripple_length = positive("ripple_length", get("ripple_length", 0.2))
        if ripple_height > _STEEPEST_RIPPLE * ripple_length:
            raise UserError(
                f"ripple_height = {ripple_height:g} must be at most {_STEEPEST_RIPPLE:g} of ripple_length = "
                f"{ripple_length:g}"
            )
        patches = read_patches(get("patches", ""))
        middle, widest = (0.0, 0.0), _DEFAULT_SIZE
        if terrain is not None:
            middle = (float(terrain.x[0] + terrain.x[-1]) / 2, float(terrain.y[0] + terrain.y[-1]) / 2)
            widest = float(max(terrain.x[-1] - terrain.x[0], terrain.y[-1] - terrain.y[0]))
        centre = finite("centre_x", get("centre_x", middle[0])), finite("centre_y", get("centre_y", middle[1]))
        widest = max([widest, *(2 * patch.reach(centre) for patch in patches)])
        curvature = in_range("curvature", get("curvature", 0.0), -1.0, 1.0)
        chosen = _largest_cell(terrain, curvature, ripple_length if ripple_height > 0 else None, patches)
        cell, refined_size = _length(get, "cell_size"), _length(get, "refined_size")
        bottom = cls(
            depth,
            (slope[0], slope[1]),
            curvature,
            ripple_height,
            ripple_length,
            math.radians(finite("ripple_bearing_deg", get("ripple_bearing_deg", 0.0))),
            terrain,
            centre,
            refined_size or widest,
            cell or chosen,
            positive("size", get("size", 1000.0)),
            in_range("reflectance", get("reflectance", 0.1), 0.0, 1.0),
            patches,
        )
        bottom._check()
        return bottom

    def _check(self) -> None:
        """Refuse cells that are too coarse or too many, patches beyond them, and a bottom above the sea."""
        if self.refined_size / self.cell_size > _MOST_CELLS:
            raise UserError(
                f"refined_size = {self.refined_size:g} with cell_size = {self.cell_size:g} needs "
                f"{self.refined_size / self.cell_size:.0f} "
                f"cells a side: allowed are {_MOST_CELLS}"
            )
        if self.ripple_height > 0 and self.cell_size > self.ripple_length / _FEWEST_CELLS_PER_RIPPLE:
            raise UserError(
                f"cell_size = {self.cell_size:g} must be at most a quarter of ripple_length = {self.ripple_length:g}"
            )
        for number, patch in enumerate(self.patches, 1):
            reach = patch.reach(self.centre)
            if reach > self.refined_size / 2:
                raise UserError(
                    f"patches: number {number} reaches {reach:g} m from ({self.centre[0]:g}, {self.centre[1]:g}), but "
                    f"must lie within the fine square of refined_size = {self.refined_size:g}"
                )
        height = float(self.heights(*(np.array([value]) for value in self.centre))[0, 0])
        if height >= 0:
            raise UserError(
                f"depth = {self.depth:g} puts the bottom at z = {height:.3g} m in its middle, "
                f"({self.centre[0]:g}, {self.centre[1]:g}): it must lie below the sea there"
            )

    def lines(self) -> tuple[FloatArray, FloatArray]:
        """Return the grid lines x and y [m]: the fine square, and around it cells that grow out to the size."""
        if not math.isfinite(self.cell_size):
            edges = 0.5 * np.array([-self.size, self.size])
            return edges + self.centre[0], edges + self.centre[1]
        cells = max(2, 2 * math.ceil(0.5 * self.refined_size / self.cell_size))
        ticks = grid_indices(cells, math.ceil(self.size / self.cell_size)).astype(np.float64) * self.cell_size
        return ticks + self.centre[0], ticks + self.centre[1]

    def heights(self, x: FloatArray, y: FloatArray) -> FloatArray:
        """Return elevations [m] on grid lines x and y [m], shape (len(y), len(x))."""
        east, north = np.meshgrid(x, y)
        heights = self.slope[0] * east + self.slope[1] * north - self.depth
        # Beyond the fine square the bowl ends, lest it rise to the sky.
        radius = np.hypot(east - self.centre[0], north - self.centre[1])
        heights += 0.5 * self.curvature * np.minimum(radius, self.refined_size / 2) ** 2
        across = east * math.cos(self.ripple_bearing) + north * math.sin(self.ripple_bearing)
        heights += 0.5 * self.ripple_height * np.cos(2 * math.pi * across / self.ripple_length)
        if self.terrain is not None:
            heights += self.terrain.sample(x, y)
        return np.asarray(heights, dtype=np.float64)

    def reflectances(self, x: FloatArray, y: FloatArray) -> FloatArray:
        """Return the reflectance on grid lines x and y [m], shape (len(y), len(x))."""
        east, north = np.meshgrid(x, y)
        values = np.full(east.shape, self.reflectance)
        for patch in self.patches:
            # Blurred over a cell: a sharp edge on grid points would miss the disc's area by percents.
            inside = (patch.radius - np.hypot(east - patch.x, north - patch.y)) / self.cell_size + 0.5
            values += np.clip(inside, 0, 1) * (patch.reflectance - values)
        return values


def read_patches(text: str) -> tuple[Patch, ...]:
    """Read patches from text.

    Parameters
    ----------
    text
        ``x y radius reflectance`` of each patch, in metres and 0 to 1, separated by semicolons.

    Returns
    -------
    tuple of Patch

    Raises
    ------
    UserError
        If a patch has not four numbers, a radius that is not positive, or a reflectance outside 0 to 1.
    """
    patches = []
    for number, part in enumerate((part for part in str(text).split(";") if part.strip()), 1):
        words = part.replace(",", " ").split()
        if len(words) != 4:
            raise UserError(f"patches: {part.strip()!r} must be four numbers, x y radius reflectance")
        names = ("x", "y", "radius", "reflectance")
        x, y, radius, value = (
            finite(f"patches: {name} of number {number}", word) for name, word in zip(names, words, strict=True)
        )
        positive(f"patches: radius of number {number}", radius)
        in_range(f"patches: reflectance of number {number}", value, 0.0, 1.0)
        patches.append(Patch(x, y, radius, value))
    return tuple(patches)


def _largest_cell(
    terrain: HeightMap | None, curvature: float, ripple_length: float | None, patches: tuple[Patch, ...]
) -> float:
    """Return the side of the cells that a bottom needs [m], infinite for a plane of one reflectance."""
    wanted = [patch.radius / _CELLS_PER_RADIUS for patch in patches]
    if ripple_length is not None:
        wanted.append(ripple_length / _CELLS_PER_RIPPLE)
    if terrain is not None:
        wanted.append(float(min(terrain.x[1] - terrain.x[0], terrain.y[1] - terrain.y[0])))
    elif wanted or curvature != 0:
        wanted.append(_LARGEST_CELL)
    return min(wanted, default=math.inf)


def _length(get: Get, name: str) -> float | None:
    """Return a positive length [m], or None where it is ``auto``."""
    value = get(name, "auto")
    return None if value == "auto" else positive(name, value)


class Seabed(mi.Mesh):
    r"""Bottom of the sea (``seabed``).

    ========================  ======  ==================================================================================
    Parameter                 Type    Meaning
    ========================  ======  ==================================================================================
    depth                     float   Depth at x = y = 0 [m], greater than 0. Default: 8
    slope_x_deg, slope_y_deg  float   Tilt, -45 to 45 [deg]: positive where the bottom rises towards +x, +y. Default: 0
    curvature                 float   Curvature of a bowl about the middle, -1 to 1 [1/m], negative for a mound; it ends
                                      half of ``refined_size`` from the middle. Default: 0
    ripple_height             float   Height of sand ripples, trough to crest [m], at most 0.3 of their length; 0 for
                                      none. Default: 0
    ripple_length             float   Distance of their crests [m]. Default: 0.2
    ripple_bearing_deg        float   Direction across the crests, from +x to +y [deg]. Default: 0
    filename                  string  Height map that is added (.npy, .npz, .exr or .nc). Where its heights are those
                                      above the mean sea level, give ``depth`` 0
    map_size                  float   Side along x of a height map that carries no positions [m]
    reflectance               float   Lambertian reflectance, 0 to 1. Default: 0.1
    patches                   string  Discs of another reflectance, ``"x y radius reflectance; ..."`` in metres and 0 to
                                      1; where they overlap the last one counts. Default: none
    centre_x, centre_y        float   Middle of the finely resolved square [m]. Default: 0, or the map's middle
    refined_size              float   Its side [m], or ``auto``: 20 m, or the map's longer side, or more for the
                                      patches. Default: ``auto``
    cell_size                 float   Side of its cells [m], or ``auto``: an eighth of the ripples' length, an eighth of
                                      the smallest patch's radius, the map's own or 0.25 m, whichever is least. Default:
                                      ``auto``
    size                      float   Side of the whole bottom [m]: cells grow outside the square. Default: 1000
    (nested)                  bsdf    Any BSDF instead of the Lambertian one
    ========================  ======  ==================================================================================

    The parts add up: at (x, y), with r from the middle,

    .. math:: z = -d + x \tan\alpha_x + y \tan\alpha_y + \tfrac{1}{2} C r^2
              + \tfrac{1}{2} h \cos(2\pi (x \cos\beta + y \sin\beta) / L) + z_\text{map}(x, y).

    A bottom without curvature, ripples, map and patches is two triangles. A patch's edge is blurred over one cell.
    The reflectance is a mesh attribute, ``vertex_reflectance``, which a nested BSDF may use through Mitsuba's
    ``mesh_attribute`` texture.

    A slope rises through the sea somewhere: within ``size`` that is a shore, which costs time as light is then also
    traced in the air beside it; a smaller size leaves it out. Where the receiver looks it is refused on rendering.

    .. code-block:: xml

        <shape type="seabed">
            <float name="depth" value="8"/>
            <float name="slope_x_deg" value="3"/>
            <string name="patches" value="0 0 1 0.3; 2 1 0.5 0.02"/>
        </shape>

    .. code-block:: python

        {'type': 'seabed', 'depth': 8.0, 'ripple_height': 0.03, 'ripple_length': 0.2}
    """

    def __init__(self, props: mi.Properties) -> None:
        #: Its height and reflectance.
        self.bottom = Bottom.read(props.get)
        if not any(isinstance(child, mi.BSDF) for _, child in props.objects()):
            texture = {"type": "mesh_attribute", "name": REFLECTANCE}
            props["reflection"] = mi.load_dict({"type": "diffuse", "reflectance": texture})
        props["face_normals"] = True
        x, y = self.bottom.lines()
        mesh = triangulate(self.bottom.heights(x, y), x, y, 0.0)
        super().__init__("seabed", len(mesh.vertices), len(mesh.faces), props, has_vertex_texcoords=True)
        self.add_attribute(REFLECTANCE, 1, self.bottom.reflectances(x, y).ravel().tolist())
        buffers = mi.traverse(self)
        buffers["vertex_positions"] = mi.Float(mesh.vertices.ravel())
        buffers["vertex_texcoords"] = mi.Float(mesh.texcoords.ravel())
        buffers["faces"] = mi.UInt32(mesh.faces.ravel())
        buffers.update()
        self.initialize()

    def to_string(self) -> str:
        """Return a description."""
        bottom = self.bottom
        return (
            f"Seabed[depth={bottom.depth:g} m, slope=({bottom.slope[0]:.3g}, {bottom.slope[1]:.3g}), "
            f"patch of {bottom.refined_size:g} m in cells of {bottom.cell_size:g} m, size={bottom.size:g} m, "
            f"faces={self.face_count()}, patches={len(bottom.patches)}]"
        )


mi.register_shape("seabed", lambda props: Seabed(props))
