"""Medium plugin ``layered_water``: horizontally stratified water."""

from __future__ import annotations

from dataclasses import replace
from functools import partial

import drjit as dr
import mitsuba as mi
import numpy as np

from mitransient_lidar.core.errors import UserError
from mitransient_lidar.core.validation import in_range, number_list, positive
from mitransient_lidar.physics.water.layers import WaterColumn
from mitransient_lidar.physics.water.profiles import read_profile
from mitransient_lidar.physics.water.water_types import KINDS as WATERS
from mitransient_lidar.physics.water.water_types import water_of
from mitransient_lidar.plugins.bases import RecordedProperties, recorded
from mitransient_lidar.plugins.phase.tabulated import TabulatedPhaseFunction
from mitransient_lidar.transport.medium.bubble_plume import BubblePlume
from mitransient_lidar.transport.medium.free_flight import LayeredFlight
from mitransient_lidar.transport.medium.index_layers import IndexLayers
from mitransient_lidar.transport.medium.water_phases import KINDS, LayerPhases, ScattererPhases
from mitransient_lidar.transport.nested_objects import create_object
from mitransient_lidar.transport.opaque import opaque
from mitransient_lidar.transport.path import Path

#: Attenuation, scattering and backscattering [1/m] unless they are given.
_DEFAULTS = {"attenuation": 0.3, "scattering": 0.15, "backscattering": 0.006}


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
    petzold                  string  Or Petzold's ``clear``, ``coastal`` or ``turbid``
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
    plume_x, plume_y         float   Start of the bubbles, at the stern [m], -1e6 to 1e6. Default: 0
    plume_bearing_deg        float   Heading of the ship, from +x to +y [deg]. Default: 0
    plume_length             float   Length of the plume [m], 0.001 to 1e6. Default: 200
    plume_width              float   Width of the plume [m], 0.001 to 1e6. Default: 8
    plume_depth              float   Depth of the plume below the mean sea level [m], 0.01 to 100. Default: 2
    plume_backscatter_ratio  float   bb/b of bubbles for a Fournier-Forand function, 0.0001 to 0.4. Default: 0.02,
                                     between clean bubbles and coated ones (Zhang, Lewis and Johnson 1998,
                                     doi:10.1364/AO.37.006525)
    =======================  ======  ===================================================================================

    Of coefficients, the six ways to give a water, and ``profile`` one is allowed; an empty text counts as not given. A
    water holds for all layers, or is a list with one value a layer: ``1C, 5C``. Sources and uncertainties are those of
    `physics.water.water_types`, and ``mitransient-lidar water`` prints the coefficients; the indices do not follow.

    The first layer includes the wave crests above z = 0, the last one is infinitely deep. With ``petzold``, ``hg`` or a
    nested phase function, bb follows from that function and ``backscattering`` is only checked.

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
        props.drop_empty("layer_tops", *_DEFAULTS, "water_scattering", "chi_p", *WATERS, "profile")
        phases = {name: child for name, child in props.objects() if isinstance(child, mi.PhaseFunction)}
        self.column, molecules = _column(props)
        #: Whether the layers approximate a profile from a file.
        self.from_profile = _is_given(props, "profile")
        indices = []
        for name, default, low in (("refractive_index", 1.34, 1.0001), ("group_index", 1.364, 1.0)):
            indices.append(_per_layer(name, props.get(name, default), self.column.count))
            for value in indices[-1]:
                in_range(name, value, low, 2.0)
        kind = props.get("phase_function", "fournier_forand")
        phase_g = in_range("phase_g", props.get("phase_g", 0.924), -0.999, 0.999)
        if kind not in KINDS:
            raise UserError(f"phase_function = {kind!r} must be one of {', '.join(KINDS)}")
        #: Bubbles, or None.
        self.plume = BubblePlume.from_properties(props)
        ratio = in_range("plume_backscatter_ratio", props.get("plume_backscatter_ratio", 0.02), 1e-4, 0.4)
        bubbles = phases.pop("plume_phase", None)
        if bubbles is not None:
            del props["plume_phase"]
        # Mitsuba's media accept one phase function.
        for name in list(phases)[1:]:
            del props[name]
        if not _is_given(props, "pure") and (phases or kind != "fournier_forand"):
            molecules = np.zeros(1)
        own = ", ".join(map(repr, molecules.tolist()))
        molecules = _per_layer("water_scattering", props.get("water_scattering", own), self.column.count)
        _check_water_scattering(molecules, self.column)
        chi_p = _per_layer("chi_p", props["chi_p"], self.column.count) if "chi_p" in props else None
        for value in () if chi_p is None else chi_p:
            in_range("chi_p", value, 0.1, 10)
        tabulated = partial(TabulatedPhaseFunction, mi.Properties())
        #: The layers as given, and their phase functions for changed coefficients.
        self.layers = LayerPhases(self.column, phases, kind, phase_g, molecules, chi_p, tabulated)
        of_layers = self.layers.functions()
        self.column, kept = _joined(self.column, [*indices, np.array([id(phase) for phase in of_layers])])
        of_layers = [of_layers[layer] for layer in kept]
        #: Scattering by water molecules of each layer, a part of b [1/m]; 0 where it is not known.
        self.water_scattering = molecules[kept]
        #: Runs of layers of one refractive and one group index.
        self.index_layers = IndexLayers(self.column.layer_tops, *(values[kept] for values in indices))
        #: Indices of the uppermost layer, where the sea surface is.
        self.refractive_index, self.group_index = (float(values[0]) for values in indices)
        if self.plume is not None:
            self.plume_phase = bubbles or create_object("fournier_forand", backscatter_ratio=ratio)
            of_layers.append(self.plume_phase)
        #: Phase functions of the layers, and last of the bubbles.
        self.phases = ScattererPhases(of_layers)
        if not phases:
            # For Mitsuba's own integrators, whose default is an isotropic function.
            props["phase_0"] = of_layers[0]
        super().__init__(props)
        self.flight = LayeredFlight(self.column)
        self.scattering_flight = LayeredFlight(replace(self.column, attenuation=self.column.scattering))
        none = np.zeros(self.column.count)
        self.absorption_flight = LayeredFlight(WaterColumn(self.column.layer_tops, self.column.absorption, none, none))
        self._majorant = float(np.max(self.column.attenuation)) + (self.plume.scattering if self.plume else 0)
        self.m_is_homogeneous = self.column.count == 1 and self.plume is None
        self.m_has_spectral_extinction = False

    def free_flight(self, flight: LayeredFlight, path: Path, rng: mi.PCG32) -> mi.Float:
        """Draw the distance to the next event of `flight`, or of the bubbles [m]."""
        distance = flight.distance(path.depth, path.downward, -dr.log(1 - rng.next_float32()))
        if self.plume is None:
            return distance
        return dr.minimum(distance, self.plume.distance(path.point, path.direction, -dr.log(1 - rng.next_float32())))

    def optical_depth(self, point: mi.Point3f, direction: mi.Vector3f, length: mi.Float) -> mi.Float:
        """Return the optical depth of a segment [1], bubbles included."""
        through = self.flight.optical_depth(-point.z, -direction.z, length)
        return through if self.plume is None else through + self.plume.optical_depth(point, direction, length)

    def scatterer_at(self, flight: LayeredFlight, point: mi.Point3f, rng: mi.PCG32) -> mi.UInt32:
        """Draw the scatterer at the end of a flight: the number of the layer, or the number of layers for a bubble."""
        layer = flight.layer_at(-point.z)
        if self.plume is None:
            return layer
        bubbles = self.plume.scattering_at(point)
        is_bubble = rng.next_float32() * (bubbles + flight.attenuation(layer)) < bubbles
        return dr.select(is_bubble, mi.UInt32(self.column.count), layer)

    def is_water(self, scatterer: mi.UInt32) -> mi.Bool:
        """Return whether scatterers are layers of water, not bubbles."""
        return scatterer < self.column.count

    def coefficient(self, flight: LayeredFlight, scatterer: mi.UInt32) -> mi.Float:
        """Return the coefficient of a scatterer in `flight` [1/m]."""
        if self.plume is None:
            return flight.attenuation(scatterer)
        layer = dr.minimum(scatterer, self.column.count - 1)
        return dr.select(scatterer == self.column.count, opaque(self.plume.scattering), flight.attenuation(layer))

    def albedo(self, scatterer: mi.UInt32) -> mi.Float:
        """Return the single-scattering albedo of a scatterer; bubbles absorb nothing."""
        if self.plume is None:
            return self.flight.albedo(scatterer)
        layer = dr.minimum(scatterer, self.column.count - 1)
        return dr.select(scatterer == self.column.count, mi.Float(1), self.flight.albedo(layer))

    def get_majorant(self, mei: mi.MediumInteraction3f, active: mi.Bool = True) -> mi.UnpolarizedSpectrum:
        """Return the largest attenuation [1/m], for Mitsuba's own integrators."""
        return mi.UnpolarizedSpectrum(self._majorant)

    def get_scattering_coefficients(
        self, mei: mi.MediumInteraction3f, active: mi.Bool = True
    ) -> tuple[mi.UnpolarizedSpectrum, ...]:
        """Return scattering, null and total coefficient [1/m], for Mitsuba's own integrators."""
        layer = self.flight.layer_at(-mei.p.z)
        attenuation = self.flight.attenuation(layer)
        scattering = self.flight.albedo(layer) * attenuation
        if self.plume is not None:
            bubbles = self.plume.scattering_at(mei.p)
            scattering, attenuation = scattering + bubbles, attenuation + bubbles
        coefficients = scattering, self._majorant - attenuation, attenuation
        return tuple(mi.UnpolarizedSpectrum(coefficient) for coefficient in coefficients)

    def intersect_aabb(self, ray: mi.Ray3f) -> tuple[mi.Bool, mi.Float, mi.Float]:
        """Return an infinite interval: shapes bound the water."""
        return mi.Bool(True), mi.Float(0), mi.Float(dr.inf)

    def traverse(self, callback: mi.TraversalCallback) -> None:
        """Expose no parameters: changed water is loaded again."""

    def to_string(self) -> str:
        """Return a description."""
        indices = f"refractive_index={self.refractive_index:g}, group_index={self.group_index:g}"
        return f"LayeredWater[{self.column}, {indices}]"


def _column(props: RecordedProperties) -> tuple[WaterColumn, np.ndarray]:
    """Return the layers of the parameters, of a water by name, or of a profile, and scattering by molecules [1/m].

    That is one value a layer, or one for all; 0 where it is not known.
    """
    tolerance = props.get("profile_tolerance", 0.01)
    wavelength = positive("wavelength_nm", props["wavelength_nm"]) if "wavelength_nm" in props else None
    ways = [name for name in (*WATERS, "profile") if _is_given(props, name)]
    own = [name for name in ("layer_tops", *_DEFAULTS) if name in props]
    if not ways:
        values = {name: props.get(name, default) for name, default in _DEFAULTS.items()}
        return WaterColumn.from_text(props.get("layer_tops", "0"), **values), np.zeros(1)
    way = ways[0]
    excluded = [*ways[1:], *(name for name in own if name != "layer_tops" or way == "profile")]
    if excluded:
        raise UserError(f"{way} = {props[way]!r} describes the same as {', '.join(excluded)}: give one of them")
    if way == "profile":
        return read_profile(props[way], wavelength).layers(tolerance), np.zeros(1)
    tops = number_list("layer_tops", props.get("layer_tops", "0"))
    wavelength = wavelength or props.get("wavelength_nm", 532.0)
    texts = str(props[way]).replace(",", " ").split()
    if len(texts) not in (1, tops.size):
        raise UserError(f"{way} has {len(texts)} values but must have 1 or {tops.size}, one a layer")
    try:
        found = [water_of(way, None if way == "pure" else text, wavelength) for text in texts]
    except UserError as error:
        raise UserError(f"{way} = {props[way]!r}: {error}") from error
    rows = [[water.attenuation, water.scattering, water.backscattering, water.water_scattering] for water in found]
    *coefficients, molecules = np.transpose(rows)
    return WaterColumn(tops, *np.broadcast_to(coefficients, (3, tops.size))), molecules


def _is_given(props: RecordedProperties, name: str) -> bool:
    """Return whether a parameter has a value; ``false`` counts as not given for ``pure``."""
    if name == "pure":
        value = props.get(name, "false")
        if str(value).lower() not in ("true", "false"):
            raise UserError(f"pure = {value!r} must be true or false")
        return str(value).lower() == "true"
    return name in props


def _joined(column: WaterColumn, others: list[np.ndarray]) -> tuple[WaterColumn, np.ndarray]:
    """Return the column with neighbouring layers of equal properties joined, and the first layer of each."""
    rows = np.array([column.attenuation, column.scattering, column.backscattering, *others])
    kept = np.append(0, 1 + np.flatnonzero(np.any(np.diff(rows, axis=1) != 0, axis=0)))
    return WaterColumn(column.layer_tops[kept], *rows[:3, kept]), kept


def _per_layer(name: str, given: float | str, count: int) -> np.ndarray:
    """Return one value a layer of a parameter given for all layers or for each."""
    values = number_list(name, given)
    if values.size not in (1, count):
        raise UserError(f"{name} has {values.size} values but must have 1 or {count}, one a layer")
    return np.broadcast_to(values, count)


def _check_water_scattering(molecules: np.ndarray, column: WaterColumn) -> None:
    """Raise `UserError` unless the scattering by molecules [1/m] is a part of that of each layer."""
    for layer in np.flatnonzero((molecules < 0) | (molecules > column.scattering))[:1]:
        raise UserError(
            f"water_scattering = {molecules[layer]:g} must be at least 0 and at most scattering = "
            f"{column.scattering[layer]:g}, in layer {layer}"
        )


mi.register_medium("layered_water", recorded(LayeredWater))
