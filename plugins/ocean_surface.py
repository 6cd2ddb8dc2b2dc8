"""Shape plugin ``ocean_surface``: a wind-driven sea surface."""

from __future__ import annotations

import logging

import mitsuba as mi
import numpy as np

from mitransient_lidar.optics.checks import finite, in_range, positive, whole
from mitransient_lidar.optics.sea import ElfouhailySpectrum, cox_munk, mesh_slope_variance, realise

logger = logging.getLogger(__name__)

#: Smallest slope variance of the ripples along one axis: a perfectly smooth facet has no connection to a point laser.
SMALLEST_RIPPLE_VARIANCE = 1e-5

_SPECTRA = ("elfouhaily", "flat")


class OceanSurface(mi.Mesh):
    r"""Wind-driven sea surface (``ocean_surface``).

    ==================  =======  =======================================================================================
    Parameter           Type     Meaning
    ==================  =======  =======================================================================================
    spectrum            string   ``elfouhaily``: waves of the unified spectrum (Elfouhaily et al. 1997); ``flat``: no
                                 waves, all slopes are ripples. Default: ``elfouhaily``
    wind_speed          float    Wind speed at 10 m [m/s], 0 to 30. Default: 3
    wind_direction_deg  float    Direction the wind blows towards, from +x to +y [deg]. Default: 0
    slope_variance      string   What sets the total slope variance of waves and ripples: ``cox_munk`` (measured, clean
                                 sea, 1954), ``spectrum`` (the whole spectrum) or a number, the total of an isotropic
                                 sea. Default: ``cox_munk``
    size                float    Side of the square patch about the origin [m]. Default: 32, flat: 1000
    resolution          integer  Cells a side, even, 2 to 4096. Default: 128
    surface_seed        integer  Which sea, 0 to 2^53: the same seed is the same sea at any resolution. Default: 1
    (nested)            bsdf     Any BSDF instead of the ripples
    interior            medium   The water: ``layered_water``
    ==================  =======  =======================================================================================

    The mesh carries the waves that its facets resolve. The slope variance that is missing to the total, up- and
    crosswind, makes an anisotropic Beckmann ``roughdielectric`` with :math:`\alpha = \sqrt{2}\,\sigma`, which is the
    model of Gaussian slopes; the index is the water's ``refractive_index``. Texture coordinates run along and across
    the wind. A fine mesh at light wind can resolve more upwind slope than Cox and Munk measured: then the ripples are
    as small as 1e-5 and the total is what `slope_variance` of the loaded object says.

    The patch ends at its border; light that leaves it is lost and reported after rendering.

    .. code-block:: xml

        <shape type="ocean_surface">
            <float name="wind_speed" value="3"/>
            <medium name="interior" type="layered_water"/>
        </shape>

    .. code-block:: python

        {'type': 'ocean_surface', 'wind_speed': 3.0, 'interior': {'type': 'layered_water'}}
    """

    def __init__(self, props: mi.Properties) -> None:
        spectrum = props.get("spectrum", "elfouhaily")
        if spectrum not in _SPECTRA:
            raise ValueError(f"spectrum = {spectrum!r} must be one of {', '.join(_SPECTRA)}")
        wind_speed = in_range("wind_speed", props.get("wind_speed", 3.0), 0.0, 30.0)
        wind_direction = np.deg2rad(finite("wind_direction_deg", props.get("wind_direction_deg", 0.0)))
        if spectrum == "elfouhaily" and wind_speed == 0:
            logger.info("wind_speed = 0: the sea is flat but for ripples")
            spectrum = "flat"
        self.spectrum = spectrum
        self.wind_speed = wind_speed
        self.size = positive("size", props.get("size", 1000.0 if spectrum == "flat" else 32.0))
        resolution = 2 if spectrum == "flat" else whole("resolution", props.get("resolution", 128), 2, 4096)
        props.mark_queried("resolution")
        seed = whole("surface_seed", props.get("surface_seed", 1), 0, 2**53)
        if spectrum == "flat":
            heights, resolved = np.zeros((2, 2)), (0.0, 0.0)
            total = _total_variance(props, wind_speed, None)
        else:
            waves = ElfouhailySpectrum(wind_speed)
            heights = realise(waves, self.size, resolution, seed, wind_direction)
            resolved = mesh_slope_variance(waves, self.size, resolution, wind_direction)
            total = _total_variance(props, wind_speed, waves)
        self.resolved_variance = resolved
        self.ripple_variance = tuple(
            max(SMALLEST_RIPPLE_VARIANCE, whole - part) for whole, part in zip(total, resolved, strict=True)
        )
        children = [child for _, child in props.objects()]
        water = next((child for child in children if isinstance(child, mi.Medium)), None)
        self.has_ripples = not any(isinstance(child, mi.BSDF) for child in children)
        if self.has_ripples:
            props["ripples"] = mi.load_dict(
                {
                    "type": "roughdielectric",
                    "distribution": "beckmann",
                    "alpha_u": float(np.sqrt(2 * self.ripple_variance[0])),
                    "alpha_v": float(np.sqrt(2 * self.ripple_variance[1])),
                    "int_ior": getattr(water, "refractive_index", 1.34),
                    "ext_ior": 1.0,
                }
            )
        # Facets, not interpolated normals: the slope variance is that of the facets, and energy is conserved.
        props["face_normals"] = True
        vertices, faces, texcoords = _grid(heights, self.size, wind_direction)
        super().__init__("ocean_surface", len(vertices), len(faces), props, has_vertex_texcoords=True)
        buffers = mi.traverse(self)
        buffers["vertex_positions"] = mi.Float(vertices.ravel())
        buffers["vertex_texcoords"] = mi.Float(texcoords.ravel())
        buffers["faces"] = mi.UInt32(faces.ravel())
        buffers.update()
        self.initialize()

    @property
    def slope_variance(self) -> float:
        """Total slope variance of waves and ripples, both axes [1]."""
        return sum(self.resolved_variance) + sum(self.ripple_variance)

    def to_string(self) -> str:
        """Return a description."""
        return (
            f"OceanSurface[{self.spectrum}, wind_speed={self.wind_speed:g} m/s, size={self.size:g} m, "
            f"faces={self.face_count()}, resolved_variance={self.resolved_variance}, "
            f"ripple_variance={self.ripple_variance}]"
        )


def _total_variance(props: mi.Properties, wind_speed: float, waves: ElfouhailySpectrum | None) -> tuple[float, float]:
    """Return the total slope variances (upwind, crosswind) that ``slope_variance`` asks for."""
    wanted = props.get("slope_variance", "cox_munk")
    if wanted == "cox_munk":
        return cox_munk(wind_speed)
    if wanted == "spectrum":
        return (waves or ElfouhailySpectrum(wind_speed)).slope_variance()
    try:
        number = float(wanted)
    except ValueError:
        raise ValueError(f"slope_variance = {wanted!r} must be 'cox_munk', 'spectrum' or a number") from None
    half = 0.5 * in_range("slope_variance", number, 2 * SMALLEST_RIPPLE_VARIANCE, 1.0)
    return half, half


def _grid(heights: np.ndarray, size: float, wind_direction: float) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
    """Return vertices [m], faces and texture coordinates of a periodic height field with one more row and column."""
    cells = len(heights)
    closed = np.pad(heights, ((0, 1), (0, 1)), mode="wrap")
    ticks = (np.arange(cells + 1) / cells - 0.5) * size
    x, y = np.meshgrid(ticks, ticks)
    vertices = np.stack([x, y, closed], axis=-1).reshape(-1, 3)
    corner = np.arange(cells)[:, None] * (cells + 1) + np.arange(cells)
    right, up, across = corner + 1, corner + cells + 1, corner + cells + 2
    # Cells are split from right to up, as the resolved slope variance assumes; normals point to the air.
    faces = np.stack([corner, right, up, right, across, up], axis=-1).reshape(-1, 3)
    cos, sin = np.cos(wind_direction), np.sin(wind_direction)
    texcoords = np.stack([cos * x + sin * y, cos * y - sin * x], axis=-1).reshape(-1, 2) / size
    return vertices, faces, texcoords


mi.register_shape("ocean_surface", lambda props: OceanSurface(props))
