"""Medium plugin ``layered_water``: horizontally stratified water."""

from __future__ import annotations

from functools import partial

import drjit as dr
import mitsuba as mi

from mitransient_lidar.plugins.bases import RecordedProperties, recorded
from mitransient_lidar.plugins.phase.tabulated import TabulatedPhaseFunction
from mitransient_lidar.transport.medium.water_parameters import MAY_BE_EMPTY, read_water


class LayeredWater(mi.Medium):
    r"""Water in horizontal layers (``layered_water``).

    =======================  ======  ===================================================================================
    Parameter                Type    Meaning
    =======================  ======  ===================================================================================
    layer_tops               string  Depth of each layer's upper edge [m], first 0, increasing to at most 1e5: ``0, 3``.
                                     Default: ``0``
    attenuation              string  Beam attenuation c of each layer [1/m], 0 to 1000, or one value for all. Default:
                                     0.3
    scattering               string  Scattering b [1/m], at most c. Default: 0.15
    backscattering           string  Backscattering bb [1/m], at most b. Default: 0.006
    jerlov                   string  Instead of the three coefficients, the water's type: ``I``, ``IA``, ``IB``, ``II``,
                                     ``III``, ``1C``, ``3C``, ``5C``, ``7C`` or ``9C``
    chlorophyll              string  Or its chlorophyll, 0.01 to 30 mg/m^3 (Case 1 water)
    kd                       string  Or its diffuse attenuation Kd, 0.0486 to 0.738 1/m
    secchi                   string  Or its Secchi depth, 0.5 to 25 m
    petzold                  string  Or Petzold's ``clear``, ``coastal``, ``turbid``, or a station of the phase
                                     function ``petzold``
    pure                     string  Or ``true``: sea water without particles, whose scattering is ``water_scattering``
    wavelength_nm            float   Wavelength of these waters [nm]: 532, or 400 to 700 for ``chlorophyll`` and
                                     ``pure``, 514 to 533 for ``petzold``; or of the columns of a profile that has
                                     several, as ``a488, a532``. Default: 532, or that of the only columns
    profile                  string  A file instead of the four above, with ``depth`` or ``z``, two of ``a``, ``b``,
                                     ``c``, ``omega``, and ``bb`` or ``bb_ratio``: a table with units in its heading
                                     (.csv, .txt, .dat, .tsv) or .nc (`physics.water.profiles`)
    profile_tolerance        float   Largest relative error of the layers that approximate the profile, 1e-5 to 0.5.
                                     Default: 0.01
    phase_function           string  ``fournier_forand`` (each layer's from its bb/b), ``petzold`` or ``hg``. Default:
                                     ``fournier_forand``
    phase_g                  float   hg: mean cosine, -0.999 to 0.999. Default: 0.924
    water_scattering         string  Scattering by water molecules, a part of b [1/m], of each layer or all. Default: 0,
                                     for phase functions that include it; 0.00196 at 532 nm in a water by ``jerlov``,
                                     ``chlorophyll``, ``kd`` or ``secchi`` whose particles have Fournier-Forand
                                     functions; all of b in ``pure``
    chi_p                    string  bb/(2 pi p(180 deg) b) of the particles, 0.1 to 10, of each layer or all: less is
                                     a brighter echo of the water. Default: empty, that of the phase function, 0.94 to
                                     1.09 of ``fournier_forand``, 0.90 of ``petzold``
    (nested)                 phase   Any phase function, used in all layers instead; or one a layer, named ``phase_0``,
                                     ``phase_1``, ... from the top; ``plume_phase`` is that of the bubbles
    refractive_index         string  Phase index, 1.0001 to 2, of each layer or all. Default: 1.34
    group_index              string  Group index, 1 to 2, of each layer or all. Default: 1.364 (sea water at 532 nm)
    plume_scattering         float   Scattering of bubbles behind a ship, added to b [1/m], 0 to 1000. Default: 0, no
                                     bubbles
    plume_x, plume_y         float   Start of the bubbles, at the stern [m], -1e7 to 1e7. Default: 0
    plume_bearing_deg        float   Heading of the ship, from +x to +y [deg]. Default: 0
    plume_length             float   Length of the plume [m], 0.001 to 1e6. Default: 200
    plume_width              float   Width of the plume [m], 0.001 to 1e6. Default: 8
    plume_depth              float   Depth of the plume below the mean sea level [m], 0.01 to 100. Default: 2
    plume_backscatter_ratio  float   bb/b of bubbles for a Fournier-Forand function, 0.0001 to 0.4. Default: 0.02,
                                     between clean bubbles and coated ones (Zhang, Lewis and Johnson 1998,
                                     doi:10.1364/AO.37.006525)
    bubble_wind_speed        float   Wind speed 10 m above the sea whose bubbles lie below it [m/s], 0 to 20. Default:
                                     0, no bubbles
    bubble_void_fraction     string  Their void fraction at the surface, 0 to 0.001, instead of that of the wind
    bubble_depth             string  Depth at which it has fallen to 1/e [m], 0.05 to 20, instead of that of the wind
    bubble_backscatter       float   Volume scattering at 180 degrees over void fraction, 100 to 1445 1/(m sr). Default:
                                     233, clean bubbles; 1445 is a thick coating (Churnside 2010,
                                     doi:10.1364/OE.18.008294)
    =======================  ======  ===================================================================================

    Of coefficients, the six ways to give a water, and ``profile`` one is allowed; an empty text counts as not given. A
    water holds for all layers, or is a list with one value a layer: ``1C, 5C``. Sources and uncertainties are those of
    `physics.water.water_types`, and ``mitransient-lidar water`` prints the coefficients; the indices do not follow.

    The first layer includes the wave crests above z = 0, the last one is infinitely deep. With ``petzold``, ``hg`` or a
    nested phase function, bb follows from that function and ``backscattering`` is only checked.

    Bubbles below a windy sea are a mean over time, without the plumes of fresh breakers: the Hall-Novarini model
    (Hall 1989, doi:10.1121/1.398102; Novarini et al. 1998, doi:10.1109/48.725236). Their void fraction is
    :math:`9.3 \cdot 10^{-7}\,(U/10)^3\, e^{-z/L}` for a wind U [m/s], with L = 0.4 m up to 7.5 m/s and :math:`0.4 +
    0.115\,(U-7.5)` above. They scatter by :math:`b = 3\beta/(2r)` of their void fraction :math:`\beta` and effective
    radius r = 37 um, twice what meets them, and their Fournier-Forand function has the given backscatter at 180
    degrees. The glory and the critical angle of bubbles are left out. Void fractions that were measured 2 m down
    reached :math:`10^{-4.5}`, and were much the same in all winds below 16 m/s (Czerski et al. 2022,
    doi:10.5194/os-18-565-2022).

    Between layers of different refractive index light is refracted, or reflected totally; the partial reflection (5e-6
    between fresh and sea water at vertical incidence) is left out. At most 16 such layers are allowed, and they must
    begin below the troughs of the waves.

    The lidar integrators sample free flights and transmittances through all layers in closed form. Mitsuba's own
    volumetric integrators work as well, with null collisions against the largest attenuation and the first layer's
    phase function and index in all layers.

    .. code-block:: xml

        <medium type="layered_water" name="interior">
            <string name="layer_tops" value="0, 3"/>
            <string name="attenuation" value="0.9, 0.5"/>
            <string name="scattering" value="0.7, 0.35"/>
            <string name="backscattering" value="0.014, 0.007"/>
        </medium>

    .. code-block:: python

        {'type': 'layered_water', 'attenuation': 0.3, 'scattering': 0.15, 'backscattering': 0.006}
    """

    def __init__(self, props: RecordedProperties) -> None:
        props.drop_empty(*MAY_BE_EMPTY)
        phases = {name: child for name, child in props.objects() if isinstance(child, mi.PhaseFunction)}
        bubbles = phases.pop("plume_phase", None)
        if bubbles is not None:
            del props["plume_phase"]
        # Mitsuba's media accept one phase function.
        for name in list(phases)[1:]:
            del props[name]
        #: The water (`mitransient_lidar.transport.medium.water.Water`).
        self.water = read_water(props, phases, bubbles, partial(TabulatedPhaseFunction, mi.Properties())).moved(
            props.frame_origin
        )
        if not phases:
            # For Mitsuba's own integrators, whose default is an isotropic function.
            props["phase_0"] = self.water.phases.phases[0]
        super().__init__(props)
        self.m_is_homogeneous = self.water.column.count == 1 and self.water.plume is None
        self.m_has_spectral_extinction = False

    def get_majorant(self, mei: mi.MediumInteraction3f, active: mi.Bool = True) -> mi.UnpolarizedSpectrum:
        """Return the largest attenuation [1/m], for Mitsuba's own integrators."""
        return mi.UnpolarizedSpectrum(self.water.majorant)

    def get_scattering_coefficients(
        self, mei: mi.MediumInteraction3f, active: mi.Bool = True
    ) -> tuple[mi.UnpolarizedSpectrum, ...]:
        """Return scattering, null and total coefficient [1/m], for Mitsuba's own integrators."""
        attenuation, scattering = self.water.coefficients_at(mei.p)
        coefficients = scattering, self.water.majorant - attenuation, attenuation
        return tuple(mi.UnpolarizedSpectrum(coefficient) for coefficient in coefficients)

    def intersect_aabb(self, ray: mi.Ray3f) -> tuple[mi.Bool, mi.Float, mi.Float]:
        """Return an infinite interval: shapes bound the water."""
        return mi.Bool(True), mi.Float(0), mi.Float(dr.inf)

    def traverse(self, callback: mi.TraversalCallback) -> None:
        """Expose no parameters: changed water is loaded again."""

    def to_string(self) -> str:
        """Return a description."""
        water = self.water
        indices = f"refractive_index={water.refractive_index:g}, group_index={water.group_index:g}"
        return f"LayeredWater[{water.column}, {indices}]"


mi.register_medium("layered_water", recorded(LayeredWater))
