"""Surface, water column and bottom of both integrators against closed forms: levels, times and pixels.

Light by order of scattering separates what closed forms describe from the rest: without scattering the surface and the
bottom, which falls with the full attenuation c, and with one event the column. A wrong n^2 is a factor of 1.8, a wrong
pi 3.1, a forgotten cosine 6 % at 20 degrees, one efficiency 10 %, the phase index in place of the group index 1.3 ns.
"""

from types import SimpleNamespace

import numpy as np
import pytest
import significance
from oracles.beam_average import bottom_energy_per_bin, column_energy_per_bin, surface_energy_per_bin
from oracles.echo_times import bottom_time_ns
from oracles.lidar_equation import bottom_energy, column_energy, cos_water, surface_energy
from oracles.phase import henyey_greenstein
from rows import each_case

from mitransient_lidar.core.constants import C0
from mitransient_lidar.physics.lidar.level_sea import LidarSystem, surface_time_ns
from mitransient_lidar.physics.water.layers import WaterColumn
from mitransient_lidar.physics.water.phase import fournier_forand, fournier_forand_parameters, petzold_average_particle
from mitransient_lidar.transport.light_maps.renderer import LightMapRenderer
from mitransient_lidar.transport.paths.passes import PathClasses
from mitransient_lidar.transport.scene_parts import find_lidar_scene

INTEGRATORS = ["lidar_merging", "lidar_volpath"]
#: Case of the quick tier, and those that differ from it in the water alone.
QUICK, WATERS = "table", ("petzold", "chi")
BIN_NS = 4.0
REFLECTANCE = 0.15
GROUP_INDEX = 1.364
#: No two factors are equal that a mistake could exchange.
ENERGY, AREA = 5e-3 * 0.9 * 0.8 * 0.85, 0.025 * 0.7
RECEIVER = {"optical_efficiency": 0.8, "two_way_atmospheric_transmittance": 0.85, "obscuration": 0.3}


def fournier_forand_layers(*ratios):
    """Return parameters of water whose layers have these bb/b, and the phase function at 180 degrees of each [1/sr]."""
    return {}, [float(fournier_forand(np.pi, *fournier_forand_parameters(ratio))) for ratio in ratios], ratios


def same_layers(phase, backward):
    """Return parameters of water with one phase function, its values at 180 degrees, and a bb/b."""
    return phase, [float(backward)] * 2, (0.02, 0.02)


#: Altitude [m], angle off nadir [deg], refractive index, beam and view [mrad], depth of bottom and of the layers' edge
#: [m], c and b of the two layers [1/m], phase functions.
CASES = {
    "table": (200.0, 20.0, 1.34, 10.0, 30.0, 8.0, 3.0, (0.2, 0.1), (0.08, 0.05), fournier_forand_layers(0.02, 0.04)),
    "wide beam": (1e3, 5.0, 1.2, 8.0, 4.0, 10.0, 6.0, (0.1, 0.2), (0.05, 0.1), fournier_forand_layers(0.03, 0.01)),
    "narrow beam": (
        200.0,
        20.0,
        1.34,
        0.2,
        30.0,
        8.0,
        3.0,
        (0.1, 0.3),
        (0.05, 0.2),
        fournier_forand_layers(0.03, 0.01),
    ),
    "mast": (
        *(20.0, 35.0, 1.5, 30.0, 60.0, 5.0, 2.0, (0.15, 0.3), (0.1, 0.2)),
        same_layers({"phase_function": "hg", "phase_g": 0.7}, henyey_greenstein(np.pi, 0.7)),
    ),
    "petzold": (
        *(200.0, 20.0, 1.34, 10.0, 30.0, 8.0, 3.0, (0.2, 0.1), (0.08, 0.05)),
        same_layers({"phase_function": "petzold"}, petzold_average_particle()(np.pi)),
    ),
    "chi": (
        *(200.0, 20.0, 1.34, 10.0, 30.0, 8.0, 3.0, (0.2, 0.1), (0.08, 0.05)),
        ({"chi_p": "0.4, 2"}, [0.02 / (2 * np.pi * 0.4), 0.04 / (2 * np.pi * 2)], (0.02, 0.04)),
    ),
}


def tier_of(name, integrator):
    if name == QUICK:
        return []
    # The quick case has both integrators; the mast differs from it the most, in the phase function as well.
    return pytest.mark.slow if (name, integrator) == ("mast", "lidar_merging") else pytest.mark.long


def both_in(names):
    both = [(name, integrator) for integrator in INTEGRATORS for name in names]
    cases = [pytest.param(*each, marks=tier_of(*each)) for each in both]
    return pytest.mark.parametrize(("case", "integrator"), cases, indirect=["case"])


@pytest.fixture
def case(request):
    """Return a case with its lidar, time bins, and the predicates of its four pixels."""
    altitude, angle, index, beam, view, bottom, edge, c, b, (phase, backward, ratios) = CASES[request.param]
    system = LidarSystem(altitude, np.radians(angle), index, GROUP_INDEX, energy=ENERGY, aperture_area=AREA)
    surface_ns = float(surface_time_ns(altitude, np.radians(angle)))
    bottom_ns = float(bottom_time_ns(altitude, bottom, np.radians(angle), index, GROUP_INDEX))
    start = BIN_NS * (surface_ns // BIN_NS - 10)
    edges = start + BIN_NS * np.arange(int((bottom_ns - start) / BIN_NS) + 12)
    half = 0.5e-3 * view
    fields = [
        lambda x, y, far=far, left=left: (np.maximum(abs(x), abs(y)) < half) & ((x > 0) == far) & ((y > 0) == left)
        for far in (True, False)
        for left in (True, False)
    ]
    pose = {"altitude": altitude, "off_nadir_deg": angle}
    scene = {
        "tx": {**pose, "divergence_mrad": beam},
        # Its edges lie between cells of the closed form's grid.
        "rx": {**pose, **RECEIVER, "field_of_view_mrad": view, "field_of_view_shape": "square"},
        "film": {"time_start_ns": start, "bin_width_ns": BIN_NS, "bin_count": len(edges) - 1},
    }
    back = [each * ratio for each, ratio in zip(b, ratios, strict=True)]
    names = "layer_tops", "attenuation", "scattering", "backscattering"
    layers = dict(zip(names, ([0.0, edge], c, b, back), strict=True))
    return SimpleNamespace(
        name=request.param,
        scene=scene,
        system=system,
        sigma=0.5e-3 * beam,
        edges=edges,
        fields=fields,
        depth=bottom,
        water={name: ", ".join(f"{value:.9g}" for value in values) for name, values in layers.items()} | phase,
        indices={"refractive_index": index, "group_index": GROUP_INDEX},
        column=WaterColumn(*(np.array(values) for values in layers.values())),
        backward=backward,
    )


def per_pixel(energy_per_bin, case, *arguments):
    """Return energies [J] of a closed form, shape (pixels, bins)."""
    return np.array([energy_per_bin(case.edges, case.system, case.sigma, *arguments, field) for field in case.fields])


@both_in([name for name in CASES if name not in WATERS])
def test_surface_of_gaussian_slopes(lidar_scene, passes, case, integrator):
    """Cox and Munk's slopes at 6 m/s across the line of sight; exchanged axes of the wind are 13 to 30 % at 20 deg."""
    scene = lidar_scene(
        **case.scene,
        integrator={"type": integrator, "paths_per_pass": 2**14},
        sea={"slope_variance": "cox_munk", "wind_speed": 6.0, "wind_direction_deg": 90.0},
        water={**case.indices, "attenuation": 50.0, "scattering": 0.0, "backscattering": 0.0},
        bottom=None,
    )
    along, across = 0.003 + 1.92e-3 * 6.0, 3.16e-3 * 6.0
    expected = per_pixel(surface_energy_per_bin, case, (along, across))
    strong = expected > 0.05 * expected.max()
    samples = passes(scene, 6)[:, strong]
    significance.assert_equal(samples, expected[strong], error=1e-3, bias=3e-3)


def test_surface_in_the_near_infrared(lidar_scene, passes):
    """At 1064 nm the sea reflects 2.0 % at nadir (n = 1.3303), and nothing comes from the bottom at 8 m.

    The mean echo of sea and water lies above the level by the waves' tilt alone and below it by less than 4 cm.
    """
    pose = {"altitude": 200.0, "off_nadir_deg": 10.0}
    scene = lidar_scene(
        tx={**pose, "divergence_mrad": 0.2, "wavelength_nm": 1064.0, "pulse_energy_mj": 4.0},
        rx={**pose, "layout": "1x1", "field_of_view_mrad": 4.0},
        film={"time_start_ns": "auto", "bin_count": "auto", "bin_width_ns": 0.05},
        integrator={"type": "lidar_volpath", "paths_per_pass": 2**12},
        sea={"slope_variance": "0.01", "interior": {"type": "layered_water", "wavelength_nm": 1064.0}},
    )
    lidar = find_lidar_scene(scene, scene.sensors()[0])
    surface_ns = float(surface_time_ns(200.0, np.radians(10.0)))
    assert lidar.axis.end_ns < surface_ns + 60
    optics = scene.sensors()[0].receiver.optics
    system = LidarSystem(
        200.0, np.radians(10.0), 1.3303, 1.3464, energy=4e-3 * 0.9 * optics.collection, aperture_area=1.0
    )
    energy = passes(scene, 8)[:, 0]
    expected = surface_energy(system, (0.005, 0.005), np.radians(10.0))
    # The water below adds exp(-2 c z): 1e-4 of the surface.
    significance.assert_equal(energy.sum(axis=1), expected, error=2e-3, bias=3e-3)
    mean = energy.mean(axis=0)
    late = 0.5e-9 * C0 * (float(np.average(lidar.axis.centres_ns, weights=mean)) - surface_ns)
    assert -0.005 < late < 0.04


@pytest.mark.parametrize("integrator", [INTEGRATORS[1], pytest.param(INTEGRATORS[0], marks=pytest.mark.slow)])
def test_water_in_the_near_infrared(lidar_scene, passes, integrator):
    """At 1064 nm its light falls with 14.44 1/m (Kou et al. 1993, and particles): to a thousandth in 2 ns.

    A c of 15.1 1/m (Segelstein 1981) is 14 % less light after a nanosecond, and 28 % after two.
    """
    bin_ns, angle = 0.25, np.radians(5.0)
    pose, start = {"altitude": 200.0, "off_nadir_deg": 5.0}, float(surface_time_ns(200.0, angle))
    scene = lidar_scene(
        tx={**pose, "divergence_mrad": 0.1, "wavelength_nm": 1064.0},
        rx={**pose, **RECEIVER, "layout": "1x1", "field_of_view_mrad": 4.0},
        film={"time_start_ns": start, "bin_width_ns": bin_ns, "bin_count": 12},
        integrator={"type": integrator, "paths_per_pass": 2**14},
        sea={"slope_variance": "2e-5", "interior": {"type": "layered_water", "wavelength_nm": 1064.0}},
    )
    system = LidarSystem(200.0, angle, 1.3303, 1.3464, energy=ENERGY, aperture_area=AREA)
    column = WaterColumn(*(np.array([value]) for value in (0.0, 14.444, 0.075, 0.003)))
    depth = 0.5 * C0 / 1.3464 * 1e-9 * bin_ns * np.arange(13) * float(cos_water(system, angle))
    backward = float(fournier_forand(np.pi, *fournier_forand_parameters(0.04)))
    expected = column_energy(system, column, backward, depth[:-1], depth[1:], angle)
    found = passes(scene, 24)[:, 0, 1:9]
    significance.assert_equal(found, expected[1:9], error=0.03, bias=0.01)


@each_case(
    *((6.0, *place) for place in ((20.0, 0.0), (20.0, 180.0), (12.0, 120.0))),
    *((10.0, 30.0, wind_from_deg) for wind_from_deg in (0.0, 180.0)),
)
def test_surface_of_measured_slopes(wind, angle, wind_from_deg, lidar_scene, passes):
    """Cox and Munk's series at 6 m/s, looking upwind, downwind and aside: 1.19, 0.74 and 0.93 times the Gaussian.

    At 30 degrees and 10 m/s, 3.9 standard deviations of the slopes, 2.31 upwind and 0.19 times downwind.
    """
    pose = {"altitude": 200.0, "off_nadir_deg": angle}
    scene = lidar_scene(
        tx={**pose, "divergence_mrad": 0.2, "pulse_energy_mj": 4.0},
        rx={**pose, "layout": "1x1", "field_of_view_mrad": 4.0, "obscuration": 0.0},
        film={"time_start_ns": float(surface_time_ns(200.0, np.radians(angle))) - 40},
        integrator={"type": "lidar_volpath", "paths_per_pass": 2**12},
        sea={
            **{"slope_variance": "cox_munk", "wind_speed": wind, "wind_direction_deg": wind_from_deg + 180},
            **{"slope_distribution": "gram_charlier"},
        },
        water={"attenuation": 50.0, "scattering": 0.0, "backscattering": 0.0},
        bottom=None,
    )
    collection, energy = scene.sensors()[0].receiver.optics.collection, scene.emitters()[0].energy
    system = LidarSystem(200.0, np.radians(angle), 1.34, GROUP_INDEX, energy=energy * collection, aperture_area=1.0)
    along, across = 3.16e-3 * wind, 0.003 + 1.92e-3 * wind
    bearing = np.radians(wind_from_deg)
    y, x = np.tan(np.radians(angle)) * np.array([np.cos(bearing), np.sin(bearing)]) / np.sqrt([along, across])
    skewed = (0.0086 * wind - 0.01) * (x * x - 1) * y / 2 + (0.033 * wind - 0.04) * (y**3 - 3 * y) / 6
    peaked = 0.4 * (x**4 - 6 * x * x + 3) / 24 + 0.12 * (x * x - 1) * (y * y - 1) / 4
    ratio = 1 + skewed + peaked + 0.23 * (y**4 - 6 * y * y + 3) / 24
    expected = ratio * surface_energy(system, (along, across), np.radians(angle), bearing)
    samples = passes(scene, 6).sum(axis=(1, 2))
    significance.assert_equal(samples, expected, error=1e-3, bias=3e-3)


@pytest.mark.parametrize(
    "case", [QUICK, *(pytest.param(name, marks=pytest.mark.slow) for name in ("mast", "chi"))], indirect=True
)
def test_column_and_bottom_by_maps(lidar_scene, case):
    """As the next test, by maps of the beam: a wrong n^2, pi, cosine or absorption is far outside."""
    scene = lidar_scene(
        **case.scene,
        sea={"slope_variance": "2e-5"},
        water={**case.water, **case.indices},
        bottom=case.depth,
        rho=REFLECTANCE,
    )
    renderer = LightMapRenderer(find_lidar_scene(scene, scene.sensors()[0]), PathClasses(2)).scaled(8)
    energy = np.array([renderer.render_pass(seed).histogram.energy() for seed in range(16)]).reshape(16, 4, 2, 3, -1)
    bottom = per_pixel(bottom_energy_per_bin, case, case.column, case.depth, REFLECTANCE)
    lit = bottom > 0.05 * bottom.max()
    significance.assert_equal(energy[:, :, 0, 0][:, lit], bottom[lit], error=0.01, bias=5e-3)
    backscatter = per_pixel(column_energy_per_bin, case, case.column, case.backward, case.depth)
    seen = (backscatter > 0.01 * backscatter.max()) & (case.edges[1:] < case.edges[:-1][bottom.any(axis=0)].min())
    significance.assert_equal(energy[:, :, 0, 1][:, seen], backscatter[seen], error=0.01, bias=5e-3)


@both_in(CASES)
def test_column_and_bottom_of_layered_water(lidar_scene, case, integrator):
    """Bottom without scattering, and column with one event, in four pixels and in bins of 4 ns.

    The column's step at the layers' edge is the ratio of b p(180 deg); below it the upper layer's attenuation counts.
    """
    # The quick case finds 1.5 % of bottom or column, the others 3 to 7 %; the bottom of the narrow beam is noisier.
    paths = 2**14 if case.name in (QUICK, "narrow beam") else 2**13
    photons = {"photons_per_pass": paths} if integrator == "lidar_merging" and case.name != QUICK else {}
    scene = lidar_scene(
        **case.scene,
        integrator={"type": integrator, "paths_per_pass": paths, **photons},
        sea={"slope_variance": "2e-5"},
        water={**case.water, **case.indices},
        bottom=case.depth,
        rho=REFLECTANCE,
    )
    renderer = scene.integrator().prepare(scene, scene.sensors()[0], classes=PathClasses(2))
    # A pass of the reference costs a third.
    count = 16 if integrator == "lidar_merging" else 48
    # Pixels, one or several reversals, orders, bins.
    energy = np.array([renderer.render_pass(seed).histogram.energy() for seed in range(count)])
    energy = energy.reshape(count, 4, 2, 3, -1)
    bottom = per_pixel(bottom_energy_per_bin, case, case.column, case.depth, REFLECTANCE)
    lit = bottom > 0.05 * bottom.max()
    # Patches that the edge of a view much narrower than the beam cuts lose light: 0.5 to 1.6 % of the bottom.
    edge = 0.02 if case.name == "wide beam" and integrator == "lidar_merging" else 0.0
    significance.assert_equal(energy[:, :, 0, 0][:, lit], bottom[lit], error=0.04, bias=2e-3 + edge)
    backscatter = per_pixel(column_energy_per_bin, case, case.column, case.backward, case.depth)
    # Before the bottom: light that it reflects may be scattered once, too.
    seen = (backscatter > 0.01 * backscatter.max()) & (case.edges[1:] < case.edges[:-1][bottom.any(axis=0)].min())
    significance.assert_equal(energy[:, :, 0, 1][:, seen], backscatter[seen], error=0.015, bias=2e-3)


CLEAR_RIPPLED, TURBID_SMOOTH = (0.005, 0.05, 2e-3, 16), (1e-5, 0.5, 0.4, 64)


@pytest.mark.long
@pytest.mark.parametrize("case", [CLEAR_RIPPLED, TURBID_SMOOTH])
def test_beam_and_view_of_millimetres_within_decimetres(lidar_scene, passes, case):
    """Ripples spread both: the echo falls to a tenth in half a metre. Thick cells lost 20 % of it.

    In turbid water below a smooth sea scattered light leaves the view: thick cells lost 6 % of the first decimetre.

    Slopes of the variance s^2 in each direction turn light and lines of sight by D s, D = 1 - 1/n, so that a share
    1 - exp(-R^2 / 2 (sigma^2 + 2 D^2 s^2 z^2)) of the light at the depth z lies within the view of radius R.
    """
    height, index, sigma, radius = 20.0, 1.34, 2e-3, 6e-3
    bin_ns, bins, parts = 0.5, 24, 16
    variance, attenuation, scattering, count = case
    properties = attenuation, scattering, 0.5 * scattering
    water = dict(zip(("attenuation", "scattering", "backscattering"), properties, strict=True))
    water |= {"phase_function": "hg", "phase_g": 0.0}
    system = LidarSystem(height, 0.0, index, GROUP_INDEX, energy=ENERGY, aperture_area=AREA)
    column = WaterColumn(*(np.array([value]) for value in (0.0, *properties)))
    depth = 0.5 * C0 / GROUP_INDEX * 1e-9 * bin_ns / parts * np.arange(bins * parts + 1)
    whole = column_energy(system, column, henyey_greenstein(np.pi, 0.0), depth[:-1], depth[1:], 0.0)
    # Both cones widen on the way down.
    wider = (1 + 0.5 * (depth[:-1] + depth[1:]) / (index * height)) ** 2
    spread = sigma**2 * wider + 2 * (1 - 1 / index) ** 2 * variance * (0.5 * (depth[:-1] + depth[1:])) ** 2
    expected = (whole * (1 - np.exp(-0.5 * radius**2 * wider / spread))).reshape(bins, parts).sum(axis=1)
    pose = {"altitude": height, "off_nadir_deg": 0.0}
    scene = lidar_scene(
        tx={**pose, "divergence_mrad": 2e3 * sigma / height},
        rx={**pose, **RECEIVER, "field_of_view_mrad": 2e3 * radius / height, "layout": "1x1"},
        film={"time_start_ns": float(surface_time_ns(height, 0.0)), "bin_width_ns": bin_ns, "bin_count": 10 * bins},
        integrator={"type": "lidar_merging", "paths_per_pass": 2**14},
        sea={"slope_variance": str(2 * variance)},
        water={**water, "refractive_index": index, "group_index": GROUP_INDEX},
        bottom=None,
    )
    # Light of the surface falls into the first bin. The record goes on, as points are as far apart as it is long.
    found = passes(scene, count)[:, 0, 1:bins]
    significance.assert_equal(found, expected[1:], error=0.02, bias=0.01)
    # The first decimetre.
    significance.assert_equal(found[:, :2], expected[1:3], error=0.02, bias=0.01)


@pytest.mark.slow
@pytest.mark.parametrize("view", [0.001])
def test_narrow_view_of_a_wide_beam(lidar_scene, view):
    """Column with one event and bottom without scattering, in the share of the beam that a view of 0.2 to 6 mm sees.

    Ripples widen it to centimetres. Cells as narrow as the view lost 60 % of the column at 0.001 mrad.
    """
    angle, beam, depth, bin_ns = np.radians(20.0), 60.0, 8.0, 8.0
    properties = 0.2, 0.1, 0.05
    water = dict(zip(("attenuation", "scattering", "backscattering"), properties, strict=True))
    share = -np.expm1(-0.5 * (view / beam) ** 2)
    system = LidarSystem(200.0, angle, 1.34, GROUP_INDEX, energy=share * ENERGY, aperture_area=AREA)
    column = WaterColumn(*(np.array([value]) for value in (0.0, *properties)))
    surface_ns = float(surface_time_ns(200.0, angle))
    scene = lidar_scene(
        tx={"divergence_mrad": beam},
        rx={**RECEIVER, "field_of_view_mrad": view, "layout": "1x1"},
        film={"time_start_ns": surface_ns, "bin_width_ns": bin_ns, "bin_count": 12},
        integrator={"type": "lidar_merging", "paths_per_pass": 2**13, "photons_per_pass": 2**13},
        sea={"slope_variance": "1e-3"},
        water={**water, "phase_function": "hg", "phase_g": 0.0, "refractive_index": 1.34, "group_index": GROUP_INDEX},
        bottom=depth,
        rho=REFLECTANCE,
    )
    renderer = scene.integrator().prepare(scene, scene.sensors()[0], classes=PathClasses(2))
    energy = np.array([renderer.render_pass(seed).histogram.energy() for seed in range(16)]).reshape(16, 2, 3, -1)
    bottom = float(bottom_energy(system, column, depth, REFLECTANCE, angle))
    significance.assert_equal(energy[:, 0, 0, 5:].sum(axis=1), bottom, error=0.05, bias=5e-3)
    edges = 0.5 * C0 / GROUP_INDEX * 1e-9 * bin_ns * np.arange(8) * float(cos_water(system, angle))
    expected = column_energy(system, column, henyey_greenstein(np.pi, 0.0), edges[:-1], edges[1:], angle)
    significance.assert_equal(energy[:, 0, 1, :7], expected, error=0.02, bias=5e-3)


@each_case(pytest.param({}, marks=pytest.mark.long), pytest.param({"point_spacing": 0.4}, marks=pytest.mark.slow))
def test_column_ends_at_the_bottom(options, lidar_scene, passes):
    """The last tenth of a column above a black bottom; cells that it cuts lost 6 and 21 % of it."""
    height, depth, beam = 730.0, 1.4, 10.0
    surface_ns = float(surface_time_ns(height, 0.0))
    bottom_ns = float(bottom_time_ns(height, depth, 0.0, 1.34, GROUP_INDEX))
    edges = surface_ns + 2.0 + (bottom_ns + 1.0 - surface_ns) / 200 * np.array([0, 137, 200])
    system = LidarSystem(height, 0.0, 1.34, GROUP_INDEX, energy=ENERGY, aperture_area=AREA)
    water = {"attenuation": 0.15, "scattering": 2e-4, "backscattering": 1e-4, "phase_function": "hg", "phase_g": 0.0}
    column = WaterColumn(*(np.array([value]) for value in (0.0, 0.15, 2e-4, 1e-4)))
    seen = lambda x, y: np.hypot(x, y) < 15e-3  # noqa: E731
    expected = column_energy_per_bin(
        edges, system, 0.5e-3 * beam, column, [float(henyey_greenstein(np.pi, 0.0))], depth, seen
    )
    pose = {"altitude": height, "off_nadir_deg": 0.0}
    scene = lidar_scene(
        tx={**pose, "divergence_mrad": beam},
        rx={**pose, **RECEIVER, "field_of_view_mrad": 30.0, "layout": "1x1"},
        film={"time_start_ns": edges[0], "bin_width_ns": (edges[2] - edges[0]) / 200, "bin_count": 200},
        integrator={"type": "lidar_merging", **options},
        sea={"slope_variance": "2e-5"},
        water={**water, "refractive_index": 1.34, "group_index": GROUP_INDEX},
        bottom=depth,
        rho=0.0,
    )
    found = passes(scene, 12)[:, 0]
    significance.assert_equal(found[:, :137].sum(axis=1), expected[0], error=0.01, bias=0.005)
    significance.assert_equal(found[:, 137:].sum(axis=1), expected[1], error=0.01, bias=0.006)


def test_efficiencies_scale_the_energy(lidar_scene, passes):
    """Once, not squared and not twice: the same seed gives the same paths, so the ratio is exact."""
    dark = {"attenuation": 0.1, "scattering": 0.0, "backscattering": 0.0}
    few = {"type": "lidar_volpath", "paths_per_pass": 2**10}
    common = {"integrator": few, "water": dark, "film": {"time_start_ns": 1450.0}}
    unchanged = passes(lidar_scene(**common), 1).sum()
    for change, factor in (
        ({"tx": {"optical_efficiency": 0.45}}, 0.5),
        ({"tx": {"pulse_energy_mj": 10.0}}, 2.0),
        ({"rx": {"optical_efficiency": 0.3}}, 1 / 3),
        ({"rx": {"aperture_area": 0.1}}, 4.0),
        ({"rx": {"two_way_atmospheric_transmittance": 0.45}}, 0.5),
        ({"rx": {"obscuration": 0.3}}, 0.7),
        ({"rho": 0.3}, 3.0),
    ):
        changed = passes(lidar_scene(**common, **change), 1).sum()
        # Light reflected twice by the bottom goes as the square of the reflectance.
        assert changed / unchanged == pytest.approx(factor, rel=2e-3 if "rho" in change else 1e-5), change
