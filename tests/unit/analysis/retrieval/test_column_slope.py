"""Decay of the column signal: the fit and its error on synthetic records, and invalid input."""

import numpy as np
import pytest
from oracles.column_slope import effective_attenuation
from rows import refuses
from significance import largest_z
from small_results import made

from mitransient_lidar.analysis.retrieval.column_retrieval import ColumnBins
from mitransient_lidar.physics.lidar.level_sea import LidarGeometry
from mitransient_lidar.physics.lidar.time_axis import TimeAxis
from mitransient_lidar.studies.light_classes import scattering, slope_and_error

C0 = 0.299792458  # m/ns
HEIGHT, INDEX, GROUP = 150.0, 1.33, 1.4


def record(attenuation, noise=0.0, seed=0, **changes):
    """A vertical lidar's ideal record: the solid angle of the aperture falls with 1/(n H + D)^2."""
    start, width, bins = 2 * HEIGHT / C0 - 10, 0.5, 260
    depth = C0 * (start + (np.arange(bins) + 0.5) * width - 2 * HEIGHT / C0) / (2 * GROUP)
    energy = np.where(depth > 0, np.exp(-2 * attenuation * depth) / (INDEX * HEIGHT + depth) ** 2, 0)
    energy = energy * (1 + noise * np.random.default_rng(seed).standard_normal(bins))
    attributes = {"altitude": HEIGHT, "off_nadir_deg": 0.0, "refractive_index": INDEX, "group_index": GROUP}
    attributes |= {"divergence_mrad": 2.0, "field_of_view_mrad": 10.0, **changes}
    energy, error = np.array([energy, energy]), np.abs([noise * energy, noise * energy])
    return made(energy, error, start=start, names=["a", "b"], centres=[(1, 0), (-1, 0)], **attributes)


@pytest.mark.slow
def test_standard_error_is_the_scatter_of_the_slope():
    found = np.array([effective_attenuation(record(0.2, noise=0.05, seed=seed), 1.0, 5.0) for seed in range(300)])
    # Both pixels share their noise here, and count as independent: the error comes out by sqrt(2) too small.
    pull = (found[:, 0] - 0.2) / found[:, 1] / np.sqrt(2)
    assert abs(pull.mean()) < largest_z(300) / np.sqrt(300)
    assert pull.std() == pytest.approx(1, abs=largest_z(300) / np.sqrt(600))


def test_jackknife_sees_correlated_bins():
    """Passes with bins correlated in blocks of eight: eight times the variance of independent bins."""
    geometry = LidarGeometry(HEIGHT, 0.0, INDEX, GROUP)
    time = TimeAxis(2 * HEIGHT / C0 - 0.25, 0.5, 100)
    column = ColumnBins.between(geometry, 1e-3, time, 0.5, 5.0)
    bins, rng = column.inside.size, np.random.default_rng(3)
    ideal = np.exp(-0.4 * column.path) * column.gain
    found = []
    for _ in range(200):
        blocks = np.repeat(rng.standard_normal((40, -(-bins // 8))), 8, axis=1)[:, :bins]
        found.append(slope_and_error(column, ideal * (1 + 0.2 * blocks)))
    slopes, errors = np.array(found).T
    assert errors.mean() == pytest.approx(slopes.std(), rel=largest_z(200) / np.sqrt(400))
    _, independent = column.weights(ideal, ideal * 0.2 / np.sqrt(40))
    assert errors.mean() > 2 * independent


@refuses(
    ((5, 1), {}, "max_depth = 1 m must be greater than min_depth = 5 m"),
    ((1, np.nan), {}, "max_depth = nan must be finite"),
    ((1, 40), {}, "the record must contain .* the depths from 1 to 40 m: change time_start_ns or bin_count"),
    ((1, 1.05), {}, "have 1 bins between them and must have at least 3"),
    # The beam's edge, 15 mrad out, is 1.533 m of air farther: 1.095 m of water, at cos 0.9266.
    ((0.5, 5), {"off_nadir_deg": 30.0, "divergence_mrad": 10.0, "field_of_view_mrad": 40.0}, "at least 1.01 m"),
)
def test_depths_that_do_not_serve(depths, changes):
    effective_attenuation(record(0.2, **changes), *depths)


SCENE = {"off_nadir_deg": 0, "spectrum": "flat", "slope_variance": 1e-4, "time_start_ns": 1330, "bin_count": 80}


@pytest.mark.slow
@refuses(
    ([10, 6000], {}, {"off_nadir_deg": 20}, "field_of_view_mrad = 6000 must lie between 0.001 and 3000"),
    ([10], {"max_depth": 7.9}, {"off_nadir_deg": 20, "time_start_ns": 1400}, r"at most 7\.2.* 'bottom' can begin"),
    ([10], {"max_depth": 7.0}, {"bin_count": 60}, "the record must contain"),
    ([10], {}, {"layer_tops": "0, 3", "attenuation": "0.3, 0.4"}, "the water has 2 layers from min_depth = 1 m to"),
)
def test_scenes_and_options_that_do_not_serve(fields, options, params):
    scattering("table1", {**SCENE, "bin_count": 110, **params}, fov_mrad=fields, **{"passes": 4, **options})
