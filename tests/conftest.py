"""Fixtures that every kind of test shares."""

import os
import signal

# Before NumPy: threads that wait for each other take more time than the small matrices of tests, all the more in two
# processes.
os.environ["OPENBLAS_NUM_THREADS"] = "1"
# Tests compile more than they run.
os.environ.setdefault("MITRANSIENT_LIDAR_QUICK_KERNELS", "1")

# Before Mitsuba: the package sets the path of LLVM for Dr.Jit.
import mitransient_lidar  # noqa: F401, I001

import drjit as dr
import numpy as np
import pytest
import significance

# Workers share the processors: threads that wait for each other's kernels take a fifth of the processor time.
dr.set_thread_count(max(1, dr.thread_count() // int(os.environ.get("PYTEST_XDIST_WORKER_COUNT", "1"))))

#: Comparisons of each worker of pytest-xdist.
_comparisons = {}


def pytest_addoption(parser):
    parser.addoption(
        "--seed-shift", type=int, default=0, metavar="N", help="use the Nth set of other random numbers everywhere"
    )


def pytest_configure(config):
    significance.shift_seeds(config.getoption("--seed-shift"))


@pytest.hookimpl(wrapper=True)
def pytest_make_collect_report(collector):
    """Let every second worker import from the end, so that two workers compile different modules in a new clone."""
    report = yield
    if isinstance(collector, pytest.Directory) and os.environ.get("PYTEST_XDIST_WORKER", "gw0")[2:] in "13579":
        report.result.reverse()
    return report


def pytest_collection_modifyitems(items):
    items.sort(key=lambda item: item.path)


def pytest_testnodedown(node):
    _comparisons[node.gateway.id] = getattr(node, "workeroutput", {}).get("comparisons", 0)


@pytest.hookimpl(trylast=True)
def pytest_sessionfinish(session):
    """Fail a run whose comparisons are so many that chance alone would fail it too often."""
    if hasattr(session.config, "workeroutput"):
        session.config.workeroutput["comparisons"] = significance.comparisons
        return
    count = sum(_comparisons.values()) + significance.comparisons
    chance = count * significance.FALSE_ALARM
    print(f"\n{count} comparisons of random numbers: a false alarm in at most {chance:.1e} of all runs")
    if chance > significance.SUITE_FALSE_ALARM and session.exitstatus == pytest.ExitCode.OK:
        session.exitstatus = pytest.ExitCode.TESTS_FAILED


@pytest.fixture(autouse=True, scope="session")
def variant():
    """Run in the variant that the package has chosen, and leave it set: in another one there are no plugins."""
    import mitsuba as mi

    from mitransient_lidar.loading.variants import SUPPORTED_VARIANTS

    chosen = mi.variant()
    assert chosen in SUPPORTED_VARIANTS
    yield chosen
    assert mi.variant() == chosen


@pytest.fixture(autouse=True)
def clean_drjit():
    """Leave Dr.Jit's flags as they were, whatever a test sets."""
    flags = {flag: dr.flag(flag) for flag in (dr.JitFlag.SymbolicLoops, dr.JitFlag.SymbolicCalls)}
    yield
    for flag, value in flags.items():
        dr.set_flag(flag, value)


def _build(*, integrator=None, tx=None, rx=None, film=None, sea=None, water=None, bottom=8.0, rho=0.1, extra=None):
    """Return a loaded scene: the table system over a flat, almost smooth sea, with changes by group."""
    import mitsuba as mi

    scene = {
        "type": "scene",
        "integrator": {"type": "lidar_volpath", "paths_per_pass": 2**16, **(integrator or {})},
        "tx": {"type": "lidar_transmitter", **(tx or {})},
        "rx": {
            "type": "multipixel_receiver",
            "film": {
                "type": "time_gated_film",
                **{"time_start_ns": 1390.0, "bin_width_ns": 1.0, "bin_count": 160, **(film or {})},
            },
            **(rx or {}),
        },
        "sea": {
            "type": "ocean_surface",
            "interior": {"type": "layered_water", "refractive_index": 1.34, "group_index": 1.34, **(water or {})},
            **{"spectrum": "flat", "slope_variance": "1e-4", **(sea or {})},
        },
        **(extra or {}),
    }
    if bottom is not None:
        scene["bottom"] = {
            "type": "rectangle",
            "to_world": mi.ScalarTransform4f().translate([0, 0, -bottom]).scale(500),
            "bsdf": {"type": "diffuse", "reflectance": {"type": "spectrum", "value": rho}},
        }
    return mi.load_dict(scene, parallel=False)


@pytest.fixture
def lidar_scene():
    return _build


@pytest.fixture
def default_ctrl_c():
    """Python's own handler: a shell that starts the tests in the background leaves Ctrl-C ignored."""
    before = signal.signal(signal.SIGINT, signal.default_int_handler)
    yield
    signal.signal(signal.SIGINT, before)


@pytest.fixture
def passes():
    """Function that renders independent passes: energies [J], shape (passes, pixels, bins)."""

    def run(scene, count, first_seed=0):
        renderer = scene.integrator().prepare(scene, scene.sensors()[0])
        seeds = range(first_seed, first_seed + count)
        return np.array([renderer.render_pass(seed).histogram.energy() for seed in seeds])

    return run


@pytest.fixture
def z_score():
    """Function (samples over passes, expected) -> (z, relative standard error), along axis 0."""

    def z(samples, expected):
        mean = samples.mean(axis=0)
        error = samples.std(axis=0, ddof=1) / np.sqrt(len(samples))
        return (mean - expected) / error, error / np.abs(mean)

    return z
