"""Phase functions as plugins: normalised, the published tables at every angle, and tables of users."""

from importlib import resources

import mitsuba as mi
import numpy as np
import pytest
import significance
from oracles.phase import henyey_greenstein
from rows import each_case, each_row
from significance import largest_z

from mitransient_lidar.transport.medium import tabulated_phase

FRAME_WI = np.array([0.48, -0.6, 0.64])

PLUGINS = [
    *({"type": "fournier_forand", "backscatter_ratio": ratio} for ratio in (0.005, 0.0183, 0.04, 0.05)),
    {"type": "fournier_forand", "refractive_index": 1.175, "junge_slope": 4.065},
    {"type": "petzold"},
    {"type": "two_term_henyey_greenstein", "weight": 0.95, "g_forward": 0.9, "g_backward": 0.3},
    {"type": "two_term_henyey_greenstein", "weight": 0.0, "g_backward": 0.7},
    {"type": "two_term_henyey_greenstein", "weight": 1.0, "g_forward": 0.0},
]


def value(plugin, theta):
    """Return p [1/sr] of a plugin at scattering angles [rad]; directions are exact to float32 at an oblique `wi`."""
    mei = mi.MediumInteraction3f()
    mei.wi = mi.Vector3f(FRAME_WI.tolist())
    frame = mi.Frame3f(-mei.wi)
    wo = frame.to_world(mi.Vector3f(mi.Float(np.sin(theta)), 0, mi.Float(np.cos(theta))))
    return np.array(plugin.eval_pdf(mi.PhaseFunctionContext(), mei, wo)[1], dtype=np.float64)


@each_row(*PLUGINS)
def test_normalised_over_the_sphere(description):
    """Quadrature in ln(theta) from 0.003 degree, plus the power law below: one half, or 4 pi, would be off by far."""
    plugin = mi.load_dict(description)
    low = np.radians(0.003)
    nodes, weights = np.polynomial.legendre.leggauss(6)
    edges = np.linspace(np.log(low), np.log(np.pi), 400)
    half = np.diff(edges)[:, None] / 2
    theta = np.exp(edges[:-1, None] + half * (1 + nodes))
    p = value(plugin, theta.ravel()).reshape(theta.shape)
    total = np.sum(2 * np.pi * p * np.sin(theta) * theta * half * weights)
    # Below, p goes on as theta^-m; float32 directions do not resolve such angles.
    ends = value(plugin, np.array([low, 2 * low]))
    slope = np.log(ends[0] / ends[1]) / np.log(2)
    total += 2 * np.pi * ends[0] * low**2 / (2 - slope)
    assert total == pytest.approx(1, abs=3e-3)


@each_case((1.040, 3.2010, 1.003e-3), (1.08, 3.483, 1.0037e-2), (1.175, 4.065, 0.10008), (1.15, 4.874, 0.40052))
def test_fournier_forand_by_index_and_slope(index, slope, ratio):
    """Pairs that the Ocean Optics Web Book lists with their backscatter ratios."""
    plugin = mi.load_dict({"type": "fournier_forand", "refractive_index": index, "junge_slope": slope})
    assert plugin.backscatter_ratio == pytest.approx(ratio, rel=1e-3)


def test_petzold_at_every_tabulated_angle():
    """All 55 rows over the 0.9929 that they integrate to; linear interpolation would divide by 1.0200."""
    text = (
        resources.files("mitransient_lidar.physics.water").joinpath("petzold_average_particle.csv").read_text("utf-8")
    )
    degrees, tabulated = np.loadtxt(text.splitlines(), delimiter=",", unpack=True)
    assert len(degrees) == 55
    # Rows of the paper, so that the file itself is checked.
    for angle, row in ((0.1, 1766.61), (1.2589, 49.5803), (7.9433, 1.81927), (30, 8.60848e-2), (145, 2.31308e-3)):
        assert tabulated[degrees == angle] == pytest.approx(row)
    plugin = mi.load_dict({"type": "petzold"})
    ratio = value(plugin, np.radians(degrees)) / tabulated
    # The finer table cuts the corners of the kinks at its rows; below 1 degree float32 angles add 1e-3.
    np.testing.assert_allclose(ratio, 1 / 0.9929, rtol=1e-2)
    assert np.median(ratio) == pytest.approx(1 / 0.9929, rel=1e-3)
    assert plugin.backscatter_ratio == pytest.approx(0.01826, rel=1e-3)
    # Below 0.1 degree, where the measurement ends, theta^-1.346 holds 0.05169 of the raw table's integral.
    core = plugin.tabulated.table.cdf_s(np.sin(np.radians(0.05)) ** 2)
    assert core == pytest.approx(0.05169 / 0.9929, rel=1e-3)


@each_case(
    {"type": "fournier_forand", "backscatter_ratio": 0.005},
    {"type": "fournier_forand", "backscatter_ratio": 0.0183},
    {"type": "petzold", "water": "clear"},
    {"type": "sea_water"},
)
def test_short_segments_are_sampled_as_the_power_laws_they_are(description, monkeypatch):
    """The series against logarithm and exponential, whose own rounding grows where an exponent is close to 1."""
    series = mi.load_dict(description).tabulated
    assert series.has_short_tables
    monkeypatch.setattr(tabulated_phase, "is_short", lambda table: False)
    law = tabulated_phase.TabulatedPhase(series.table)
    count = 2**18
    rng = mi.PCG32(count, initstate=3 + significance.seed_shift)
    u, v = rng.next_float32(), rng.next_float32()
    s, value = (np.array(x, dtype=np.float64) for x in series.sample(u, v))
    s_law, value_law = (np.array(x, dtype=np.float64) for x in law.sample(u, v))
    inside = s_law > 1.01e-12
    # Logarithms and exponentials of GPUs are rounded more coarsely: 1.34e-4 was seen.
    closeness = 1e-4 if mi.variant().startswith("llvm") else 2e-4
    np.testing.assert_allclose(s[inside], s_law[inside], rtol=closeness)
    np.testing.assert_allclose(value[inside], value_law[inside], rtol=2e-4)
    assert np.median(np.abs(s[inside] / s_law[inside] - 1)) < 5e-7
    # What is drawn has the density that is asked for, in the cap, too: but for the rounding of ln s.
    found = np.array(series.eval(mi.Float(s)), dtype=np.float64)
    within = np.abs(np.log(np.maximum(s, 1e-300) / 1e-12)) > 1e-5
    np.testing.assert_allclose(found[within], value[within], rtol=3e-5)
    below = np.mean(s < 1e-12)
    assert abs(below - series.table.cdf[0]) < largest_z(count) * np.sqrt(series.table.cdf[0] / count) + 10 / count


G = 0.9
WI = np.array([0.3, -0.5, 0.8124]) / np.linalg.norm([0.3, -0.5, 0.8124])


@pytest.fixture
def table(tmp_path):
    """Henyey-Greenstein at 400 uneven angles, as a volume scattering function of b = 0.4 /m."""
    angle = np.concatenate([np.geomspace(0.05, 10, 200), np.linspace(10.4, 180, 200)])
    path = tmp_path / "measured.csv"
    value = 0.4 * henyey_greenstein(np.radians(angle), G)
    path.write_text("angle, vsf\n" + "\n".join(f"{a:.6f}, {v:.8g}" for a, v in zip(angle, value, strict=True)))
    return str(path)


def interaction():
    mei = mi.MediumInteraction3f()
    mei.wi = mi.Vector3f(WI.tolist())
    mei.sh_frame = mi.Frame3f(mei.wi)
    return mei


def test_samples_and_values_are_those_of_the_function_in_the_table(table, caplog):
    plugin = mi.load_dict({"type": "measured_phase", "filename": table})
    assert "the values integrate to 0.4 over the sphere" in caplog.text
    assert plugin.backscatter_ratio == pytest.approx(0.022903, rel=5e-3)
    count = 400_000
    rng = mi.PCG32(count, initstate=3 + significance.seed_shift)
    first, pair = rng.next_float32(), mi.Point2f(rng.next_float32(), rng.next_float32())
    wo, weight, pdf = plugin.sample(mi.PhaseFunctionContext(), interaction(), first, pair)
    cosine = -(np.array(wo).T @ WI)
    assert np.all(np.array(weight) == 1)
    error = cosine.std() / np.sqrt(count)
    # The opposite orientation would give -0.9; a table read in radians nothing like it.
    # 3e-4 for the table, whose first angle is 0.05 degrees.
    assert abs(cosine.mean() - G) < largest_z(count) * error + 3e-4
    expected = henyey_greenstein(np.arccos(np.clip(cosine, -1, 1)), G)
    np.testing.assert_allclose(np.array(pdf), expected, rtol=0.02)
    value, density = plugin.eval_pdf(mi.PhaseFunctionContext(), interaction(), wo)
    np.testing.assert_allclose(np.array(value)[0], np.array(density))


def test_invalid_input_is_refused(tmp_path):
    with pytest.raises(RuntimeError, match="filename is missing"):
        mi.load_dict({"type": "measured_phase"})
    path = tmp_path / "short.csv"
    path.write_text("0.1, 5\n90, 1\n180, 0.5\n")
    with pytest.raises(RuntimeError, match="10"):
        mi.load_dict({"type": "measured_phase", "filename": str(path)})
