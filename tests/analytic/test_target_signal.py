"""A target's own signal: with and without it on common random numbers."""

import mitsuba as mi
import numpy as np
import pytest
from rows import must_refuse, refuses

from mitransient_lidar.core.errors import UserError
from mitransient_lidar.studies.detection import detect
from mitransient_lidar.studies.target_signal import describe_target, target_map

NEAR = {"surface_size": 200, "bin_count": 170}
SMALL = {"type": "lidar_merging", "paths_per_pass": 2**13, "photons_per_pass": 2**13}
#: For what is refused.
FEW = {**SMALL, "paths_per_pass": 1024, "photons_per_pass": 1024}


def target_signal(*given, **options):
    return detect(*given, receiver="none", **options)


@pytest.fixture(scope="module")
def squares():
    return target_signal("fig13_2x2", NEAR, passes=16, integrator=SMALL)


@pytest.fixture(scope="module")
def strips():
    return target_signal("fig14_1x4", NEAR, passes=32)


@pytest.fixture(params=["squares", pytest.param("strips", marks=pytest.mark.long)])
def published(request):
    return request.getfixturevalue(request.param)


@pytest.mark.long
def test_common_random_numbers_know_the_target_better_than_the_records(published):
    """Where the target's echo is not, both records are of the same paths, so that their difference is known to be 0."""
    before = published.sel(time=slice(1420, 1470))
    # Light from the target shares full cells, of which only some light is kept: rarely that moves a bright path, which
    # is in the few bins of a pulse.
    for same in (
        np.abs(before["difference"]) < 1e-5 * before["waveform"].max(),
        before["difference_stderr"] <= 1e-2 * before["waveform_stderr"],
    ):
        assert same.mean() > 0.75
    lit = published["difference_stderr"].sel(time=slice(1480, 1500)).mean()
    assert lit < published["waveform_stderr"].sel(time=slice(1480, 1500)).mean()


@pytest.mark.slow
def test_near_pixels_hold_the_published_target(published):
    """FOI-R--2074--SE, figures 13 and 14: blue and black contain the largest part of the target's echo."""
    share = published["echo"] / published["echo"].sum()
    assert share.sel(pixel=["blue", "black"]).sum() > 0.9


@pytest.mark.slow
def test_best_weights_are_no_worse_than_the_sum_or_any_pixel(published):
    snr = published["combined_detectability"].sel(combination="best")
    assert snr >= published["combined_detectability"].sel(combination="sum")
    assert snr >= published["detectability"].max()


@pytest.mark.slow
def test_target_shades_the_bottom_behind_it(published):
    assert float(published["shadow"].sum()) < -5 * float(published["shadow_stderr"].sum())


@pytest.mark.slow
def test_table_lists_pixels_and_combinations(published):
    lines = describe_target(published)
    assert [line.split()[0] for line in lines[2:]] == ["red", "green", "blue", "black", "sum", "best"]
    assert lines[-2].split()[4] == "100.0"


@pytest.mark.slow
@refuses(
    ("fig13_2x2", {}, {"target_id": "mine"}, "target_id = 'mine' must be the id of a shape of the scene: .*bottom"),
    ("fig13_2x2", {}, {"target_id": "surface"}, "target_id = 'surface' must not be the sea surface"),
    ("fig13_2x2", {"target_depth": 13}, {}, "target 'target' lies below the bottom, up to z = -13 m"),
    ("fig13_2x2", {"target_reflectance": 0}, {}, "it returns no light"),
    ("fig13_2x2", {"layout": "8x8"}, {}, "is an imager"),
)
def test_invalid_input_is_refused(scene, params, options):
    target_signal(scene, {**NEAR, **params}, passes=16, integrator=FEW, **options)


@pytest.mark.slow
def test_target_above_the_sea_is_refused(lidar_scene):
    plate = {"type": "rectangle", "to_world": mi.ScalarTransform4f().translate([0, 0, 3])}
    with pytest.raises(UserError, match="target 'target' lies above the sea, from z = 3 m"):
        target_signal(lidar_scene(extra={"target": plate}), passes=16)


@pytest.mark.slow
def test_map_needs_a_target_that_can_be_moved():
    must_refuse("has no parameter target_x", target_map, "fig09_2x2", None, [0.0], [0.0], passes=16)


@pytest.mark.slow
def test_map_has_places_that_the_beam_misses():
    maps = target_map("fig13_2x2", NEAR, x=[0.0, 60.0], y=[0.0], passes=16, integrator=FEW)
    near, far = maps["combined_echo"].sel(combination="sum", target_y=0.0).values
    assert near > 0
    assert abs(far) < 1e-3 * near
