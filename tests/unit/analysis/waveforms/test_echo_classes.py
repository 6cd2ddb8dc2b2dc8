"""What first echoes are, over drawn records of land and of water from 5 cm on, and depths where echoes merge."""

import numpy as np
import pytest
import significance
import xarray as xr
from scipy.stats import exponnorm, norm
from significance import largest_count, largest_z, variance_limits

from mitransient_lidar import results
from mitransient_lidar.analysis.receiver import detect_waveforms
from mitransient_lidar.analysis.waveforms import echo_table, first_echoes
from mitransient_lidar.analysis.waveforms.echo_classes import EchoClass
from mitransient_lidar.analysis.waveforms.surface_times import SurfaceLevel
from mitransient_lidar.core.constants import C0
from mitransient_lidar.physics.lidar.pulse import FWHM_PER_SIGMA
from mitransient_lidar.physics.lidar.time_axis import TimeAxis
from mitransient_lidar.results.geometry import LinesOfSight

C, N, ALTITUDE, FWHM = 1e-9 * C0, 1.34, 600.0, 1.5
DT, BINS, SIGMA = 0.5, 300, FWHM / FWHM_PER_SIGMA
SURFACE = 2 * ALTITUDE / C
START = SURFACE - 40
EDGES = START + DT * np.arange(BINS + 1)
TIME = EDGES[:-1] + 0.5 * DT
#: Energy of a white plane across the beam over pi [J], backscattering [1/m], attenuation along the path [1/m].
UNIT, BB, K = 2e-5 * 0.729 * 0.01 / ALTITUDE**2 / np.pi, 0.006, 0.16
ATTRIBUTES = {
    **{"altitude": ALTITUDE, "off_nadir_deg": 0.0, "refractive_index": N, "group_index": N, "pulse_fwhm_ns": FWHM},
    **{"pulse_energy_mj": 0.02, "aperture_area": 0.01, "field_of_view_mrad": 5.6, "divergence_mrad": 0.35},
    **{"surface_time_ns": SURFACE, "surface_heights_m": [-0.02, 0.02], "two_way_efficiency": 0.729},
}


def pulse(at, energy, sigma=SIGMA):
    return energy / (DT * 1e-9) * np.diff(norm.cdf(EDGES, at, sigma))


def land(height, reflectance=0.2, blur=0.0):
    """Power of a plane at a height [m], whose slope blurs the pulse [ns]."""
    return pulse(SURFACE - 2 / C * height, UNIT * reflectance, np.hypot(SIGMA, blur))


def water(depth, glint=0.0, reflectance=0.2, level=0.0, attenuation=K, backscattering=BB, sigma=SIGMA):
    """Power of a surface with a height [m], a column and a bottom at a depth below it [m].

    The glint is relative to a bottom of no depth. Light of the bottom that the surface reflects totally meets it again:
    cos^2 of its angle is uniform up to 1 - 1/n^2.
    """
    surface, rate = SURFACE - 2 / C * level, C / N * attenuation
    delay = 2 * N * depth / C

    def onset(at):
        return exponnorm.pdf(TIME, 1 / (rate * sigma), loc=at, scale=sigma) / rate

    column = UNIT * np.pi * backscattering / (2 * np.pi) * C0 / (2 * N) * 0.96
    column = column * np.maximum(onset(surface) - np.exp(-rate * delay) * onset(surface + delay), 0)
    first = UNIT * reflectance * 0.96 / N**2 * np.exp(-2 * attenuation * depth)
    total = 1 - 1 / N**2
    cosines = np.sqrt(total * (np.arange(400) + 0.5) / 400)
    again = sum(pulse(surface + delay * (1 + 1 / one), first * reflectance * total / 400, sigma) for one in cosines)
    return pulse(surface, UNIT * reflectance * glint, sigma) + column + pulse(surface + delay, first, sigma) + again


def recorded(powers, seed, gain=0.12, fwhm=FWHM):
    """Records of the receiver of an instrument, one for each row of powers [W]."""
    values = np.asarray(powers)
    base = results.build(
        *(one * values[:1] * DT * 1e-9 for one in (1, 0)),
        *(one * values[:1] for one in (1, 0)),
        time=TimeAxis(START, DT, BINS),
        pixel_names=["single"],
        pixel_centres_mrad=np.zeros((1, 2)),
        attributes=ATTRIBUTES | {"pulse_fwhm_ns": fwhm},
    )
    zero, one = np.zeros(1), np.ones(1)
    lines = LinesOfSight(zero, zero, zero, SURFACE * one, zero, C / (2 * N) * one, one)
    shots = xr.Dataset(
        {"waveform": (("shot", "pixel", "time"), values[:, np.newaxis], {"units": "W"})},
        {"pixel": base["pixel"], "time": base["time"], "shot": np.arange(len(values))},
        base.attrs,
    ).assign_coords(lines.coordinates(("pixel",), (1,)))
    return detect_waveforms(shots, "riegl_vq880g2", gain=gain, seed=seed + significance.seed_shift)


def found(record, **options):
    """Return classes of surface and bottom, depths, and errors of all kinds [m]."""
    table = echo_table.extract(record, **options).isel(pixel=0)
    bottom = table.sel(echo="bottom")
    error = np.hypot(bottom["depth_m_stderr"], bottom["depth_m_method_error"]).values
    return table["class"].sel(echo=["surface", "bottom"]).values.T, bottom["depth_m"].values, error


def test_land_and_shallow_water_are_what_they_are():
    """Land is timed in air, and a bottom from 0.3 m on in the water; the false echo would be 5 cm and more off."""
    heights, depths = np.array([0.3, 1.0, 3.0, 4.5]), np.array([0.3, 0.5, 0.8, 2.0])
    powers = [land(one, blur=0.3) for one in heights] + [water(one, 0.2) for one in depths]
    (surface, bottom), depth, error = found(recorded(powers, 1))
    assert (surface[:4] == EchoClass.NONE).all()
    assert (bottom[:4] == EchoClass.LAND).all()
    assert np.isin(bottom[4:], [EchoClass.BOTTOM, EchoClass.MERGED]).all()
    np.testing.assert_allclose(depth[:4], -heights, atol=0.01)
    assert (np.abs(depth[4:] - depths) < 3 * error[4:]).all()


def test_land_that_may_have_a_film_of_water_states_it():
    """5 cm of clear water, 0.1 m above its mean level, look like land 1.7 cm below them; land at 0.5 m is dry."""
    depths = np.array([-0.05, -0.5])
    powers = [water(0.05, level=0.1, reflectance=0.05, backscattering=1e-4), land(0.5)]
    table = echo_table.extract(recorded(powers, 4)).isel(pixel=0).sel(echo="bottom")
    assert (table["class"] == EchoClass.LAND).all(), table["class_probability"].values
    error = table["depth_m"].values - depths
    stated = np.hypot(table["depth_m_stderr"], table["depth_m_method_error"]).values
    assert (np.abs(error) < 1.2 * stated).all(), (error, stated)
    assert np.sqrt(stated[0] ** 2 - stated[1] ** 2) > 0.7 * error[0] > 0.01


def test_turbid_water_without_a_visible_bottom_has_none():
    """Its column, which decays within a few echo widths, was a bottom 1 m deep with a probability of 1."""
    kinds = [(k, b, glint) for k, b in ((0.4, 0.02), (0.7, 0.04), (1.2, 0.06)) for glint in (0.0, 0.02, 0.2)]
    powers = [water(20, glint, attenuation=k, backscattering=b) for k, b, glint in kinds]
    (_, bottom), _, _ = found(recorded(powers, 7))
    assert (bottom == EchoClass.NONE).all()


def test_clear_seas_below_a_step_of_the_digitiser_are_no_land():
    """A low gain rounds the column of the clearest water to nothing, which was taken for dry land."""
    levels, glints = np.repeat([-0.1, 0.0, 0.1], 3), np.tile([0.02, 0.1, 0.5], 3)
    clear = {"reflectance": 0.05, "attenuation": 0.04, "backscattering": 1.3e-3}
    seas = [water(60, glint / 0.05, level=level, **clear) for level, glint in zip(levels, glints, strict=True)]
    heights = np.array([0.5, 1.0, 3.0])
    (surface, bottom), depth, _ = found(recorded([*seas, *map(land, heights)], 5, gain=0.012))
    assert (surface[:9] == EchoClass.SURFACE).all()
    assert (bottom[9:] == EchoClass.LAND).all()
    np.testing.assert_allclose(depth[9:], -heights, atol=0.03)


def test_faint_bottoms_without_a_surface_are_found():
    """First echoes below 8 standard errors were surfaces with a probability of 1, too late for the level, and lost."""
    record = recorded([water(0.5, backscattering=1e-3, level=level) for level in (-0.1, 0.0, 0.1)], 6)
    noise = float(record["signal_mean"].max()) / 6.5
    (_, bottom), depth, error = found(record, noise=noise)
    assert np.isin(bottom, [EchoClass.BOTTOM, EchoClass.MERGED]).all()
    assert (np.abs(depth - 0.5) < 3 * error).all()


def test_faint_first_echoes_at_the_surface_level_are_the_likeliest_class():
    """Below 8 standard errors they were surfaces, with stated probabilities down to 1e-22; land was lost."""
    heights, depths = np.array([0.3, 1.0]), np.array([0.2, 0.2, 0.3, 0.3])
    powers = [land(one) for one in heights]
    powers += [water(d, backscattering=1e-3, level=h) for d, h in zip(depths, (0.0, 0.1) * 2, strict=True)]
    record = recorded(powers, 6)
    mean = record["signal_mean"].values.reshape(len(powers), -1)
    mean -= np.median(mean[:, :40])
    # The errors of a render with few passes.
    noise = np.hypot(0.14 * mean, 2e-3 * mean.max(axis=1, keepdims=True))
    each = [found(record.isel(shot=[row]), noise=noise[row]) for row in range(len(powers))]
    classes, depth, error = (np.concatenate(one, axis=-1) for one in zip(*each, strict=True))
    assert (classes[0] == EchoClass.NONE).all()
    assert classes[1].tolist() == [EchoClass.LAND] * 2 + [EchoClass.MERGED] * 4
    assert (np.abs(depth - [*-heights, *depths]) < 3 * error).all()


def test_a_first_echo_no_higher_than_a_single_event_is_no_certain_bottom():
    """The stated noise is that of the mean light: an event where none is expected was a bottom with p = 0.999."""
    record = recorded([pulse(SURFACE + 2 * N * 0.4 / C, 0.2 * UNIT)] * 3 + [water(0.5)], 6)
    mean = record["signal_mean"].values
    record["event_height"] = record["event_height"].copy(data=[mean.max() - np.median(mean)])
    table = echo_table.extract(record)
    is_bottom = table["class"].sel(echo="bottom") != EchoClass.NONE
    assert ((table["class_probability"] < 0.6) | ~is_bottom).values[:3].all()


def test_turbid_water_seen_by_long_pulses_has_no_bottom():
    """A blurred bottom below a column of a free decay fits such columns as well, with more parameters."""
    kinds = [(k, b, glint) for k, b in ((0.5, 0.03), (0.75, 0.1)) for glint in (0.0, 0.02)]
    powers = [water(20, g, attenuation=k, backscattering=b, sigma=4.0 / FWHM_PER_SIGMA) for k, b, g in kinds]
    (_, bottom), _, _ = found(recorded(powers, 7, fwhm=4.0))
    assert (bottom == EchoClass.NONE).all()


def test_light_that_meets_a_bottom_twice_is_no_bottom():
    """Without a surface echo, a bottom was the surface, and its second light a bottom 2.5 times as deep."""
    depths, sigma = np.array([1.2, 1.5, 1.8]), 3.0 / FWHM_PER_SIGMA
    powers = [water(d, reflectance=0.4, attenuation=0.05, backscattering=1e-3, sigma=sigma) for d in depths]
    _, depth, error = found(recorded(powers, 8, fwhm=3.0))
    assert (np.abs(depth - depths) < 3 * error).all()
    assert (error < 0.2).all()


def test_turbid_water_has_depths_with_true_errors():
    """Pulses are long beside the column, whose decay at a typical rate gave depths up to 28 stated errors too small."""
    depths, sigma = np.array([0.4, 0.7, 1.0, 1.3]), 4.0 / FWHM_PER_SIGMA
    powers = [water(d, reflectance=0.4, attenuation=0.75, backscattering=0.1, sigma=sigma) for d in depths]
    (_, bottom), depth, error = found(recorded(powers, 9, fwhm=4.0))
    assert np.isin(bottom, [EchoClass.BOTTOM, EchoClass.MERGED]).all()
    assert (np.abs(depth - depths) < 3 * error).all()
    assert (error < 0.3).all()


@pytest.mark.slow
def test_error_rates_over_drawn_records():
    """Land from 0.2 to 4 m, and water from 0.3 to 4 m with glints of all strengths, as `decide` states."""
    count, seed = 90, 3
    rng = np.random.default_rng(seed + significance.seed_shift)
    heights, depths = rng.uniform(0.2, 4, count), np.exp(rng.uniform(np.log(0.3), np.log(4), count))
    glints = np.exp(rng.normal(-2, 2, count)) * (rng.random(count) < 0.7)
    of_ground = rng.uniform(0.05, 0.4, 2 * count)
    powers = [land(h, r, rng.uniform(0, 0.5)) for h, r in zip(heights, of_ground, strict=False)]
    powers += [water(d, g, r) for d, g, r in zip(depths, np.minimum(glints, 5), of_ground[count:], strict=True)]
    (_, bottom), depth, error = found(recorded(powers, seed, gain=0.05))
    dry = np.arange(2 * count) < count
    wet = np.isin(bottom[~dry], [EchoClass.BOTTOM, EchoClass.MERGED])
    assert np.count_nonzero(bottom[dry] != EchoClass.LAND) <= largest_count(count, 0.01)
    assert np.count_nonzero(~wet) <= largest_count(count, 0.01)
    z = ((depth[~dry] - depths) / error[~dry])[wet]
    np.testing.assert_allclose(depth[dry], -heights, atol=0.02)
    assert np.mean(z**2) < variance_limits(np.count_nonzero(wet))[1]
    assert np.abs(z).max() < largest_z(count, count)


def test_depths_do_not_depend_on_how_many_delays_are_fitted_at_once(monkeypatch):
    record = recorded([water(0.3), water(1.0, glint=0.2)], 1)
    together = found(record)
    monkeypatch.setattr(first_echoes, "_AT_ONCE", 1)
    for one, other in zip(together, found(record), strict=True):
        np.testing.assert_allclose(one, other, rtol=1e-6)


def test_a_level_known_from_elsewhere_gives_the_depth_of_a_bottom_without_a_surface():
    """10 cm of water without a surface echo, 20 cm above the mean sea level: an infrared channel has its surface."""
    record = recorded([water(0.1, level=0.2)], 2)
    level = SurfaceLevel(np.array([SURFACE - 0.4 / C]), np.array([0.05]))
    (_, bottom), depth, error = found(record, level=level)
    assert bottom[0] == EchoClass.MERGED
    assert abs(depth[0] - 0.1) < 3 * error[0]
    assert error[0] < 0.06
    without = found(record)
    assert without[2][0] > error[0] or without[0][1][0] == EchoClass.LAND


def test_a_pulse_that_meets_the_edge_of_a_pier_keeps_the_number_of_targets():
    """Half of the beam on its top, 2 m above the water: the object is the one target of a flight's table."""
    record = recorded([0.5 * land(2.0, 0.3) + 0.5 * water(3.0, 0.3), water(3.0, 0.3)], 4)
    table = echo_table.extract(record, targets=1).isel(pixel=0)
    assert table.sizes["echo"] == 4
    assert table["class"].sel(echo="target").values.tolist() == [EchoClass.ABOVE, EchoClass.NONE]
    np.testing.assert_allclose(table["depth_m"].sel(echo="bottom"), 3.0, atol=0.05)
    assert float(table["depth_m"].sel(echo="target")[0]) == pytest.approx(-2.0, abs=0.05)


def test_neighbours_tell_the_level_over_very_shallow_water():
    """0.3 m below the mean sea level, 0.1 m of water was 0.45 m with an error of 2 cm; columns of deep water tell."""
    depths = np.array([0.1, 0.2, *np.linspace(2.0, 4.0, 12)])
    (surface, bottom), depth, error = found(recorded([water(one, level=-0.3) for one in depths], 5))
    assert (surface[:2] == EchoClass.NONE).all()
    assert (bottom[:2] == EchoClass.MERGED).all()
    assert (np.abs(depth - depths)[:2] < 3 * error[:2]).all()


def test_a_level_of_few_or_uncertain_surfaces_stays_as_it_was():
    known = np.arange(20) < 12
    level = SurfaceLevel(np.full(20, 100.0), np.full(20, 1.2))
    late = np.where(known, 100.6 + 0.05 * np.cos(np.arange(20)), 130.0)
    error, per_metre = np.full(20, 0.1), np.full(20, 6.67)
    better = level.of_neighbours(late, error, known, per_metre)
    np.testing.assert_allclose(better.time_ns, 100.6, atol=0.03)
    assert (better.stderr_ns < 0.3).all()
    assert level.of_neighbours(late, error, known & (np.arange(20) < 7), per_metre) is level
    assert level.of_neighbours(late, np.full(20, 0.7), known, per_metre) is level
    # A median of false surfaces, 4 standard deviations below the mean sea level.
    assert level.of_neighbours(late + 5, error, known, per_metre) is level
