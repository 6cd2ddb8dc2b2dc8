"""Gated cameras: mean, variance, saturation and covariance of frames, drawn against the closed forms.

A row of 100 gates with the same light is 100 independent images of 32 x 32 pixels, 102 400 values: what is compared is
the mean over the pixels, with the error that its spread over the gates gives.
"""

from dataclasses import replace

import numpy as np
import pytest
from rows import each_row, must_refuse
from significance import largest_chi2, largest_z, variance_limits

from mitransient_lidar.core.errors import UserError
from mitransient_lidar.physics.receiver.camera import Camera
from mitransient_lidar.physics.receiver.detectors import photons_per_joule
from mitransient_lidar.physics.receiver.receiver_files import CAMERAS, camera, receiver, waveform_receiver

GATES, PULSES, OPEN_NS = 100, 300, 20.0
#: A step and a ramp of light, so that blur and edges count; mean 1.
SCENE = np.where(np.arange(32) < 16, 0.5, 1.5)[:, None] * np.linspace(0.6, 1.4, 32)


def energies(one: Camera, events: float) -> np.ndarray:
    """Return energies that make a mean number of events, shape (row, column, gate)."""
    joules = events / (one.quantum_efficiency * photons_per_joule(one.wavelength_nm))
    return joules * np.repeat(SCENE[..., None], GATES, axis=-1)


def full(one: Camera) -> float:
    """Return the events at which half of the pixels saturate."""
    if one.kind == "counting":
        return 6.0 * PULSES
    return min(one.full_well, (one.top_dn - one.offset_dn) * one.electrons_per_dn) / one.gain


def z_scores(drawn: Camera, known: Camera, events: float, pulses: int = PULSES) -> np.ndarray:
    """Return differences of mean, variance and saturation in standard errors, at a background that one event makes."""
    sky = energies(drawn, 1.0)[0, 0, 0] / (1e-9 * OPEN_NS * PULSES)
    light, pattern = energies(drawn, events), drawn.pattern((32, 32))
    record = drawn.sample(light, OPEN_NS, 1, 5, sky, PULSES, pattern)
    expected = known.expected(light, OPEN_NS, sky, pulses, pattern)
    signal = record.signal[0].astype(float)
    scores = []
    for found, wanted in (
        (signal, expected.mean),
        ((signal - expected.mean) ** 2, expected.variance),
        (record.saturated[0], expected.saturation),
    ):
        difference = (found - wanted).mean(axis=(0, 1))
        error = difference.std(ddof=1) / np.sqrt(GATES)
        # Where nothing is left to chance, rounding remains.
        scores.append(difference.mean() / max(error, 1e-4 * max(abs(wanted.mean()), 1)))
    return np.array(scores)


@pytest.mark.parametrize("share", [0.01, 1.0, *(pytest.param(one, marks=pytest.mark.slow) for one in (0.0, 0.3, 3.0))])
@pytest.mark.parametrize("name", CAMERAS)
def test_frames_have_the_moments_of_the_closed_form(name: str, share: float) -> None:
    one = CAMERAS[name]
    scores = z_scores(one, one, share * full(one))
    assert np.abs(scores).max() < largest_z(GATES, 3), scores


@each_row(
    {"quantum_efficiency": 1.03},
    {"wavelength_nm": 1.03},
    {"gain": 1.03},
    {"excess_noise": 1.15},
    {"read_noise": 20.0},
    {"intensifier_mtf": 1.3},
    {"pulses": 1.2},
)
def test_a_wrong_factor_would_be_found(wrong: dict[str, float]) -> None:
    one, (name, factor) = CAMERAS["iccd"], *wrong.items()
    changed = one if name == "pulses" else replace(one, **{name: factor * getattr(one, name)})
    scores = z_scores(one, changed, 1.0 if name == "pulses" else 20.0, round(PULSES * wrong.get("pulses", 1)))
    assert np.abs(scores[:2]).max() > largest_z(GATES, 2)


@pytest.mark.parametrize("name", ["iccd", "icmos"])
def test_an_intensifier_correlates_neighbours(name: str) -> None:
    one = CAMERAS[name]
    light = energies(one, 50.0)
    noise = one.noise(light, OPEN_NS, 0.0, PULSES)
    signal = one.sample(light, OPEN_NS, 1, 3, 0.0, PULSES).signal[0] - one.expected(light, OPEN_NS, 0.0, PULSES).mean
    weights = one.spread(np.eye(32)[..., None])[..., 0]
    rows = one.spread(np.eye(32).reshape(32, 1, 32)).reshape(32, 32)
    for shift in (0, 1, 2):
        moved = signal[:, shift:]
        products = (moved * signal[:, : 32 - shift]).mean(axis=(0, 1))
        pairs = rows[:, shift:] * rows[:, : 32 - shift]
        wanted = np.einsum("ri,ij,jc->rc", rows**2, noise.shared[..., 0], pairs)
        wanted += noise.own[..., 0] if shift == 0 else 0
        error = products.std(ddof=1) / np.sqrt(GATES)
        assert abs(products.mean() - wanted.mean()) < largest_z(GATES) * error
        assert wanted.mean() > 0.05 * noise.own.mean()
    assert weights.sum() == pytest.approx(32)


@pytest.mark.parametrize("mtf", [0.1, 0.5, 0.9])
def test_blur_keeps_the_sum_and_has_its_mtf(mtf: float) -> None:
    one, size = Camera("intensified", 0.3, 100.0, 1.5, intensifier_mtf=mtf), 24
    random = np.random.default_rng(1).random((size, 5, 2))
    assert one.spread(random).sum(axis=(0, 1)) == pytest.approx(random.sum(axis=(0, 1)), rel=1e-12)
    for number in range(size):  # cosines that the mirrors at the edges continue
        wave = np.cos(np.pi * number * (np.arange(size) + 0.5) / size)
        frequency = number / (2 * size)
        wanted = mtf ** (0.5 * (1 - np.cos(2 * np.pi * frequency)))
        assert one.spread(wave[:, None, None])[:, 0, 0] == pytest.approx(wanted * wave, abs=1e-5)
    optics = replace(one, intensifier_mtf=1.0, optics_mtf=mtf)
    events = optics.events(random, 1.0)
    scale = 0.3 * photons_per_joule(532.0)
    assert events == pytest.approx(scale * one.spread(random), rel=1e-12)


def test_jitter_shifts_the_gate_for_all_pixels() -> None:
    one = replace(CAMERAS["iccd"], gate_jitter_ns=2.0, hot_pixels=0.0)
    light = energies(one, 50.0)[..., :20]
    slope = 0.3 * light
    expected = one.expected(light, OPEN_NS, 0.0, 4, slope=slope)
    plain = one.expected(light, OPEN_NS, 0.0, 4)
    signal = one.sample(light, OPEN_NS, 40, 3, 0.0, 4, slope=slope).signal
    sums = signal.sum(axis=(1, 2), dtype=np.float64).ravel()
    # 30 % per ns, and 1 ns for the mean of 4 pulses.
    shared = 0.3 * (plain.mean - one.offset_dn).sum(axis=(0, 1))[0]
    noise = one.noise(light, OPEN_NS, 0.0, 4)
    variance = shared**2 + (noise.shared + noise.own).sum(axis=(0, 1))[0]
    low, high = variance_limits(sums.size - 1)
    assert low < sums.var(ddof=1) / variance < high
    ratio = signal.var(axis=(0, 3), ddof=1) / expected.variance[..., 0]
    assert np.all((ratio > variance_limits(sums.size - 1, 1024)[0]) & (ratio < variance_limits(sums.size - 1, 1024)[1]))
    assert expected.variance.mean() > 2 * plain.variance.mean()


def test_the_fixed_pattern_belongs_to_the_camera() -> None:
    one = replace(CAMERAS["iccd"], response_spread=0.05, offset_spread_dn=30.0, hot_pixels=0.1, hot_factor=1e5)
    first, again, other = (
        one.pattern((100, 100)),
        one.pattern((100, 100)),
        replace(one, pattern_seed=1).pattern((100, 100)),
    )
    assert np.array_equal(first.response, again.response)
    assert not np.array_equal(first.offset, other.offset)
    for values, deviation in ((first.response - 1, 0.05), (first.offset, 30.0)):
        assert np.sum((values / deviation) ** 2) < largest_chi2(10_000)
    hot = np.mean(first.dark > 1)
    assert abs(hot - 0.1) < largest_z(10_000) * 0.003
    dark = one.expected(np.zeros((100, 100, 1)), OPEN_NS, pattern=first).mean[..., 0] - first.offset - one.offset_dn
    assert dark[first.dark > 1].mean() / dark[first.dark == 1].mean() == pytest.approx(1e5, rel=1e-3)


def test_daylight_counts_while_the_gate_is_open_and_leaks_while_it_is_closed() -> None:
    one = replace(CAMERAS["gated_cmos"], dark_current_hz=0.0)
    sky = np.full((4, 3), 1e-12)
    found = one.events(np.zeros((4, 3, 2)), np.array([10.0, 20.0]), sky, 1000)
    seconds = np.array([10e-6, 20e-6]) + 1e-4 * 10e-3
    assert found == pytest.approx(np.broadcast_to(0.5 * photons_per_joule(532) * 1e-12 * seconds, (4, 3, 2)))


def test_a_file_changes_a_camera(tmp_path) -> None:
    path = tmp_path / "own.toml"
    path.write_text('preset = "emccd"\nwavelength_nm = 515\nsource = "measured"\n[camera]\ngain = 100\n')
    own = camera(path)
    assert own == replace(CAMERAS["emccd"], gain=100.0, wavelength_nm=515.0, source="measured", name=str(path))
    assert receiver("iccd") is CAMERAS["iccd"]
    assert all(one.source and "assumed" in one.source for one in CAMERAS.values())


@each_row(
    ('[camera]\nkind = "direct"', "no quantum_efficiency"),
    ('preset = "iccd"\n[camera]\nbit = 3', "'bit' is no key"),
    ('preset = "iccd"\n[camera]\ngain = 0.5', "gain = 0.5 must be at least 1"),
    ('preset = "pmt"\n[camera]\ngain = 2', "preset = 'pmt' must be one of iccd"),
    ('preset = "spad_camera"\n[camera]\nread_noise = 3', "read_noise = 3 is no parameter of a camera of kind"),
    ('preset = "iccd"\n[camera]\noffset_dn = 5', "offset_dn = 5 must be at least 20"),
    ('preset = "iccd"\n[camera]\nexcess_noise = 1', "excess_noise = 1 must be at least .* = 1.005"),
)
def test_files_are_refused_in_a_sentence(text: str, message: str, tmp_path) -> None:
    path = tmp_path / "own.toml"
    path.write_text(text)
    with pytest.raises(UserError, match=message) as error:
        camera(path)
    assert str(error.value).startswith(str(path))


def test_each_kind_of_receiver_names_the_other() -> None:
    must_refuse(r"'iccd' is a camera, which records gates: .* pmt", waveform_receiver, "iccd")
    must_refuse("'pmt' is one of waveforms, but gates need a camera: iccd", camera, "pmt")
