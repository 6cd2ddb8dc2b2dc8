"""Shape plugin ``ocean_surface``: a sea with waves, swell and wakes."""

from __future__ import annotations

import mitsuba as mi
import numpy as np

from mitransient_lidar.physics.sea.sea_surface import SeaSurface


class OceanSurface(mi.Mesh):
    r"""Sea surface with waves of wind and swell, or from a height map (``ocean_surface``).

    ========================  =======  =================================================================================
    Parameter                 Type     Meaning
    ========================  =======  =================================================================================
    spectrum                  string   ``elfouhaily`` (Elfouhaily et al. 1997), ``jonswap`` (needs ``fetch``),
                                       ``pierson_moskowitz``, ``table`` (``filename``: .npz with ``kx``, ``ky`` [rad/m]
                                       and ``density`` [m^4]), ``height_map`` (``filename``: .npy, .npz, .exr or .nc),
                                       or ``flat``: no waves, all slopes are ripples. Default: ``elfouhaily``
    wind_speed                float    Wind speed at 10 m [m/s], 0 to 30. Default: 3
    wind_direction_deg        float    Direction the wind blows towards, from +x to +y [deg]. Default: 0
    fetch, inverse_wave_age   float    How far the wind has blown over water [m], or how young its waves are, 0.84
                                       (fully developed) to 5. Default: 0.84
    peak_enhancement          float    JONSWAP's gamma. Default: 3.3
    swell_height              float    Significant height of an added swell [m], 0 for none. Default: 0
    swell_wavelength          float    Its wavelength [m]. Default: 60
    swell_direction_deg       float    Where it runs to [deg]. Default: 0
    slope_variance            string   What sets the total slope variance of waves and ripples: ``cox_munk`` (measured,
                                       clean sea, 1954; waves below 1 m are scaled to it), ``spectrum`` (the whole
                                       spectrum) or a number, the total of an isotropic sea. Default: ``cox_munk``
    surface_seed              integer  Which sea, 0 to 2^53: the same seed is the same sea at any resolution and
                                       wherever the patch lies. Default: 1
    time                      float    Moves the sea on [s]. Default: 0
    water_depth               float    Depth that the waves feel [m]. Default: deep
    current_speed             float    Current that carries the waves [m/s], 0 to 10. Default: 0
    current_direction_deg     float    Where it flows to [deg]. Default: 0
    wake_speed                float    Speed of a ship whose Kelvin wake is added [m/s], 0 for none. Default: 0
    wake_bearing_deg          float    Where it goes [deg]. Default: 0
    wake_length               float    Its length [m], 1 to 500. Default: 20
    wake_x, wake_y            float    Where its middle is [m]. Default: 0
    refined_size              float    Side of the finely resolved patch [m], or ``auto``. Default: ``auto``
    cell_size                 float    Side of its cells [m], or ``auto``. Default: ``auto``
    centre_x, centre_y        float    Middle of the patch [m]: where the beam hits the sea. Default: 0
    size                      float    Side of the whole surface [m]: cells grow outside the patch. Default: 1000
    period                    float    The sea repeats itself after so many metres, or ``auto``: three peak wavelengths
                                       or more, in steps of 32 m, at most 512 m. Default: ``auto``
    map_size                  float    Side of a height map that carries no positions [m]
    altitude, off_nadir_deg,  float    Transmitter and receiver for whom ``auto`` chooses patch and cells: a quarter of
    field_of_view_mrad,                the beam's standard deviation, 0.02 to 0.5 m. Without them: 32 m of 0.25 m
    divergence_mrad
    (nested)                  bsdf     Any BSDF instead of the ripples
    interior                  medium   The water: ``layered_water``
    ========================  =======  =================================================================================

    The mesh carries the waves that its facets resolve. The slope variance that is missing to the total, up- and
    crosswind, makes an anisotropic Beckmann ``roughdielectric`` with :math:`\alpha = \sqrt{2}\,\sigma`, which is the
    model of Gaussian slopes; the index is the water's ``refractive_index``. Texture coordinates run along and across
    the wind. With ``cox_munk`` and ``spectrum`` the total does not depend on the cells. The ripples are never smaller
    than 1e-5, so that a point laser can be connected; `slope_variance` of the loaded object says what the total is.

    Outside the patch the facets are longer and carry fewer slopes, with the ripples of the patch: light that has
    scattered far still meets water. Light beyond ``size`` is lost and reported after rendering.

    Other surfaces: any mesh (``ply``, ``obj``) with a ``layered_water`` as its interior medium and a dielectric BSDF.

    .. code-block:: xml

        <shape type="ocean_surface">
            <float name="wind_speed" value="3"/>
            <medium name="interior" type="layered_water"/>
        </shape>

    .. code-block:: python

        {'type': 'ocean_surface', 'wind_speed': 3.0, 'interior': {'type': 'layered_water'}}
    """

    def __init__(self, props: mi.Properties) -> None:
        #: What the surface is made from (`mitransient_lidar.physics.sea.sea_surface.SeaSurface`).
        self.sea = SeaSurface.read(props.get)
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
        mesh = self.sea.mesh()
        super().__init__("ocean_surface", len(mesh.vertices), len(mesh.faces), props, has_vertex_texcoords=True)
        buffers = mi.traverse(self)
        buffers["vertex_positions"] = mi.Float(mesh.vertices.ravel())
        buffers["vertex_texcoords"] = mi.Float(mesh.texcoords.ravel())
        buffers["faces"] = mi.UInt32(mesh.faces.ravel())
        buffers.update()
        self.initialize()

    @property
    def ripple_variance(self) -> tuple[float, float]:
        """Slope variances of the ripples along and across the wind [1]."""
        return self.sea.ripple_variance

    @property
    def slope_variance(self) -> float:
        """Total slope variance of waves and ripples, both axes [1]."""
        return self.sea.slope_variance

    @property
    def cell_size(self) -> float:
        """Side of the squares of the fine patch whose halves are its triangles [m]; infinite for a flat sea."""
        return self.sea.cell_size

    def to_string(self) -> str:
        """Return a description."""
        sea = self.sea
        return (
            f"OceanSurface[{sea.spectrum}, wind_speed={sea.wind_speed:g} m/s, patch of {sea.refined_size:g} m in cells "
            f"of {sea.cell_size:g} m, size={sea.size:g} m, faces={self.face_count()}, "
            f"resolved_variance={sea.resolved_variance}, ripple_variance={sea.ripple_variance}]"
        )


mi.register_shape("ocean_surface", lambda props: OceanSurface(props))
