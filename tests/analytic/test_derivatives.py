"""Derivatives: against arrival times, orders of scattering, and scenes with other values."""

import compare_derivatives
import numpy as np
import pytest
import significance

from mitransient_lidar.core.constants import C0
from mitransient_lidar.physics.water.phase import fournier_forand, fournier_forand_parameters
from mitransient_lidar.rendering.derivatives import path_parameters
from mitransient_lidar.transport.paths.passes import PathClasses

pytestmark = pytest.mark.slow

INTEGRATORS = ("lidar_merging", "lidar_volpath")
SMALL = {
    "lidar_merging": {"paths_per_pass": 2**13, "photons_per_pass": 2**13},
    "lidar_volpath": {"paths_per_pass": 2**14},
}
INDEX = 1.34
#: Energy [J] whose sums, in integers, have rounding errors below 1e-5.
EXACT = 1e-14
#: Water without and with a phase function that follows from its coefficients.
FIXED = {"attenuation": 0.5, "scattering": 0.35, "phase_function": "petzold"}
#: Parameters of tests that share their kernels.
SHARED = ["attenuation", "bottom_reflectance", "divergence_mrad", "ripple_variance"]
NATURAL = {"attenuation": 0.4, "scattering": 0.3, "backscattering": 0.008}
LAYERS = {"layer_tops": "0, 3", "attenuation": "0.5, 0.3", "scattering": "0.35, 0.2", "backscattering": "0.01, 0.003"}


@pytest.fixture
def lidar(lidar_scene):
    """Return the renderer of a scene at nadir with an integrator, perturbed by parameters, and these."""

    def prepare(integrator, names=(), classes=None, water=None, **options):
        pose = {"off_nadir_deg": 0.0, **options.pop("pose", {})}
        beam = {**pose, **options.pop("tx", {})}
        loaded = lidar_scene(
            integrator={"type": integrator, **SMALL[integrator]},
            tx=beam,
            rx={**pose, "layout": "1x1", "field_of_view_mrad": 30},
            film={"time_start_ns": 1320.0, "bin_count": 160, **options.pop("film", {})},
            water=water or FIXED,
            **options,
        )
        renderer = loaded.integrator().prepare(loaded, loaded.sensors()[0], classes=classes)
        parameters = path_parameters(renderer, names)
        return renderer.perturbed([one.perturbation for one in parameters]), parameters

    return prepare


def one_pass(renderer, seed=0):
    """Return the energies of a pass, and their perturbations, with pixels and bins last."""
    histogram = renderer.render_pass(seed).histogram
    return histogram.energy(), histogram.perturbed()


def by_origin(renderer, name, seed=0):
    """Return the energies of a pass by origin, and their perturbations by a shared parameter, with bins last."""
    energy, changes = one_pass(renderer.by_origin(), seed)
    return energy.reshape(3, -1), changes.reshape(len(SHARED), 3, -1)[SHARED.index(name)]


@pytest.mark.parametrize("integrator", INTEGRATORS)
def test_attenuation_follows_from_the_time_of_arrival(lidar, integrator):
    """With b fixed, ln E falls by the length in water, (c0 t - length in air) / n, summed over layers.

    Ways in the air at nadir are 400 m, up to 0.07 m more for light that leaves the water 4 m away on either side.
    """
    renderer, parameters = lidar(integrator, ["attenuation"], water={**LAYERS, "phase_function": "petzold"})
    assert [one.name for one in parameters] == ["attenuation[0]", "attenuation[1]"]
    energy, changes = one_pass(renderer)
    lit = energy[0] > EXACT
    length = -changes.sum(axis=0)[0][lit] / energy[0][lit]
    edges = renderer.scene.axis.edges_ns * 1e-9 * C0
    shortest, longest = (edges[:-1] - 400.07) / INDEX, (edges[1:] - 400.0) / INDEX
    assert lit.sum() > 40
    assert np.all(length > shortest[lit] - 1e-3)
    assert np.all(length < longest[lit] + 1e-3)
    # Light that returns from above 2.5 m has not met the second layer.
    early = edges[1:] < 400.0 + 2 * 2.5 * INDEX
    assert not changes[1, 0][early].any()
    assert changes[0, 0][early].any()


def test_attenuation_of_light_that_is_carried_on_within_cells(lidar):
    """Bins of 2 cm below the surface have the lengths of their times, with the way of merged light within its cell."""
    film = {"time_start_ns": 1334.2, "bin_width_ns": 0.1, "bin_count": 60}
    renderer, _ = lidar("lidar_merging", SHARED, tx={"divergence_mrad": 1.0}, film=film)
    # Of the water.
    water, change = (values[1] for values in by_origin(renderer, "attenuation"))
    lit = water > 1e-3 * water.max()
    length = -change[lit] / water[lit]
    edges = renderer.scene.axis.edges_ns * 1e-9 * C0
    assert lit.sum() > 50
    assert np.all(length > (edges[:-1][lit] - 400.003) / INDEX - 1e-4)
    assert np.all(length < (edges[1:][lit] - 400.0) / INDEX + 1e-4)


def test_attenuation_about_a_lidar_under_water(lidar):
    """All of the way is in water: ln E falls by c0 t / n."""
    renderer, _ = lidar(
        "lidar_volpath", ["attenuation"], pose={"altitude": -1.0}, film={"time_start_ns": 0.5, "bin_count": 90}
    )
    energy, changes = one_pass(renderer)
    lit = energy[0] > EXACT
    length = -changes[0, 0][lit] / energy[0][lit]
    edges = renderer.scene.axis.edges_ns * 1e-9 * C0 / INDEX
    assert lit.sum() > 30
    assert np.all((length > edges[:-1][lit] - 1e-3) & (length < edges[1:][lit] + 1e-3))


@pytest.mark.parametrize("integrator", INTEGRATORS)
def test_scattering_follows_from_the_number_of_events(lidar, integrator):
    """With attenuation and phase function fixed, light of n scattering events is in proportion to b^n."""
    orders = 9
    renderer, _ = lidar(integrator, ["scattering"], classes=PathClasses(orders=orders))
    energy, changes = (values.reshape(-1, 2, orders + 1, 160) for values in one_pass(renderer))
    for n in range(orders):
        lit = energy[:, :, n] > EXACT
        found = changes[:, :, n][lit] / energy[:, :, n][lit]
        np.testing.assert_allclose(found, n / FIXED["scattering"], rtol=1e-4, atol=1e-6)
    assert (energy.sum(axis=(0, 1, 3)) > 0).all()


@pytest.mark.parametrize("integrator", ["lidar_volpath", pytest.param("lidar_merging", marks=pytest.mark.long)])
def test_light_scattered_once_follows_from_the_phase_function(lidar, integrator):
    """E of one event is in proportion to b p(180 degrees), and bb/b decides the Fournier-Forand function p.

    By b, ln E grows by 1 / b less what p loses as bb/b falls; by bb it grows with p alone. A beam of 1 mrad in a view
    of 30 mrad, both at nadir, is scattered within 30 mrad of straight back, where p is level.
    """
    names = "scattering", "backscattering"
    b, bb = (NATURAL[name] for name in names)
    renderer, _ = lidar(integrator, names, PathClasses(orders=2), water=NATURAL, tx={"divergence_mrad": 1.0})
    # One event and one reversal, before the echo of the bottom at 1406 ns.
    energy, changes = (values.reshape(-1, 2, 3, 160)[:, 0, 1, :80].sum(axis=1) for values in one_pass(renderer))
    ratio, step = bb / b, 1e-3 * bb / b
    sides = [np.log(fournier_forand(np.pi, *fournier_forand_parameters(ratio + sign * step))) for sign in (1, -1)]
    by_ratio = (sides[0] - sides[1]) / (2 * step)
    wanted = [1 / b - by_ratio * ratio / b, by_ratio / b]
    np.testing.assert_allclose(changes / energy, wanted, rtol=3e-3)


@pytest.mark.parametrize("integrator", ["lidar_volpath", pytest.param("lidar_merging", marks=pytest.mark.long)])
def test_reflectance_follows_from_the_number_of_reflections(lidar, integrator):
    """Light that has not met the bottom does not change; nearly all other light has met it once."""
    renderer, _ = lidar(integrator, SHARED, rho=0.3)
    energy, changes = by_origin(renderer, "bottom_reflectance")
    assert not changes[:2].any()
    times = 0.3 * changes[2].sum() / energy[2].sum()
    assert 1 - 1e-6 < times < 1.02
    assert energy[:2].any()


@pytest.mark.parametrize("integrator", INTEGRATORS)
def test_ripple_variance_of_an_echo_off_nadir(lidar, integrator):
    """Gaussian slopes of variance v in all, seen at 20 degrees: d ln E / d ln v = tan(20 degrees)^2 / v - 1."""
    options = {"pose": {"off_nadir_deg": 20.0}, "tx": {"divergence_mrad": 0.1}, "sea": {"slope_variance": "0.01"}}
    renderer, _ = lidar(integrator, SHARED, **options)
    energy, changes = (values[0].sum() for values in by_origin(renderer, "ripple_variance"))
    assert 0.01 * changes / energy == pytest.approx(np.tan(np.deg2rad(20)) ** 2 / 0.01 - 1, rel=1e-4)


@pytest.mark.parametrize("integrator", ["lidar_volpath", pytest.param("lidar_merging", marks=pytest.mark.long)])
def test_divergence_of_a_beam_that_overfills_the_view(lidar, integrator):
    """Of a bottom in water that only absorbs, E is in proportion to 1 - exp(-R^2 / (2 sigma^2))."""
    water = {**FIXED, "attenuation": 0.3, "scattering": 0.0, "backscattering": 0.0}
    options = {"sea": {"slope_variance": "2e-5"}, "tx": {"divergence_mrad": 30.0}}
    renderer, parameters = lidar(integrator, SHARED, water=water, **options)
    assert parameters[SHARED.index("divergence_mrad")].value == pytest.approx(30)
    passes = (by_origin(renderer, "divergence_mrad", seed) for seed in range(16))
    # Of the bottom.
    found = np.array([[values[2].sum() for values in one] for one in passes])
    share = np.exp(-0.5) / (1 - np.exp(-0.5))
    # d ln E / d ln sigma, from both sums of each pass.
    significance.assert_equal(-30 * found[:, 1:] / found[:, :1].mean(), np.array([share]), error=0.03, bias=0.004)


@pytest.mark.parametrize(("case", "integrator", "names"), [("layered", "lidar_volpath", ["backscattering[0]"])])
def test_paths_against_differences(case, integrator, names):
    """Bins and sums over them, against central differences on common random numbers (`compare_derivatives`)."""
    passes, paths = 10, 2**12 if integrator == "lidar_merging" else 2**14
    samples = compare_derivatives.sample(case, integrator, passes, paths, only=names)
    for z, ratio, error in compare_derivatives.compare(samples).values():
        assert z.size > 20
        assert np.abs(z).max() < significance.largest_z(10**6, z.size)
        assert error < significance.largest_error(passes, 0.05)
        assert abs(ratio - 1) < 1e-3 + significance.largest_z(passes) * error, ratio


def test_comparison_finds_a_derivative_that_is_off():
    """Made passes, 2 % of noise: 1 % is found in the sums, also of derivatives of both signs, and 30 % in one bin."""
    passes, bins = 32, 40
    rng = np.random.default_rng(5)
    slope = np.concatenate([np.full(bins // 2, 2.0), np.full(bins // 2, -1.0)])
    light = rng.normal(1, 0.02, (2, passes, 1, 1, bins)) * slope
    energy = rng.normal(1, 0.02, (passes, 1, bins))

    def compared(factor):
        made = compare_derivatives.Samples(["c"], np.ones(1), energy, factor * light[0], light[1])
        return compare_derivatives.compare(made)["c"]

    z, ratio, error = compared(np.ones(bins))
    assert np.abs(z).max() < significance.largest_z(10**6, bins)
    assert error < significance.largest_error(passes, 9e-4)
    assert abs(ratio - 1) < significance.largest_z(passes) * error
    _, ratio, error = compared(np.full(bins, 1.01))
    assert abs(1.01 * ratio - 1) < significance.largest_z(passes) * error
    z, _, _ = compared(np.where(np.arange(bins) == 30, 1.3, 1.0))
    assert np.argmax(np.abs(z)) == 30
