"""Elliptic and measured beams in the tangent plane: samples, density, widths, files."""

import drjit as dr
import mitsuba as mi
import numpy as np
import OpenEXR
import pytest
import significance
from frequencies import assert_counts
from mitsuba.chi2 import ChiSquareTest, SphericalDomain
from rows import each_row
from significance import assert_distribution, largest_z

from mitransient_lidar.transport.laser import BeamSampler, GaussianBeam, ImageBeam, TopHatBeam
from mitransient_lidar.transport.rng import pass_streams

MRAD = 1e-3
COUNT = 2**20
IMAGE = np.array([[0, 7, 1, 0], [0, 0, 0, 0], [2, 3, 0, 12]], dtype=float)

#: Half angles of 6 and 1.5 mrad, the long axis 30 degrees from +angle_x towards +angle_y.
TURN = np.radians(30)
PROFILES = {
    "gaussian": lambda: GaussianBeam(6 * MRAD, 1.5 * MRAD, TURN),
    "top_hat": lambda: TopHatBeam(6 * MRAD, 1.5 * MRAD, TURN),
    "image": lambda: ImageBeam(IMAGE, 16 * MRAD),
}


def tangent_samples(profile, count=COUNT):
    rng = mi.PCG32(count, initstate=3 + significance.seed_shift)
    angle_x, angle_y = profile.sample(mi.Point2f(rng.next_float32(), rng.next_float32()))
    return np.array(angle_x, dtype=np.float64), np.array(angle_y, dtype=np.float64)


def laser(**parameters):
    return mi.load_dict({"type": "lidar_transmitter", **parameters})


def image_file(folder, image=IMAGE, suffix=".npy"):
    path = folder / f"beam{suffix}"
    if suffix == ".npy":
        np.save(path, image)
    elif suffix == ".png":
        from PIL import Image

        Image.fromarray(np.round(image * 20).astype(np.uint8)).save(path)
    else:
        with OpenEXR.File({}, {"Y": image.astype(np.float32)}) as file:
            file.write(str(path))
    return str(path)


@pytest.mark.parametrize("kind", PROFILES)
def test_samples_follow_the_density(kind):
    profile = PROFILES[kind]()
    angle_x, angle_y = tangent_samples(profile)
    edges = np.linspace(-30, 30, 121) * MRAD
    width = edges[1] - edges[0]
    counts = np.histogram2d(angle_x, angle_y, bins=(edges, edges))[0]
    fine = ((edges[:-1] + edges[1:])[:, None] / 2 + ((np.arange(8) + 0.5) / 8 - 0.5) * width).ravel()
    x, y = (mi.Float(g.ravel()) for g in np.meshgrid(fine, fine, indexing="ij"))
    density = np.array(profile.density(x, y), dtype=np.float64).reshape(120, 8, 120, 8)
    expected = COUNT * density.mean(axis=(1, 3)) * width**2
    assert expected.sum() == pytest.approx(COUNT, rel=2e-3)
    used = expected > 50
    if kind != "gaussian":
        used &= density.min(axis=(1, 3)) == density.max(axis=(1, 3))  # cells that no edge cuts
    assert used.sum() >= 24
    assert_counts(counts[used], expected[used])


@pytest.mark.parametrize("kind", ["gaussian", "top_hat"])
def test_elliptic_samples_have_the_moments_of_a_turned_ellipse(kind):
    """Variances a^2 and b^2 along axes turned by 30 degrees (a quarter of them for an even disc); no sign is free."""
    angle_x, angle_y = tangent_samples(PROFILES[kind]())
    a2, b2 = (36.0, 2.25) if kind == "gaussian" else (9.0, 0.5625)
    cos2, sin2, mixed = 0.75, 0.25, np.sqrt(3) / 4
    expected = np.array([0, 0, a2 * cos2 + b2 * sin2, a2 * sin2 + b2 * cos2, (a2 - b2) * mixed])
    x, y = angle_x / MRAD, angle_y / MRAD
    moments = np.array([x, y, x**2, y**2, x * y])
    z = (moments.mean(axis=1) - expected) / (moments.std(axis=1) / np.sqrt(COUNT))
    assert np.abs(z).max() < largest_z(COUNT, 5), z


def test_image_cells_hold_their_shares():
    """Row 0 is far (+angle_x) and column 0 left (+angle_y): a flipped image would move the brightest cell, 12 of 25."""
    angle_x, angle_y = tangent_samples(PROFILES["image"]())
    far, left = 6 * MRAD - 4 * MRAD * np.arange(4), 8 * MRAD - 4 * MRAD * np.arange(5)
    counts = np.histogram2d(-angle_x, -angle_y, bins=(-far, -left))[0]
    expected = COUNT * IMAGE / IMAGE.sum()
    assert counts.sum() == COUNT
    assert not counts[IMAGE == 0].any()
    lit = IMAGE > 0
    assert_counts(counts[lit], expected[lit], known=1)
    density = np.array(ImageBeam(IMAGE, 16 * MRAD).density(mi.Float([-4e-3, 4e-3]), mi.Float([-6e-3, -6e-3])))
    np.testing.assert_allclose(density, [12 / 25 / 16e-6, 0], rtol=1e-6)


def test_rays_follow_the_intensity(tmp_path):
    """Over the sphere, at angles where the solid angle per tangent-plane area is not constant."""
    ticks = (np.arange(64) - 31.5) / 20
    image = np.exp(-(ticks[:, None] ** 2) - 2 * (ticks - 0.4) ** 2)
    beam = laser(beam_profile="image", profile_file=image_file(tmp_path, image), profile_mrad=900.0)

    def sample(u):
        return beam.sample_ray(0.0, mi.Float(0.5), mi.Point2f(0.5), mi.Point2f(u[0], u[1]))[0].d

    def density(d):
        return beam.intensity(d) / beam.energy

    assert_distribution(
        ChiSquareTest(SphericalDomain(), sample, density, 2, sample_count=1_000_000, res=101, ires=16, seed=5)
    )


def test_spreads_are_those_of_the_narrow_and_the_wide_axis():
    """Cells go by the narrow one, what covers the beam by the wide one."""
    flat = laser(beam_profile="top_hat", divergence_mrad=2.0, divergence_across_mrad=12.0)
    assert (flat.angular_spread, flat.widest_angular_spread) == (pytest.approx(0.5e-3), pytest.approx(3e-3))
    assert laser().angular_spread == laser().widest_angular_spread == 5e-3
    assert flat.divergence == pytest.approx(2e-3)


@pytest.mark.parametrize("suffix", [".npy", ".png", ".exr"])
def test_files_of_all_kinds_hold_the_same_beam(suffix, tmp_path):
    beam = laser(beam_profile="image", profile_file=image_file(tmp_path, suffix=suffix), profile_mrad=16.0)
    angle_x, angle_y = (g.ravel() for g in np.meshgrid([4e-3, 0, -4e-3], [6e-3, 2e-3, -2e-3, -6e-3], indexing="ij"))
    density = np.array(beam.tangent_density(mi.Float(angle_x), mi.Float(angle_y)))
    np.testing.assert_allclose(density * 16e-6, IMAGE.ravel() / 25, rtol=1e-5)


@pytest.mark.parametrize("kind", PROFILES)
@pytest.mark.parametrize("view_mrad", [2.0, 60.0])
def test_beam_samples_keep_the_energy(kind, view_mrad, tmp_path):
    """Photons stand for the pulse's energy, wherever the samples are moved to; so do rays for Mitsuba."""
    shape = {"divergence_mrad": 12.0, "divergence_across_mrad": 3.0, "ellipse_deg": 30.0}
    if kind == "image":
        shape = {"profile_file": image_file(tmp_path), "profile_mrad": 16.0}
    beam = laser(beam_profile=kind, **shape)
    receiver = mi.load_dict({"type": "multipixel_receiver", "field_of_view_mrad": view_mrad}).receiver
    sampler = BeamSampler(beam, receiver)
    assert sampler.use_view == (view_mrad == 2.0)
    index = dr.arange(mi.UInt32, COUNT)
    angles, energy = sampler.sample(index, COUNT, pass_streams(1, 0, COUNT))
    energy = np.array(energy, dtype=np.float64) * np.ones(COUNT)
    assert np.isfinite(energy).all()
    # And they stand for it where it is: the part beyond angle_x = 0 is the beam's own.
    far, left = tangent_samples(beam.profile)
    whole = np.ones(COUNT, dtype=bool)
    parts = ((whole, whole), (np.array(angles.x) > 0, far > 0), (np.array(angles.y) > 1e-3, left > 1e-3))
    for seen, own in parts:
        share = energy * seen * COUNT / 4.5e-3
        error = np.hypot(share.std(), own.std()) / np.sqrt(COUNT)
        # To rounding, where every sample carries the same energy.
        assert abs(share.mean() - own.mean()) < largest_z(COUNT, 3) * error + 1e-5
        assert error < 2e-3


@each_row(1, 3, 17)
def test_any_number_of_photons_keeps_the_energy(count):
    """Sums of the energies of few photons, of which some are drawn over a small view."""
    sampler = BeamSampler(laser(), mi.load_dict({"type": "multipixel_receiver", "field_of_view_mrad": 2.0}).receiver)
    assert sampler.use_view
    shots = 2**16
    index = dr.arange(mi.UInt32, shots * count) % count
    _, energy = sampler.sample(index, count, pass_streams(2, 0, shots * count))
    samples = np.array(energy, dtype=np.float64).reshape(shots, count).sum(axis=1) / 4.5e-3
    assert abs(samples.mean() - 1) < largest_z(shots) * samples.std() / np.sqrt(shots) + 1e-5


@each_row(
    (np.zeros((3, 3)), "zeros only"),
    (np.array([[1.0, -2.0]]), "holds -2 but no irradiance may be negative"),
    (np.array([[1.0, np.nan]]), "must hold finite numbers"),
    (np.ones((2, 2, 3)), r"has the shape \(2, 2, 3\)"),
    (np.ones((1, 3000)), r"shape \(1, 3000\) must have two dimensions of 1 to 2048"),
    (np.ones((0, 3)), r"has the shape \(0, 3\)"),
    (np.array([["a", "b"]]), "must hold real numbers"),
)
def test_images_that_are_no_beam_are_refused(image, message, tmp_path):
    with pytest.raises(RuntimeError, match=message):
        laser(beam_profile="image", profile_file=image_file(tmp_path, image), profile_mrad=16.0)


@pytest.mark.parametrize("suffix", [".npy", ".png", ".exr"])
def test_damaged_files_are_refused_in_one_sentence(suffix, tmp_path, capfd):
    path = tmp_path / f"beam{suffix}"
    image_file(tmp_path, np.random.default_rng(1).uniform(0, 10, (64, 64)), suffix)
    half = path.stat().st_size // 2
    for content in (b"", b"no image", path.read_bytes()[:half]):
        path.write_bytes(content)
        with pytest.raises(RuntimeError, match=rf"profile_file = '.*{suffix}': .*{suffix} is damaged, or"):
            laser(beam_profile="image", profile_file=str(path), profile_mrad=16.0)
    assert capfd.readouterr() == ("", "")
