"""Layered water under Mitsuba's own volumetric path tracer, and phase functions layer by layer."""

import mitsuba as mi
import numpy as np
import pytest
from rows import each_case
from significance import assert_same

HG = {"type": "hg", "g": 0.6}
WATER = {"attenuation": 0.6, "scattering": 0.5, "backscattering": 0.02}


def radiance(medium):
    """Render a sunlit box of an index-matched medium, 3 m deep, with Mitsuba's own `volpath`."""
    transform = mi.ScalarTransform4f
    scene = mi.load_dict(
        {
            "type": "scene",
            "integrator": {"type": "volpath", "max_depth": 64, "rr_depth": 64},
            "sensor": {
                "type": "perspective",
                "fov": 30,
                "to_world": transform().look_at(origin=[3, -2, 6], target=[0, 0, -1.5], up=[0, 0, 1]),
                "film": {
                    "type": "hdrfilm",
                    "width": 4,
                    "height": 4,
                    "rfilter": {"type": "box"},
                    "pixel_format": "luminance",
                    "component_format": "float32",
                },
            },
            "sun": {"type": "directional", "direction": [0.2, 0.1, -1], "irradiance": 1.0},
            "box": {
                "type": "cube",
                "to_world": transform().translate([0, 0, -1.5]).scale([4, 4, 1.5]),
                "bsdf": {"type": "null"},
                "interior": medium,
            },
        }
    )
    return np.array([mi.render(scene, spp=256, seed=seed) for seed in range(4)])[..., 0]


def assert_same_light(first, second):
    """Same seeds, same walks: equal to rounding, which moves a walk at a layer's edge now and then."""
    np.testing.assert_allclose(first.mean(axis=(0, 1, 2)), second.mean(axis=(0, 1, 2)), rtol=1e-3)
    assert np.mean(np.isclose(first, second, rtol=1e-4)) > 0.95


@pytest.mark.slow
@each_case(
    ({"phase": HG}, HG),
    ({"phase_function": "hg", "phase_g": 0.6}, HG),
    ({"phase_function": "petzold"}, {"type": "petzold"}),
    ({}, {"type": "fournier_forand", "backscatter_ratio": 0.04}),
)
def test_volpath_sees_homogeneous_water_as_mitsubas_medium(change, phase):
    """Albedo for scattering would be 1.7 times the light; water without a phase function 3 to 10 times."""
    reference = {"type": "homogeneous", "sigma_t": 0.6, "albedo": 0.5 / 0.6, "phase": phase}
    assert_same_light(radiance({"type": "layered_water", **WATER, **change}), radiance(reference))


@pytest.mark.slow
def test_volpath_sees_layers_as_mitsubas_grid():
    """Depth counts downwards from z = 0: layers upside down would double the light."""

    def grid(values):
        return {
            "type": "gridvolume",
            "grid": mi.VolumeGrid(np.array(values, dtype=np.float32).reshape(3, 1, 1)),
            "filter_type": "nearest",
            "to_world": mi.ScalarTransform4f().translate([-4, -4, -3]).scale([8, 8, 3]),
        }

    layers = {"layer_tops": "0, 1", "attenuation": "0.3, 0.9", "scattering": "0.25, 0.4", "backscattering": 0.01}
    # The grid's first value is the lowest metre.
    reference = {
        "type": "heterogeneous",
        "sigma_t": grid([0.9, 0.9, 0.3]),
        "albedo": grid([0.4 / 0.9, 0.4 / 0.9, 0.25 / 0.3]),
        "phase": HG,
    }
    assert_same_light(radiance({"type": "layered_water", **layers, "phase": HG}), radiance(reference))


def single_scattering(lidar_scene, passes, water, first_seed=0):
    """Return energies of two gates, above and below 3 m, over the passes."""
    scene = lidar_scene(
        integrator={"max_scatterings": 1, "paths_per_pass": 2**14},
        rx={"layout": "1x1"},
        water={"attenuation": 0.3, "scattering": 0.15, "backscattering": 0.006, **water},
        bottom=None,
    )
    energy = passes(scene, 24, first_seed)[:, 0]
    # 3 m are 27.7 ns after the surface at 1420 ns, and the beam spreads an echo by 8 ns to either side.
    return np.stack([energy[:, 35:46].sum(axis=1), energy[:, 70:90].sum(axis=1)], axis=1)


@pytest.fixture(scope="module")
def homogeneous():
    """Function that returns `single_scattering` of water with one phase function, from the seed 100, rendered once."""
    found = {}

    def render(lidar_scene, passes, phase):
        if str(phase) not in found:
            found[str(phase)] = single_scattering(lidar_scene, passes, {"phase": phase}, 100)
        return found[str(phase)]

    return render


#: Its value at 180 degrees is 0.5 / (4 pi 1.5^2) = 0.0177 /sr.
WIDE = {"type": "hg", "g": 0.5}
BLEND = {"type": "blendphase", "weight": 0.3, "phase_0": {"type": "hg", "g": 0.5}, "phase_1": {"type": "rayleigh"}}


@each_case(
    # Part of the blend.
    pytest.param({"type": "rayleigh"}, marks=pytest.mark.long),
    pytest.param(BLEND, marks=pytest.mark.slow),
    pytest.param({"type": "isotropic"}, marks=pytest.mark.long),
    pytest.param({"type": "two_term_henyey_greenstein"}, marks=pytest.mark.slow),
)
def test_column_follows_the_phase_function_at_180_degrees(phase, lidar_scene, passes, homogeneous):
    """The closed form at 180 degrees against that of Henyey-Greenstein, for Mitsuba's own phase functions too."""
    backward = {
        "rayleigh": 3 / (8 * np.pi),
        "isotropic": 1 / (4 * np.pi),
        "blendphase": 0.7 * 0.5 / (4 * np.pi * 1.5**2) + 0.3 * 3 / (8 * np.pi),
        "two_term_henyey_greenstein": (0.98 * 0.1 / 1.9**2 + 0.02 * 1.3 / 0.7**2) / (4 * np.pi),
    }[phase["type"]]
    samples = single_scattering(lidar_scene, passes, {"phase": phase})
    reference = homogeneous(lidar_scene, passes, WIDE)
    # Light that comes back within 0.1 degree of 180 adds less than 1e-4.
    assert_same(samples, reference * backward * 4 * np.pi * 1.5**2 / 0.5, error=0.03)


def test_profile_file_is_its_layers(tmp_path):
    """A gradient: each layer has the coefficients of its middle."""
    path = tmp_path / "gradient.csv"
    path.write_text("depth, c, b, bb_ratio\n0, 0.2, 0.1, 0.02\n8, 0.6, 0.3, 0.04\n")
    column = mi.load_dict({"type": "layered_water", "profile": str(path)}).water.column
    depth = 0.5 * (column.layer_tops + np.append(column.layer_tops[1:], 8.0))
    for name, top, rise in (("attenuation", 0.2, 0.05), ("scattering", 0.1, 0.025), ("backscattering", 0.002, 0.00125)):
        np.testing.assert_allclose(getattr(column, name), top + rise * depth, rtol=1e-9)
