"""Renders, files, retrieval and records in threads: the same bits as alone, and nothing of the process changed."""

import concurrent.futures
import gc
import os
import signal
import sys
import threading
import warnings

import numpy as np
import OpenEXR
import pytest
from rows import each_case, must_refuse
from same_bits import assert_same_bits

import mitransient_lidar
from mitransient_lidar.core.formats.array_files import read_exr
from mitransient_lidar.loading.scenes import open_scene
from mitransient_lidar.results import save

SCENE = {"layout": "1x1", "spectrum": "flat", "time_start_ns": 1380, "bin_count": 200}
INTEGRATORS = (
    {"type": "lidar_merging", "paths_per_pass": 32768, "photons_per_pass": 32768},
    {"type": "lidar_volpath", "paths_per_pass": 65536},
)
RENDERS = [(integrator, seed) for seed in range(2) for integrator in INTEGRATORS]


#: Warnings that xarray silences while it computes.
_OF_XARRAY = ("All-NaN slice encountered", "Mean of empty slice", "Degrees of freedom <= 0 for slice")


def state():
    """Return what of the process a library call must not change."""
    handlers = [signal.getsignal(number) for number in (signal.SIGINT, signal.SIGTERM, signal.SIGHUP)]
    files = [(os.fstat(descriptor).st_dev, os.fstat(descriptor).st_ino) for descriptor in (0, 1, 2)]
    streams = sys.stdin, sys.stdout, sys.stderr
    # Functions of xarray that skip NaN restore the filters of another thread, which may be their own.
    filters = [one for one in warnings.filters if one[1] is None or one[1].pattern not in _OF_XARRAY]
    return handlers, files, streams, filters, dict(os.environ), os.getcwd(), np.geterr()


def open_files():
    """Return the number of open files; xarray closes those of former tests when it needs to."""
    if sys.platform != "linux":
        return 0
    descriptors = [f"/proc/self/fd/{name}" for name in os.listdir("/proc/self/fd")]
    # Matplotlib keeps the files of its fonts open for each thread.
    return sum(os.path.exists(one) and not os.path.realpath(one).endswith(".ttf") for one in descriptors)


def in_threads(count, function, given):
    """Return the values of a function, called in a number of threads; fail where the process is changed."""
    gc.collect()
    before, files = state(), open_files()
    with concurrent.futures.ThreadPoolExecutor(count) as pool:
        found = list(pool.map(function, given))
    gc.collect()
    assert state() == before
    assert open_files() <= files
    return found


def render(case):
    integrator, seed = case
    return mitransient_lidar.render("table1", params=SCENE, integrator=integrator, passes=2, seed=seed)


@pytest.fixture(scope="module")
def alone():
    return [render(case) for case in RENDERS]


@pytest.mark.slow
@each_case(2, pytest.param(4, marks=pytest.mark.long), pytest.param(8, marks=pytest.mark.long))
def test_renders_have_the_bits_of_those_alone(threads, alone):
    """Without a lock, 2 of 6 in two threads had others: long kernels, which begin at once, overlap."""
    starts, interval = threading.Barrier(threads), sys.getswitchinterval()

    def together(case):
        starts.wait()
        return render(case)

    try:
        sys.setswitchinterval(1e-5)
        found = in_threads(threads, together, 2 * RENDERS)
    finally:
        sys.setswitchinterval(interval)
    for expected, one in zip(2 * alone, found, strict=True):
        assert_same_bits(expected, one)


@pytest.mark.long
def test_a_scene_of_another_thread_has_the_bits_of_one_alone(alone):
    sessions = in_threads(4, lambda _: open_scene("table1", SCENE), range(4))

    def use(case):
        """Leave a scene to the garbage collection, which may free those of other threads, and render another one."""
        forgotten = [open_scene("table1", SCENE)]
        forgotten.append(forgotten)
        del forgotten
        gc.collect()
        integrator, seed = RENDERS[case]
        return mitransient_lidar.render(sessions[case], integrator=integrator, passes=2, seed=seed)

    # Each is rendered by a thread that another one has loaded it for, while others are loaded and freed.
    for expected, one in zip(alone, in_threads(4, use, range(4)), strict=True):
        assert_same_bits(expected, one)


@pytest.mark.parametrize("compression", ["B44", "DWAB"])
def test_lossy_images_have_the_bits_of_those_read_alone(tmp_path, compression):
    path, values = tmp_path / "a.exr", np.random.default_rng(1).random((64, 64)).astype(np.float16)
    header = {"compression": getattr(OpenEXR, f"{compression}_COMPRESSION"), "type": OpenEXR.scanlineimage}
    OpenEXR.File(header, {"Y": values}).write(str(path))
    (alone,) = read_exr(path).values()
    assert 0 < np.max(np.abs(alone - values)) < 0.2
    for found in in_threads(8, lambda _: read_exr(path), range(24)):
        assert [one.tobytes() for one in found.values()] == [alone.tobytes()]


@pytest.fixture(scope="module")
def result():
    few = {"type": "lidar_volpath", "paths_per_pass": 2**14}
    return mitransient_lidar.render("table1", params={"bin_count": 400}, integrator=few, passes=8, seed=3)


@pytest.mark.slow
def test_files_and_records_have_the_bits_of_those_alone(result, tmp_path):
    def use(case):
        """Write and read a result, and record it, while other threads do so."""
        found = []
        for suffix in (".exr", ".nc"):
            path, damaged = tmp_path / f"{case}{suffix}", tmp_path / f"damaged_{case}{suffix}"
            save(result.assign_attrs(case=case % 2), path)
            found.append(mitransient_lidar.open(path))
            damaged.write_bytes(path.read_bytes()[:-100])
            must_refuse("damaged", mitransient_lidar.open, damaged)
        recorded = mitransient_lidar.record(result, "published_airborne", seed=case % 2)
        return [*found, recorded, mitransient_lidar.echoes(recorded)]

    expected = [use(case) for case in range(2)]
    for case, found in enumerate(in_threads(4, use, range(4))):
        for one, other in zip(expected[case % 2], found, strict=True):
            assert_same_bits(one, other)
