"""Passes that fit into a time limit."""

from types import SimpleNamespace

import mitsuba as mi
import numpy as np
import pytest
from rows import each_case
from significance import assert_same

from mitransient_lidar.loading import catalogue
from mitransient_lidar.loading import scenes as loading
from mitransient_lidar.rendering import pass_size
from mitransient_lidar.rendering.render import DEFAULT_GATE_GOAL, DEFAULT_GOAL


class Renderer:
    """Passes of 65 536 paths with 100 scattering events each; the clock of its trials is `clock`."""

    path_count = 2**16
    scene = SimpleNamespace(
        water=SimpleNamespace(column=SimpleNamespace(scattering=np.array([4.9 / 0.299792458])), plume=None),
        axis=SimpleNamespace(end_ns=120.0),
        group_index=6.0,
    )

    def __init__(self, share=1.0):
        self.share = share

    def scaled(self, share):
        return Renderer(self.share * share)


@pytest.fixture
def clock(monkeypatch):
    """Return the times of a trial's kernels and of its other work [s], to be set, and the number of trials."""
    state = SimpleNamespace(kernels=0.0, rest=0.0, trials=0, now=0.0)

    def timed(renderer, seed, gates, tiles):
        assert renderer.share == pass_size.SMALLEST_SHARE
        state.trials += 1
        state.now += state.kernels + state.rest
        return f"record {state.trials}", state.kernels, state.rest

    monkeypatch.setattr(pass_size, "timed_pass", timed)
    monkeypatch.setattr(pass_size.time, "perf_counter", lambda: state.now)
    monkeypatch.setattr(pass_size, "_at_once", lambda paths: 1.0)
    return state


@each_case(
    (4.0, 1e-3, 0.0, 1.0, 0),  # 6.6 million rays: below 2 million a second
    (1.0, 1e-3, 0.0, 2**-2, 2),  # a full pass takes 0.51 s, and the trials a little
    (1.1, 1e-3, 0.0, 1.0, 2),
    (1.0, 0.1, 0.0, 2**-8, 2),  # the trials take 0.2 s, and each of four passes as long
    (1.0, 0.1, 0.15, 2**-9, 2),  # the trials take 0.5 s
    (1.0, 0.1, 0.25, 2**-8, 2),  # the other work takes longer than the kernels
    (1.0, 40.0, 0.2, 2**-9, 1),  # the first trial exceeds the limit
)
def test_the_share_of_the_paths(limit, kernels, rest, expected, trials, clock):
    clock.kernels, clock.rest = kernels, rest
    renderer, share, first = pass_size.fit_to_time(Renderer(), limit, 20.0, seed=1, gates=None)
    assert (share, renderer.share, clock.trials) == (expected, expected, trials)
    assert first == (f"record {trials}" if share == pass_size.SMALLEST_SHARE else None)


@each_case(pytest.param("lidar_merging", marks=pytest.mark.slow), pytest.param("lidar_volpath", marks=pytest.mark.long))
def test_small_passes_have_the_mean_of_full_ones(integrator):
    """Energy in four gates of table1: 24 passes of a 64th of the paths, and 8 full ones.

    A share that is left out of the photons' or the paths' weights is a factor of 64.
    """
    scene = loading.open_scene("table1", {"spectrum": "flat"}).scene
    photons = {"photons_per_pass": 2**14} if integrator == "lidar_merging" else {}
    engine = mi.load_dict({"type": integrator, "paths_per_pass": 2**14, **photons})
    renderer = engine.prepare(scene, scene.sensors()[0])
    gates = []
    for share, count in ((1.0, 8), (1 / 64, 24)):
        passes = renderer.scaled(share)
        energy = np.array([passes.render_pass(seed).histogram.energy().sum(axis=0) for seed in range(count)])
        gates.append(energy[:, 28:108].reshape(count, 4, 20).sum(axis=2))
    # Cells of few photons are wider.
    assert_same(*gates, error=0.1, bias=0.02, known=0.3)


@pytest.mark.parametrize(
    "names",
    [
        pytest.param(["table1", "ship_wake", "thin_layer"], marks=pytest.mark.slow),
        pytest.param(catalogue.scene_names(), marks=pytest.mark.long),
    ],
    ids=["some", "all"],
)
def test_default_renders_of_shipped_scenes_have_full_passes_without_a_trial(monkeypatch, names):
    monkeypatch.setattr(pass_size, "timed_pass", None)
    for name in names:
        scene = loading.open_scene(name).scene
        renderer = scene.integrator().prepare(scene, scene.sensors()[0])
        goal = DEFAULT_GOAL if renderer.scene.gates is None else DEFAULT_GATE_GOAL
        start_ns = renderer.scene.axis.start_ns
        assert pass_size.fit_to_time(renderer, goal.max_time, start_ns, seed=0, gates=None) == (renderer, 1.0, None)
