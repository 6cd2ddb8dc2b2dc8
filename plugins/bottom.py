"""Shape plugins: a bottom with tilt, ripples or measured heights (``seabed``), and plants on it (``canopy``)."""

from __future__ import annotations

import logging
import math
from dataclasses import dataclass

import mitsuba as mi
import numpy as np

from mitransient_lidar.core.errors import UserError
from mitransient_lidar.core.parameters.bottom import CANOPY, SEABED
from mitransient_lidar.core.parameters.fields import AUTO, Read
from mitransient_lidar.core.validation import BoolArray, FloatArray, finite, in_range, positive
from mitransient_lidar.physics.plants import Canopy, leaf_triangles
from mitransient_lidar.physics.sea.height_maps import HeightMap, map_origin, read_height_map
from mitransient_lidar.physics.sea.sea_mesh import SeaMesh, grid_indices, triangulate
from mitransient_lidar.plugins.bases import DeclaredProperties, fill_mesh, register
from mitransient_lidar.transport.medium.water_phases import create_object

logger = logging.getLogger(__name__)

#: Steepest ripples, height over length, so that facets are at most at 45 degrees, as with the steepest tilt.
_STEEPEST_RIPPLE = 0.3

_MOST_CELLS = 2048  #: Largest number of cells per side of the fine square: 8 million triangles.

#: Longest default cell [m], and cells per ripple length and per patch radius.
_LARGEST_CELL, _CELLS_PER_RIPPLE, _CELLS_PER_RADIUS = 0.25, 8.0, 8.0

_FEWEST_CELLS_PER_RIPPLE = 4.0  #: Fewest cells that resolve a ripple.
_DEFAULT_SIZE = 20.0  #: Side of the fine square without height map and patches [m].
REFLECTANCE = "vertex_reflectance"  #: Mesh attribute: reflectance.


@dataclass(frozen=True)
class Patch:
    """Disc of another reflectance, 0 to 1: centre [m] and radius [m]."""

    x: float
    y: float
    radius: float
    reflectance: float

    def reach(self, centre: tuple[float, float]) -> float:
        """Return half the side of the square about a centre that contains the disc [m]."""
        return max(abs(self.x - centre[0]), abs(self.y - centre[1])) + self.radius


class Bottom:
    """Height and reflectance of a bottom, with the `Seabed` parameters as attributes.

    Raises UserError if a parameter lies outside its range, the height map cannot be read, or cells are too coarse or
    too many.
    """

    def __init__(self, read: Read) -> None:
        self.terrain, self.values_given = _read_terrain(read), read("map_values") is not None
        depth = read("depth", 8.0 if self.terrain is None else 0.0)
        self.depth = depth if self.terrain is not None else positive("depth", depth)
        #: Rise along x and y [m/m].
        self.slope = tuple(math.tan(math.radians(read(name))) for name in ("slope_x_deg", "slope_y_deg"))
        self.ripple_height, self.ripple_length = read("ripple_height"), read("ripple_length")
        if self.ripple_height > _STEEPEST_RIPPLE * self.ripple_length:
            raise UserError(
                f"ripple_height = {self.ripple_height:g} must be at most {_STEEPEST_RIPPLE:g} of ripple_length = "
                f"{self.ripple_length:g}"
            )
        self.patches = _read_patches(read("patches"))
        middle, widest = (0.0, 0.0), _DEFAULT_SIZE
        if self.terrain is not None:
            x, y = self.terrain.x, self.terrain.y
            widest = float(max(x[-1] - x[0], y[-1] - y[0]))
            # A part of a map in map coordinates lies about its origin.
            if self.terrain.origin is None or read("refined_size") == AUTO:
                middle = float(x[0] + x[-1]) / 2, float(y[0] + y[-1]) / 2
        self.centre = read("centre_x", middle[0]), read("centre_y", middle[1])
        widest = max([widest, *(2 * patch.reach(self.centre) for patch in self.patches)])
        self.curvature = read("curvature")
        #: Cell side [m], infinite for a plane.
        cell, side = read("cell_size"), read("refined_size")
        self.cell_size = self._largest_cell() if cell == AUTO else cell
        self.refined_size = widest if side == AUTO else side
        #: Direction across the crests [rad].
        self.ripple_bearing = math.radians(read("ripple_bearing_deg"))
        self.size = read("size")
        self.reflectance = read("reflectance")
        self._check()

    def _largest_cell(self) -> float:
        """Return the cell side that the bottom needs [m], infinite for a plane with one reflectance."""
        wanted = [patch.radius / _CELLS_PER_RADIUS for patch in self.patches]
        if self.ripple_height > 0:
            wanted.append(self.ripple_length / _CELLS_PER_RIPPLE)
        if self.terrain is not None:
            x, y = self.terrain.x, self.terrain.y
            wanted.append(float(min(x[1] - x[0], y[1] - y[0])))
        elif wanted or self.curvature != 0:
            wanted.append(_LARGEST_CELL)
        return min(wanted, default=math.inf)

    def _check(self) -> None:
        """Refuse too coarse or too many cells, and patches beyond them; warn about a map of land alone."""
        cells = self.refined_size / self.cell_size
        if cells > _MOST_CELLS:
            raise UserError(
                f"refined_size = {self.refined_size:g} with cell_size = {self.cell_size:g} needs {cells:.0f} "
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
        if self.terrain is not None and not self.values_given and (lowest := self.terrain.heights.min()) > self.depth:
            logger.warning(
                "the map of the seabed is land alone, from %.3g m above the sea on: map_values = depths would put it "
                "below, and map_values = heights says that it is land",
                lowest - self.depth,
            )

    def lines(self) -> tuple[FloatArray, FloatArray]:
        """Return the grid lines x and y [m]: the fine square, and growing cells around it."""
        if not math.isfinite(self.cell_size):
            ticks = 0.5 * np.array([-self.size, self.size])
        else:
            cells = max(2, 2 * math.ceil(0.5 * self.refined_size / self.cell_size))
            ticks = grid_indices(cells, math.ceil(self.size / self.cell_size)).astype(np.float64) * self.cell_size
        return ticks + self.centre[0], ticks + self.centre[1]

    def heights(self, x: FloatArray, y: FloatArray) -> FloatArray:
        """Return elevations [m] on grid lines x and y [m], shape (len(y), len(x))."""
        east, north = np.meshgrid(x, y)
        heights = self.slope[0] * east + self.slope[1] * north - self.depth
        # The bowl ends at the fine square, so that it does not rise through the sea.
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
            # Blurred over a cell: a sharp edge on grid points would give a wrong area.
            inside = (patch.radius - np.hypot(east - patch.x, north - patch.y)) / self.cell_size + 0.5
            values += np.clip(inside, 0, 1) * (patch.reflectance - values)
        return values


def _read_terrain(read: Read) -> HeightMap | None:
    """Read the height map, if there is one."""
    path = read("filename", "")
    names = ("map_size", "origin_x", "origin_y", "map_values", "map_holes", "map_cell", "map_unit", "map_no_data")
    given = size, _, _, values, holes, cell, unit, no_data = tuple(map(read, names))
    if not path:
        for name, value in zip(names, given, strict=True):
            if value is not None:
                raise UserError(f"{name} = {value} needs a height map: give its filename")
        return None
    return read_height_map(path, size, map_origin(read), values, holes or "refuse", cell, unit, no_data)


def _read_patches(text: str) -> tuple[Patch, ...]:
    """Read patches from ``x y radius reflectance; ...``."""
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


@register("shape", SEABED)
class Seabed(mi.Mesh):
    r"""Bottom of the sea (``seabed``).

    .. parameters::

    The height at (x, y), at a distance r from the centre, is

    .. math:: z = -d + x \tan\alpha_x + y \tan\alpha_y + \tfrac{1}{2} C r^2
              + \tfrac{1}{2} h \cos(2\pi (x \cos\beta + y \sin\beta) / L) + z_\text{map}(x, y).

    Points x, y, z [m] are columns with these names or the first three. Points on an even grid are its cells where at
    least a quarter of the cells have one. Other points are triangulated (Delaunay). The height is linear in each
    triangle, :math:`z_\text{map} = \sum_i \lambda_i z_i` with the barycentric coordinates :math:`\lambda_i`. The grid
    has the cell :math:`\sqrt{A/N}` for N points in a convex hull with the area A. Cells outside the hull are holes;
    inside it, triangles also cross gaps between lines of points.

    A bottom without curvature, ripples, map and patches is two triangles. A patch's edge is blurred over one cell.
    The reflectance is a mesh attribute, ``vertex_reflectance``, which a nested BSDF may use through Mitsuba's
    ``mesh_attribute`` texture.

    Where the bottom rises through the sea it is land, with the same reflectance dry and wet. The sea ends where it
    meets the bottom. Dry land of another reflectance is a patch, or another shape. Land within ``size`` takes time, as
    light is then also traced in the air; a smaller size leaves it out.

    .. example::

        {'type': 'seabed', 'depth': 8.0, 'slope_x_deg': 3.0, 'patches': '0 0 1 0.3; 2 1 0.5 0.02'}
    """

    def __init__(self, props: DeclaredProperties) -> None:
        self.bottom = Bottom(props.read)
        if not any(isinstance(child, mi.BSDF) for _, child in props.objects()):
            props["reflection"] = create_object(
                "diffuse", reflectance=create_object("mesh_attribute", name=REFLECTANCE)
            )
        props["face_normals"] = True
        x, y = self.bottom.lines()
        at_x, at_y = props.frame_origin[:2]
        mesh = triangulate(self.bottom.heights(x, y), x - at_x, y - at_y, 0.0)
        super().__init__("seabed", len(mesh.vertices), len(mesh.faces), props, has_vertex_texcoords=True)
        self.add_attribute(REFLECTANCE, 1, self.bottom.reflectances(x, y).ravel().tolist())
        fill_mesh(self, mesh)

    @property
    def used_values(self) -> dict[str, float]:
        """Values used for parameters that may be automatic [m]; empty for a plane, which has no cells."""
        bottom = self.bottom
        fine = {"cell_size": bottom.cell_size, "refined_size": bottom.refined_size}
        return fine if math.isfinite(bottom.cell_size) else {}

    @property
    def uniform_reflectance(self) -> float | None:
        """Reflectance of bottom and patches, None where they differ."""
        values = {self.bottom.reflectance, *(patch.reflectance for patch in self.bottom.patches)}
        return float(values.pop()) if len(values) == 1 else None

    @property
    def height_map(self) -> HeightMap | None:
        """Bottom height map; None without one."""
        return self.bottom.terrain

    def is_beyond_map(self, x: FloatArray, y: FloatArray) -> BoolArray:
        """Return whether places [m] lie beyond the height map; nowhere without one."""
        terrain = self.bottom.terrain
        return np.zeros(np.shape(x), dtype=bool) if terrain is None else ~terrain.covers(x, y)


@register("shape", CANOPY)
class CanopyShape(mi.Mesh):
    r"""Plants on a bottom (``canopy``).

    .. parameters::

    Each leaf is a flat rectangle of two triangles. ``blades`` stand on the bottom, as seagrass does, lean by
    ``bending_deg`` and face any way. ``leaves`` are squares that look in all directions alike, everywhere in the layer:
    a turbid layer with leaves of any size. Light passes plants unhindered at the angle :math:`\theta` from the vertical
    with the probability

    .. math:: P = e^{-G\,L / \cos\theta}, \quad G = \tfrac{1}{2} \text{ for leaves}, \quad
              G = \tfrac{2}{\pi} \overline{\sin\gamma} \text{ for blades at the angle } \gamma \text{ to the light},

    with the leaf area index *L* (Nilson 1971, doi:10.1016/0002-1571(71)90092-6). Laser and receiver look through the
    same gaps. The direct bottom echo is thus weakened by :math:`P`, not :math:`P^2`, unless sea ripples part the paths
    of light and view by a gap's width.

    So that gaps stay open for both, ``lidar_merging`` connects the solids in a scene with plants to the laser, instead
    of merging light on them (its parameter ``solids``).

    Plants stand in a square, on the level ``depth``, or on a ``seabed`` to which a reference is nested, as
    ``<ref id="bottom"/>`` in the scene ``seagrass``.

    .. example::

        {'type': 'canopy', 'depth': 5.0, 'leaf_area_index': 1.5, 'height': 0.8}
    """

    #: Solids of a scene with it are not merged (`WaterScene.has_shared_gaps`).
    shares_gaps = True

    def __init__(self, props: DeclaredProperties) -> None:
        read = props.read
        form = read("form")
        leaning, azimuth = read("bending_deg"), read("bending_azimuth_deg")
        if form == "leaves":
            for name in ("bending_deg", "bending_azimuth_deg", "shoot_density"):
                if name in props:
                    raise UserError(f"{name} = {props[name]:g} needs blades: form = 'leaves' has none")
        #: The plants.
        self.canopy = Canopy(
            read("leaf_area_index"),
            read("height"),
            read("leaf_width"),
            math.radians(leaning) if form == "blades" else None,
            None if azimuth is None else math.radians(azimuth),
            read("shoot_density"),
        )
        grounds = [child for _, child in props.objects() if isinstance(child, mi.Shape)]
        feet, width, length = self.canopy.leaves(read("size"), read("seed"))
        feet[:, :2] += read("centre_x"), read("centre_y")
        feet[:, 2] += _ground(props, grounds, feet)
        if (highest := float((feet[:, 2] + np.maximum(length[:, 2], 0)).max())) > 0:
            raise UserError(
                f"height = {self.canopy.height:g} of plants lets them rise to z = {highest:.3g} m: they must end below "
                "the mean sea level"
            )
        if not any(isinstance(child, mi.BSDF) for _, child in props.objects()):
            props["leaf"] = create_object("leaf", reflectance=read("reflectance"), transmittance=read("transmittance"))
        props["face_normals"] = True
        vertices, faces = leaf_triangles(feet - props.frame_origin, width, length)
        super().__init__("canopy", len(vertices), len(faces), props, has_vertex_texcoords=True)
        fill_mesh(self, SeaMesh(vertices, faces.astype(np.uint32), np.zeros((len(vertices), 2))))


def _ground(props: DeclaredProperties, grounds: list[mi.Shape], feet: FloatArray) -> FloatArray:
    """Return the heights of the bottom below places [m], shape (n,)."""
    if not grounds:
        return np.full(len(feet), -props.read("depth"))
    bottom = getattr(grounds[0], "bottom", None)
    if len(grounds) > 1 or bottom is None:
        names = ", ".join(repr(shape.id()) for shape in grounds)
        raise UserError(f"canopy: the nested shape must be one seabed, not {names}")
    from scipy.interpolate import RegularGridInterpolator

    x, y = bottom.lines()
    return np.asarray(RegularGridInterpolator((y, x), bottom.heights(x, y))(feet[:, 1::-1]))
