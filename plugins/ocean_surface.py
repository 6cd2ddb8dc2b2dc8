"""Shape plugin ``ocean_surface``: a sea with waves, swell and wakes."""

from __future__ import annotations

import dataclasses
from collections.abc import Callable, Iterable, Sequence
from typing import Any

import mitsuba as mi
import numpy as np

from mitransient_lidar.core.errors import UserError
from mitransient_lidar.core.parameters.sea import OCEAN_SURFACE
from mitransient_lidar.core.validation import FloatArray
from mitransient_lidar.physics.sea.cox_munk import GramCharlierSeries, foam_whiteness
from mitransient_lidar.physics.sea.sea_mesh import SIZE_MARGIN, Footprint, Resolution
from mitransient_lidar.physics.sea.sea_surface import SeaSurface, followed_depths
from mitransient_lidar.physics.sea.shoaling import BottomDepths, ShoalingHeights
from mitransient_lidar.plugins.bases import FOAM, DeclaredProperties, fill_mesh, register
from mitransient_lidar.transport.medium.water_phases import create_object
from mitransient_lidar.transport.plugin_types import WaterMedium

#: Parameter of the loader: whether the mesh is a level plane until `OceanSurface.fit` gets the lidar.
WAITS = "_waits"

#: Margin of where rays meet the waves [m], heights of waves at any time over those of the mesh, and angle of the rays
#: from the vertical up to which the margin grows [rad].
_MET_MARGIN, _WAVES_PER_MESH, _STEEPEST = 0.5, 1.5, 1.3

#: Mesh buffers that `OceanSurface.fit` makes anew.
_BUFFERS = {"faces", "vertex_positions", "vertex_normals", "vertex_texcoords"}


@register("shape", OCEAN_SURFACE)
class OceanSurface(mi.Mesh):
    r"""Sea surface with waves of wind and swell, or from a height map (``ocean_surface``).

    .. parameters::

    The automatic shortest wave is the beam's standard deviation on the sea or, if shorter, four pixels, 0.08 to 2 m. It
    does not depend on the cells. Automatic cells are a twelfth of that standard deviation and at most half a pixel's
    side, 0.02 to 0.25 m. The patch contains beam and field of view with a margin of 8 m. Where it would have more than
    512 cells per side, the beam's cells grow up to a quarter of its standard deviation. With more than 1024 the patch
    is limited to the beam, and then the cells grow, within the footprint. A scene without a lidar has 32 m in cells of
    0.125 m, with waves from 1 m. The choice is made when the scene is rendered, or loaded by ``mitransient_lidar``.

    Waves are linear: independent, with Gaussian heights and slopes, without the sharper crests of real waves. The mesh
    represents the waves from the shortest one up. The rest of the total slope variance, along and across the wind, is
    an anisotropic Beckmann ``roughdielectric`` with :math:`\alpha = \sqrt{2}\,\sigma`, the model for Gaussian slopes.
    Its index is the water's ``refractive_index``. Texture coordinates run along and across the wind. With ``cox_munk``
    and ``spectrum`` the total depends neither on the cells nor on the shortest wave. The ripple variance is at least
    1e-5, so that a point laser can be connected. The loaded object's `slope_variance` is the total. A mesh needs waves
    shorter than a sixteenth of the period: where automatic cells are longer, all slopes are ripples.

    Real slopes are skewed and peaked. With ``slope_distribution`` ``gram_charlier`` the ripples are a
    ``gram_charlier_dielectric``. Their third and fourth moments let waves and ripples together reach Cox and Munk's
    slope density. At 20 degrees off nadir and 6 m/s it is 1.19 times the Gaussian density looking upwind and 0.74
    downwind. At 10 m/s it is 0.95 and 0.87 times, and 1.11 at nadir. It was measured up to 2.5 standard deviations,
    with standard errors of 0.03 (c21), 0.12 (c03), 0.23 (c40), 0.06 (c22) and 0.41 (c04). Ripples with a small share of
    the slope variance (below 0.3 to 0.4, at 14 m/s 0.6) would need negative densities, and are refused. Narrow beams,
    which resolve short waves, then need a longer ``shortest_wave``.

    Finer cells show the same waves with smoother facets. Halving automatic cells changes the surface echo by less than
    a render's default error, 3 %. The shortest wave divides the sea into waves, drawn by the seed, and ripples, the
    mean over all shorter waves. The mean echo over many seas does not depend on it; the echo at one location does.
    Changes in the echo of a 10 mrad beam from 200 m, rms over 64 locations:

    ===============  ===========================  ==========================================
    Angle            0, 10, 20 deg: cells halved  0, 10, 20 deg: shortest wave halved
    ===============  ===========================  ==========================================
    wind of 3 m/s    0.1, 0.2, 1.6 %              3, 6, 57 % (few steep waves return light)
    wind of 6 m/s    0.1, 0.1, 0.3 %              2, 4, 20 %
    wind of 10 m/s   0.1, 0.1, 0.1 %              1, 1, 5 %
    ===============  ===========================  ==========================================

    Light also returns from the water through the waves that focused it on its way down. The mesh shows this for its own
    waves; ripples are drawn anew on each way. With ``ripple_focusing``, light that crosses the sea twice is multiplied
    by a mean enhancement: correlated ripples against independent ones. It depends on the echo's depth and on the number
    of scattering events, as each moves one way against the other (`mitransient_lidar.physics.sea.double_passage`). At 3
    m/s, with waves from 1.06 m, it is 2.2, 1.5 and 1.1 at 1, 3 and 8 m for unscattered light. After one forward
    scattering event it is 1.25, 1.15 and 1.04. At 6 and 10 m/s it is 1.4 and 1.2 at 1 m. With it the ``table1`` echoes
    agree within 4 % from 0.5 m to the bottom for waves from 1.06, 0.25 and 0.12 m. Without it the shortest ones give
    16, 23, 20 and 11 % more at 1, 2, 3 and 5 m. One location has the mean, without its own ripple pattern. It depends
    on centimetre waves, which slicks lack. Above half a metre, where it would grow, few data exist, and depths are
    within the waves: it falls to 1 at the surface. Seas without a ripple spectrum (``flat``, ``height_map``) and lidars
    under water have none. Give ``shortest_wave`` to compare images with few-pixel receivers on exactly the same sea.

    With more than 1024 of the shortest waves (or pairs of cells) per period, the waves are a sum of bands. The longest
    waves equal the waves in coarse cells. Each band of shorter ones repeats after an odd fraction (1/3 to 1/31) of the
    previous period.

    Over a shallow bottom (``shoaling``) waves are divided into bands of half an octave, each with the TMA spectrum's
    amplitude at the local depth. The significant height is at most half the depth, as the longest waves are lost, and
    all waves end at the water line. Ripples stay. The depth is the depth of the largest solids under each vertex: their
    rendered faces, without instances, targets and piers, continued beyond their edges. At 10 m/s over 0.3 m the waves
    have a significant height of 0.15 m instead of 2.6 m. Crests neither turn nor come closer together, and do not run
    up the shore. Wake heights stay within a quarter of the depth; a mean slope stays as given.

    Foam (``foam``) covers whole faces. It is a thin layer that reflects ``foam_reflectance`` from above and from below.
    It transmits ``foam_transmittance`` as a ``leaf`` does. Both are even over all directions. It absorbs the rest. It
    lies where the waves rise most above their surroundings within 2 m, and thus follows the crests of short waves, as
    many as give the cover. On a sea without waves each face has the cover as a share. Foam approaches ``surf_foam``
    where the depth limits the waves. A ``foam_map`` states where foam lies besides.

    A mean slope turns the sea about the patch centre, or about each shot's location in a series. It is as wide as the
    patch; beyond it the sea is level. It adds to the wave slopes, and not to ``slope_variance``.

    Outside the patch the facets are longer and resolve fewer slopes, with the ripples of the patch, for light that has
    scattered far. Light beyond ``size`` is lost and reported after rendering.

    Edits by ``mi.traverse`` act; mesh edits act after the first render, which fits the mesh to the lidar.

    Other surfaces: any mesh (``ply``, ``obj``) with a ``layered_water`` as its interior medium and a dielectric BSDF of
    the water's index.

    .. example::

        {'type': 'ocean_surface', 'wind_speed': 3.0, 'interior': {'type': 'layered_water'}}
    """

    def __init__(self, props: DeclaredProperties) -> None:
        self._values: dict[str, Any] = {}
        #: Footprints for which automatic values are chosen; None before `fit`.
        self.footprints: Sequence[Footprint] | None = None
        #: Buffers of the mesh that have been edited before `fit`.
        self._edited: set[str] = set()
        waits = bool(props.take(WAITS, False))
        self._frame_origin = props.frame_origin

        def get(name: str, default: Any) -> Any:
            self._values[name] = props.get(name, default)
            return self._values[name]

        read = OCEAN_SURFACE.reader(get)
        self._read_foam(read)
        #: Surface shape (`mitransient_lidar.physics.sea.sea_surface.SeaSurface`).
        self.sea = SeaSurface.read(read, is_placeholder=waits)
        #: Mesh resolution; None for a level plane in its place.
        self._resolution = None if waits else Resolution.read(read, ())
        children = [child for _, child in props.objects()]
        water = next((child.water for child in children if isinstance(child, WaterMedium)), None)
        self.has_ripples = not any(isinstance(child, mi.BSDF) for child in children)
        if self.has_ripples:
            index = 1.34 if water is None else water.refractive_index
            self._own_ripples = self._ripples(index)
            props["ripples"] = self._foamed(self._own_ripples, index)
        elif self.sea.has_foam:
            raise UserError(f"foam = {self._values['foam']} is beside ripples, which a nested bsdf replaces")
        elif self.sea.slope_series is not None:
            raise UserError("slope_distribution = 'gram_charlier' is one of ripples, which a nested bsdf replaces")
        # Facet normals, not interpolated ones, have the slope variance of the mesh and conserve energy.
        props["face_normals"] = True
        mesh = self.sea.mesh(self._frame_origin)
        super().__init__("ocean_surface", len(mesh.vertices), len(mesh.faces), props, has_vertex_texcoords=True)
        if self.sea.has_foam:
            self.add_attribute(FOAM, 1, [0.0] * len(mesh.faces))
        fill_mesh(self, mesh)
        self._edited.clear()

    def parameters_changed(self, keys: Sequence[str] = ()) -> None:
        """Take edits by `mi.traverse`; mesh edits must follow `fit`."""
        super().parameters_changed(list(keys))
        if self.footprints is None:
            self._edited |= _BUFFERS & set(keys)

    def fit(self, footprints: Sequence[Footprint], depths: BottomDepths | None = None) -> bool:
        """Choose the automatic values for footprints of lasers and receivers; return whether the mesh has changed.

        Waves follow bottom depths in the scene frame as in `followed_depths`. Ripple edits stay. Raises UserError if
        the mesh has been edited, and must change.
        """
        read = OCEAN_SURFACE.reader(self._values.get)
        resolution = Resolution.read(read, footprints)
        followed = followed_depths(read, depths and depths.seen_from(self._frame_origin))
        is_new = resolution != self._resolution or followed is not None
        if self._edited and is_new:
            raise UserError(
                f"ocean_surface {self.id()!r}: {sorted(self._edited)[0]} was changed before the mesh was fitted to the "
                "lidar, as the first render does: render once, then change it and update"
            )
        self._resolution, self.footprints = resolution, footprints
        if not is_new:
            return False
        unfitted = self._roughness()
        self.sea = SeaSurface.read(read, footprints, depths=followed)
        fill_mesh(self, self.sea.mesh(self._frame_origin))
        if self.sea.slope_series is not None:
            self._own_ripples.set_slopes(self.sea.ripple_variance, self.sea.slope_series)
        elif self.has_ripples:
            buffers = mi.traverse(self)
            own_bsdf = "bsdf.bsdf_0" if self.sea.has_foam else "bsdf"
            for axis, alpha, own in zip("uv", self._roughness(), unfitted, strict=True):
                name = f"{own_bsdf}.alpha_{axis}.value"
                if np.float32(own) == np.array(buffers[name]).item():
                    buffers[name] = alpha
            buffers.update()
        return True

    @property
    def used_values(self) -> dict[str, Any]:
        """Values used for parameters that may be automatic [m]; without cells for a sea without waves.

        With ``shoaling`` for waves that follow the bottom.
        """
        sea = self.sea
        values = {"centre_x": sea.centre[0], "centre_y": sea.centre[1], "size": sea.size}
        fine = {"cell_size": sea.cell_size, "refined_size": sea.refined_size}
        shoaling = {"shoaling": "bottom"} if isinstance(sea.waves, ShoalingHeights) else {}
        return values | (fine if np.isfinite(sea.cell_size) else {}) | shoaling

    @property
    def time_s(self) -> float:
        """Wave time [s]."""
        return float(self._values["time"])

    @property
    def footprint_size(self) -> float:
        """Side of the fine patch [m], without an automatic margin for scattered light."""
        whole = self.sea.refined_size
        return max(whole - SIZE_MARGIN, 0.5 * whole) if self._values["refined_size"] == "auto" else whole

    @property
    def met_size(self) -> float:
        """Side of the patch in which the lidars' rays meet the waves [m], at most `footprint_size`."""
        if self._resolution is None or not self.footprints:
            return self.footprint_size
        box, steepest = self.bbox(), max(each.off_nadir + each.half_angle for each in self.footprints)
        beside = max(-float(box.min.z), float(box.max.z)) * np.tan(min(steepest, _STEEPEST))
        return min(self.footprint_size, self._resolution.footprint + 2 * (_WAVES_PER_MESH * beside + _MET_MARGIN))

    def scaled_ripples(self, refractive_index: float, factor: float) -> mi.BSDF:
        """Return the BSDF of ripples whose slope variances are those of the sea times a factor."""
        return self._foamed(self._ripples(refractive_index, (factor, factor)), refractive_index)

    def rippled(self, refractive_index: float) -> mi.BSDF:
        """Return the BSDF of a level sea, all of whose slopes are ripples."""
        sea = self.sea
        total = np.add(sea.resolved_variance, sea.ripple_variance)
        along, across = (float(factor) for factor in total / sea.ripple_variance)
        series = sea.slope_series
        series = None if series is None else series.of_part(sea.ripple_variance, (float(total[0]), float(total[1])))
        return self._ripples(refractive_index, (along, across), series)

    def _read_foam(self, read: Callable[..., Any]) -> None:
        """Read what foam does with light; raise UserError if it returns more than arrives."""
        white, through = read("foam_reflectance"), read("foam_transmittance")
        if white + through > 1:
            raise UserError(
                f"foam_reflectance = {white:g} and foam_transmittance = {through:g} must be at most 1 together"
            )
        white = min(white * foam_whiteness(read("wavelength_nm")), 1 - through)
        self._foam = {"reflectance": white, "transmittance": through}

    def _foamed(self, ripples: mi.BSDF, refractive_index: float) -> mi.BSDF:
        """Return the BSDF of ripples with foam on some faces, which reflects and transmits diffuse light."""
        if not self.sea.has_foam:
            return ripples
        foam = create_object("leaf", int_ior=refractive_index, **self._foam)
        share = create_object("mesh_attribute", name=FOAM)
        return create_object("blendbsdf", weight=share, bsdf_0=ripples, bsdf_1=foam)

    def _ripples(
        self,
        refractive_index: float,
        factors: tuple[float, float] = (1.0, 1.0),
        series: GramCharlierSeries | None = None,
    ) -> mi.BSDF:
        """Return the BSDF of the ripples, with their variances along and across the wind times factors."""
        indices = {"int_ior": refractive_index, "ext_ior": 1.0}
        series = series or self.sea.slope_series
        if series is None:
            alpha = (float(np.sqrt(factor)) * value for factor, value in zip(factors, self._roughness(), strict=True))
            roughness = dict(zip(("alpha_u", "alpha_v"), alpha, strict=True))
            return create_object("roughdielectric", distribution="beckmann", **roughness, **indices)
        along, across = (one * variance for one, variance in zip(factors, self.sea.ripple_variance, strict=True))
        return create_object(
            "gram_charlier_dielectric", variance_u=along, variance_v=across, **dataclasses.asdict(series), **indices
        )

    def _roughness(self) -> tuple[float, float]:
        """Return Beckmann's alpha of the ripples along and across the wind."""
        along, across = (float(np.sqrt(2 * variance)) for variance in self.sea.ripple_variance)
        return along, across


class SeaPatches:
    """Fine patches of an ``ocean_surface`` about several locations, side by side in one mesh.

    Attributes
    ----------
    shape
        The mesh, with the sea's ripples.
    shapes
        Scene with this mesh alone.
    """

    def __init__(self, surface: OceanSurface) -> None:
        self._surface = surface
        props = mi.Properties()
        props["bsdf"], props["face_normals"] = surface.bsdf(), True
        self.shape = mi.Mesh("sea_patches", 3, 1, props, has_vertex_texcoords=True)
        if surface.sea.has_foam:
            self.shape.add_attribute(FOAM, 1, [0.0])
        self.shapes: mi.Scene | None = None

    def _seas(self, places: FloatArray, times_s: FloatArray | None) -> Iterable[SeaSurface]:
        """Return the sea at the time of each place."""
        return [self._surface.sea] * len(places) if times_s is None else map(self._surface.sea.at, times_s.tolist())

    def heights(self, places: FloatArray, times_s: FloatArray | None = None) -> tuple[FloatArray, FloatArray]:
        """Return the heights where rays meet the patches, as of `SeaSurface.height_patches`, without a mesh."""
        sea = self._surface.sea
        return sea.height_patches(places, self._surface.met_size, self._seas(places, times_s))

    @property
    def cell_size(self) -> float:
        """Distance of the lines of `heights` [m]."""
        return self._surface.sea.line_distance

    @property
    def wind_direction(self) -> float:
        """Direction of the first axis of the ripples [rad]."""
        return self._surface.sea.wind_direction

    def move(self, places: FloatArray, times_s: FloatArray | None = None) -> FloatArray:
        """Fill the mesh with the patches about places [m], shape (n, 2); return where each lies, in the same way.

        Waves are those at times [s], shape (n,), or at the time of the surface.
        """
        mesh, positions = self._surface.sea.patches(places, self._surface.footprint_size, self._seas(places, times_s))
        fill_mesh(self.shape, mesh)
        if self.shapes is None:
            self.shapes = mi.load_dict({"type": "scene", "sea": self.shape}, parallel=False)
        else:
            self.shapes.parameters_changed([])
        return positions
