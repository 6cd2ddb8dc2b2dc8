"""The fast integrator against the unbiased reference: light by origin, or by order of scattering, in gates and pixels.

Each scene holds several things in which the integrators differ; light by origin tells them apart.
"""

import mitsuba as mi
import numpy as np
import pytest
import significance

from mitransient_lidar.loading import catalogue
from mitransient_lidar.loading.scenes import open_scene
from mitransient_lidar.transport.paths.passes import PathClasses

INTEGRATORS = ["lidar_merging", "lidar_volpath"]
WAVES = {"spectrum": "elfouhaily", "wind_speed": 3.0, "slope_variance": "cox_munk"}
ROUGH = {"slope_variance": "0.01"}
INCLINED = {**ROUGH, "slope_x_deg": 6.0, "slope_y_deg": -4.0}
LAYERS = {"layer_tops": "0, 3", "attenuation": "0.9, 0.5", "scattering": "0.7, 0.35", "backscattering": "0.014, 0.007"}
LAYERS |= {"phase_function": "hg", "phase_g": 0.6}
BUBBLES = {"plume_scattering": 1.5, "plume_width": 3.0, "plume_depth": 2.0, "plume_bearing_deg": 60.0, "plume_x": 1.0}
TURBID = {"attenuation": 1.0, "scattering": 0.8, "backscattering": 0.016}
#: Scattering by a smooth phase function: the reference connects forward peaks to the laser with few large values.
SMOOTH = {"attenuation": 0.4, "scattering": 0.3, "backscattering": 0.006, "phase_function": "hg", "phase_g": 0.6}
STRATA = {"layer_tops": "0, 1", "refractive_index": "1.2, 1.0001", "attenuation": 0.6, "scattering": 0.55}
STRATA |= {"phase_function": "hg", "phase_g": 0.3}


def diffuse(value):
    return {"type": "diffuse", "reflectance": {"type": "spectrum", "value": value}}


def plate(x, y, z, half, bsdf, tilt=0.0):
    to_world = mi.ScalarTransform4f().translate([x, y, z]).rotate([0, 1, 0], tilt).scale(half)
    return {"type": "rectangle", "to_world": to_world, "bsdf": bsdf}


def look_from(*origin):
    return {"to_world": mi.ScalarTransform4f().look_at(list(origin), [0, 0, 0], [0, 0, 1])}


def pose(altitude, off_nadir_deg):
    return {"altitude": altitude, "off_nadir_deg": off_nadir_deg}


SAND = {"type": "seabed", "ripple_height": 0.06, "ripple_length": 0.4, "slope_x_deg": 8.0, "size": 100.0}
SPHERE = {"type": "sphere", "center": [0.3, 0.8, -5.0], "radius": 0.6, "bsdf": diffuse(0.5)}
SOLIDS = {
    "bottom": SAND,
    "sphere": SPHERE,
    "half_buried": {"type": "sphere", "center": [2.2, 0, -7.8], "radius": 0.6, "bsdf": diffuse(0.4)},
    "tilted_plate": plate(0.9, -1.4, -6.0, 0.6, diffuse(0.3), tilt=35.0),
    "cylinder": {
        "type": "cylinder",
        **{"p0": [2.6, 1.2, -6], "p1": [2.6, 1.2, -4], "radius": 0.4},
        "bsdf": {"type": "twosided", "bsdf": diffuse(0.4)},
    },
}
GREY = np.random.default_rng(1).random((6, 4, 1), np.float32)
MARKED = {"type": "diffuse", "reflectance": {"type": "bitmap", "raw": True, "bitmap": mi.Bitmap(GREY)}}
TILED = {"type": "bitmap", "raw": True, "bitmap": mi.Bitmap(0.4 * GREY), "to_uv": mi.ScalarTransform3f().scale(0.2)}
MATERIALS = {
    "bottom": {
        "type": "seabed",
        "size": 100.0,
        "bsdf": {"type": "diffuse", "reflectance": {"type": "bitmap", **TILED}},
    },
    "half_transparent": plate(0.4, 0.9, -4.0, 0.6, {"type": "mask", "opacity": 0.4, "nested": MARKED}),
    "rough_metal": plate(1.6, -0.9, -5.0, 0.7, {"type": "roughconductor", "alpha": 0.3}, tilt=10.0),
    "retroreflector": plate(
        *(2.6, 1.0, -5.5, 0.5), {"type": "retroreflector", "width_deg": 6.0, "diffuse_share": 0.2}, tilt=20.0
    ),
}
DRY = {
    "veil_in_the_air": plate(-0.6, 0.2, 1.2, 0.6, {"type": "mask", "opacity": 0.5, "nested": diffuse(0.2)}),
    "in_the_air": plate(0.5, 0.8, 1.0, 0.5, diffuse(0.3)),
    "through_the_surface": plate(0.5, -0.6, 0.0, 0.7, diffuse(0.3), tilt=80.0),
}
PARTICLES = {"type": "sediment", "model": "hapke", "reflectance": 0.2, "lobe_asymmetry": 0.4, "backward_share": 0.8}
PATCHES = {"type": "seabed", "slope_x_deg": 6.0, "slope_y_deg": -3.0, "size": 100.0, "patches": "2 0 1 0.4; 3 1 1 0"}
#: From 0.1 to 0.6 m deep in the field of view, where deep waves of 10 m/s would be 2.6 m high.
SHALLOW = {"type": "seabed", "depth": 0.35, "slope_x_deg": 5.0, "reflectance": 0.2, "size": 40.0}
BALL = {"type": "sphere", "center": [0.1, 0.05, -4.0], "radius": 0.2, "bsdf": {"type": "diffuse"}}
#: Bins of a record [ns]: start, width, number.
FROM_200_M = 1400.0, 2.0, 70

#: Of each scene: what differs from the table system, record, bins of a gate, and the largest relative standard error of
#: the comparison of all light. None: the origins are separated; else the number of orders of scattering.
CASES = {
    "layers and bubbles under waves": ({"sea": WAVES, "water": LAYERS | BUBBLES}, FROM_200_M, 3, 0.03, None),
    "sand below bubbles of a windy sea": (
        {
            **{"sea": ROUGH, "water": {"bubble_wind_speed": 20.0}, "bottom": None},
            "extra": {
                "bottom": plate(0.0, 0.0, -8.0, 500.0, PARTICLES),
                "plate": plate(1.6, -0.9, -5.0, 0.7, {**PARTICLES, "reflectance": 0.3}, tilt=30.0),
            },
        },
        *(FROM_200_M, 5, 0.03, None),
    ),
    "turbid, by order": ({"sea": ROUGH, "water": TURBID, "bottom": 4.0}, FROM_200_M, 5, 0.03, 4),
    "solids below an inclined sea": ({"sea": INCLINED, "bottom": None, "extra": SOLIDS}, FROM_200_M, 5, 0.02, None),
    "materials and bitmaps": ({"sea": ROUGH, "bottom": None, "extra": MATERIALS}, FROM_200_M, 5, 0.03, None),
    "mirror and sphere in strata": (
        {
            "sea": ROUGH,
            "water": {**SMOOTH, "layer_tops": "0, 1", "refractive_index": "1.34, 1.25", "group_index": "1.36, 1.3"},
            **{"bottom": 2.5, "rho": 0.6},
            "extra": {
                # It faces the beam.
                "mirror": plate(-0.3, -0.9, -1.8, 0.5, {"type": "conductor"}, tilt=-15.0),
                "sphere": {**SPHERE, "center": [-0.2, 0.8, -1.6]},
            },
        },
        *(FROM_200_M, 5, 0.1, None),
    ),
    "plates in the air": ({"sea": ROUGH, "extra": DRY}, FROM_200_M, 5, 0.01, None),
    "patches on a slope": ({"sea": ROUGH, "bottom": None, "extra": {"bottom": PATCHES}}, FROM_200_M, 5, 0.02, None),
    "waves over a shallow slope": (
        {"sea": {**WAVES, "wind_speed": 10.0}, "bottom": None, "extra": {"bottom": SHALLOW}},
        *((1400.0, 1.0, 80), 5, 0.01, None),
    ),
    "50 m aside over waves": ({"rx": look_from(-40.0, 50.0, 190.0), "sea": WAVES}, (1370.0, 2.0, 70), *(5, 0.01, None)),
    "150 m aside": (
        {
            **{"tx": {"off_nadir_deg": 0.0}, "rx": look_from(150.0, 0.0, 200.0), "sea": {"slope_variance": "1e-4"}},
            "water": {"attenuation": 0.3, "scattering": 0.05, "phase_function": "hg", "phase_g": 0.9},
        },
        (1500.0, 5.0, 30),
        *(2, 0.05, 3),
    ),
    "mast, 1 m aside over waves": (
        {
            "tx": pose(20.0, 15.0),
            "rx": {**pose(20.0, 15.0), "aim_y": 1.0, "field_of_view_mrad": 120.0, "layout": "1x1"},
            "sea": WAVES,
        },
        (120.0, 4.0, 40),
        *(3, 0.04, None),
    ),
    "mast at 60 degrees": (
        {
            "tx": {**pose(20.0, 60.0), "divergence_mrad": 2.0},
            "rx": {**pose(20.0, 60.0), "field_of_view_mrad": 20.0},
            **{"sea": WAVES, "bottom": 3.0},
        },
        (250.0, 2.0, 70),
        *(5, 0.03, None),
    ),
    "from orbit over waves": (
        {
            "tx": {**pose(5e5, 20.0), "divergence_mrad": 0.004, "pulse_energy_mj": 1e3},
            "rx": {**pose(5e5, 20.0), "field_of_view_mrad": 0.012, "aperture_area": 10.0},
            "sea": WAVES,
        },
        (3549700.0, 4.0, 70),
        *(3, 0.02, None),
    ),
    "narrow beam over waves": (
        {"tx": {"divergence_mrad": 0.5}, "rx": {"field_of_view_mrad": 20.0}, "sea": WAVES, "bottom": 4.0},
        *(FROM_200_M, 5, 0.03, None),
    ),
    # Beam and view spread by their own width within centimetres of water, far from the mean level of the sea.
    "view as narrow as the beam": (
        {
            "tx": {**pose(20.0, 20.0), "divergence_mrad": 0.2},
            "rx": {**pose(20.0, 20.0), "field_of_view_mrad": 0.6},
            # The reference finds the bottom by few bright paths.
            **{"sea": {**WAVES, "wind_speed": 6.0}, "bottom": None},
        },
        (140.0, 0.5, 160),
        *(2, 0.03, None),
    ),
    "narrow view at 75 degrees": (
        {
            "tx": {**pose(20.0, 75.0), "divergence_mrad": 1.0},
            "rx": {**pose(20.0, 75.0), "field_of_view_mrad": 3.0},
            **{"sea": {**WAVES, "wind_speed": 5.0}, "bottom": None},
        },
        (510.0, 1.0, 110),
        *(4, 0.02, None),
    ),
    # One table of heights below all of the beam would not resolve the waves: the water, of which alone this record is,
    # would scatter six times as much from pass to pass.
    "beam of 2 rad over waves": (
        {"tx": {"divergence_mrad": 2000.0}, "rx": {"layout": "1x1"}, **{"sea": WAVES, "bottom": None, "water": SMOOTH}},
        (1432.0, 5.0, 14),
        *(2, 0.03, None),
    ),
    # Scattered light prevails where the beam itself stays narrow.
    "narrow beam in turbid, smooth water": (
        {
            "tx": {"divergence_mrad": 0.2},
            "rx": {"field_of_view_mrad": 3.0},
            **{"sea": {"slope_variance": "1e-4"}, "bottom": None},
            "water": {**TURBID, "attenuation": 0.5, "scattering": 0.4, "phase_function": "hg", "phase_g": 0.5},
        },
        (1410.0, 5.0, 18),
        *(2, 0.02, None),
    ),
    "elliptic beam": (
        {
            "tx": {"divergence_mrad": 2.0, "divergence_across_mrad": 15.0},
            "rx": {"field_of_view_mrad": 20.0},
            "sea": ROUGH,
        },
        *(FROM_200_M, 5, 0.02, None),
    ),
    "below a boat, at a target": (
        {
            "tx": {**pose(-1.0, 30.0), "divergence_mrad": 60.0},
            "rx": {**pose(-1.0, 30.0), "field_of_view_mrad": 150.0},
            **{"sea": WAVES, "water": SMOOTH, "bottom": 6.0, "extra": {"ball": BALL}},
        },
        (9.0, 2.0, 48),
        *(4, 0.03, None),
    ),
    "a diver looks up": (
        {
            "tx": {**pose(-5.0, 180.0), "divergence_mrad": 60.0},
            "rx": {**pose(-5.0, 180.0), "field_of_view_mrad": 150.0},
            **{"sea": WAVES, "water": SMOOTH},
        },
        (9.0, 2.0, 48),
        *(4, 0.03, None),
    ),
    "strata of other indices, by order": ({"sea": ROUGH, "water": STRATA, "bottom": 6.0}, *(FROM_200_M, 5, 0.05, 4)),
}


def separated(scene, integrator, paths, classes, count, first_seed, gate):
    """Return energies of passes in classes of light and gates, shape (passes, pixels, classes, gates)."""
    photons = {"photons_per_pass": paths} if integrator == INTEGRATORS[0] else {}
    engine = mi.load_dict({"type": integrator, "paths_per_pass": paths, **photons}, parallel=False)
    renderer = engine.prepare(scene, scene.sensors()[0], classes=classes)
    if classes is None:
        renderer = renderer.by_origin()
    pixels = renderer.scene.receiver.pixels.count
    energy = np.array([renderer.render_pass(first_seed + k).histogram.energy() for k in range(count)])
    energy = energy[..., : energy.shape[-1] // gate * gate]
    return energy.reshape(count, pixels, -1, energy.shape[-1] // gate, gate).sum(axis=-1)


@pytest.fixture(scope="module")
def both(request):
    """Function that renders a case with both integrators, once: energies of passes, see `separated`."""
    found = {}

    def render(name, lidar_scene):
        if name not in found:
            change, (start, width, count), gate, _, orders = CASES[name]
            film = {"time_start_ns": start, "bin_width_ns": width, "bin_count": count}
            # But for one, merged light is known better from a tenth of the time.
            passes = (8, 16) if name == MIXED else (10, 24, 2**15 if name == NOISY else 2**14)
            found[name] = pair(lidar_scene(film=film, **change), PathClasses(orders) if orders else None, gate, *passes)
        return found[name]

    return render


def pair(scene, classes, gate, merged=10, reference=32, paths=2**15):
    """Return energies of both integrators, in numbers of passes; `paths` and as many photons are merged in each."""
    first = separated(scene, INTEGRATORS[0], paths, classes, merged, 0, gate)
    return first, separated(scene, INTEGRATORS[1], 2**15, classes, reference, 1000, gate)


def assert_same_light(merged, reference, error):
    """Compare pixels, and all of them together, where more is known; the blur of cells is allowed 0.5 %."""
    significance.assert_same(merged, reference, error=error, bias=0.005, known=0.08, alike=True)
    significance.assert_same(merged.sum(axis=1), reference.sum(axis=1), error=error, bias=0.005, known=0.05)
    # Each class, however noisy: one integrator may lack it.
    classes = merged.sum(axis=(1, 3)), reference.sum(axis=(1, 3))
    significance.assert_same(*classes, error=error, bias=0.005, known=0.3, faint=1e-4, lacking=True)


#: In the quick tier: half of the passes find light that the complement or the roulette lose, by 57 and 8 standard
#: errors.
MIXED = "mirror and sphere in strata"
#: Where merged light is what is noisy.
NOISY = "beam of 2 rad over waves"
#: In the long tier, as others have what they test: seabeds, receivers aside, beams in views, poses under water, strata
#: (the quick case) and turbid water (the layers). Closed forms cover solids, plates in the air, masts, poses under
#: water, beam and view of millimetres over ripples, and the opposition effect.
SLOW = {"layers and bubbles under waves", "materials and bitmaps", "waves over a shallow slope"}


def tier_of(name):
    return [] if name == MIXED else pytest.mark.slow if name in SLOW else pytest.mark.long


@pytest.mark.parametrize("name", [pytest.param(name, marks=tier_of(name)) for name in CASES])
def test_integrators_agree(lidar_scene, both, name):
    assert_same_light(*both(name, lidar_scene), CASES[name][3])


#: So fine that each pixel has 200 bins between surface echo and end of bottom echo; shorter where the bottom is at 5 m.
BINS = {"bin_width_ns": 0.4}
SHORT_BINS = {"bin_width_ns": 0.25}


@pytest.mark.long
@pytest.mark.parametrize("name", [name for name in catalogue.scene_names() if name != "passive_sea"])
def test_integrators_agree_in_shipped_scenes(name):
    """All scenes that are shipped, images as four pixels; all pixels together, whose means have fewer outliers."""
    bins = dict(SHORT_BINS if "shot" in name else BINS)
    if name.startswith("gated"):
        bins["layout"] = "2x2"
    scene = open_scene(name, bins).scene
    merged, reference = (energy.sum(axis=1, keepdims=True) for energy in pair(scene, None, 10))
    assert_same_light(merged, reference, 0.1)
