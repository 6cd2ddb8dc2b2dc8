"""The number of processors that a process may use, and progress in notebooks and elsewhere."""

import inspect
import os
import sys
from types import ModuleType, SimpleNamespace

import drjit as dr
import pytest
from rows import each_row

import mitransient_lidar
from mitransient_lidar.core import options as shown
from mitransient_lidar.core import processors
from mitransient_lidar.core.options import checked
from mitransient_lidar.loading import variants
from mitransient_lidar.rendering.passes import Progress


@pytest.fixture
def groups(tmp_path, monkeypatch):
    """Sixteen processors, and a writer of what the system shows of control groups."""
    monkeypatch.setattr(os, "sched_getaffinity", lambda _process: set(range(16)), raising=False)
    monkeypatch.setattr(processors, "_GROUPS", tmp_path / "cgroup")
    monkeypatch.setattr(processors, "_MOUNT", tmp_path / "mount")

    def write(own, **limits):
        (tmp_path / "cgroup").write_text(own)
        for name, text in limits.items():
            path = tmp_path / "mount" / name.replace("__", "/").replace("_dot_", ".")
            path.parent.mkdir(parents=True, exist_ok=True)
            path.write_text(text)

    return write


@each_row(
    ("", {}, 16),
    ("0::/batch/job\n", {"batch__job__cpu_dot_max": "max 100000\n"}, 16),
    ("0::/batch/job\n", {"batch__job__cpu_dot_max": "200000 100000\n"}, 2),
    # A part of a processor is one; a group above has the smaller quota; one of more processors than there are.
    ("0::/batch/job\n", {"batch__job__cpu_dot_max": "20000 100000\n"}, 1),
    ("0::/batch/job\n", {"batch__job__cpu_dot_max": "max 100000", "batch__cpu_dot_max": "250000 100000\n"}, 3),
    ("0::/\n", {"cpu_dot_max": "9900000 100000\n"}, 16),
    # A container of the first version sees its own group as the mount; memory limits no processors.
    (
        "7:memory:/a\n3:cpu,cpuacct:/docker/1f\n",
        {"cpu,cpuacct__cpu_dot_cfs_quota_us": "400000\n", "cpu,cpuacct__cpu_dot_cfs_period_us": "100000\n"},
        4,
    ),
    ("1:cpu:/\n", {"cpu__cpu_dot_cfs_quota_us": "-1\n", "cpu__cpu_dot_cfs_period_us": "100000\n"}, 16),
)
def test_quotas(own, limits, number, groups):
    groups(own, **limits)
    assert processors.usable_processors() == number


def test_affinity(groups, monkeypatch):
    groups("0::/\n", cpu_dot_max="300000 100000\n")
    monkeypatch.setattr(os, "sched_getaffinity", lambda _process: {5})
    assert processors.usable_processors() == 1
    monkeypatch.delattr(os, "sched_getaffinity")
    monkeypatch.setattr(os, "cpu_count", lambda: None)
    assert processors.usable_processors() == 1


def test_renders_use_as_many_threads(monkeypatch):
    """Dr.Jit respects the affinity, but not the quota of a container."""
    before = dr.thread_count()
    try:
        for usable, number in ((before + 1, before), (1, 1)):
            monkeypatch.setattr(variants, "usable_processors", lambda usable=usable: usable)
            variants.limit_threads()
            assert dr.thread_count() == number
    finally:
        dr.set_thread_count(before)


@pytest.fixture
def cell(monkeypatch):
    """Stand for IPython; return what is shown below the cell, one state after the other, and the shell."""
    states, shell = [], SimpleNamespace(kernel=None)
    ipython, display = ModuleType("IPython"), ModuleType("IPython.display")
    ipython.get_ipython = lambda: shell
    display.HTML = str
    display.display = lambda first, display_id: states.append(first) or SimpleNamespace(update=states.append)
    monkeypatch.setitem(sys.modules, "IPython", ipython)
    monkeypatch.setitem(sys.modules, "IPython.display", display)
    monkeypatch.setattr(shown, "_INTERVAL_S", 0.0)
    return states, shell


@checked
def inner(progress=None):
    if progress is not None:
        progress(Progress(1, 4, "pass"))
        progress(Progress(2, None, "<b>"))


@checked
def outer(progress=None):
    inner()
    if progress is not None:
        progress(Progress(3, 4, "render"))
        raise KeyboardInterrupt


def test_a_notebook_shows_the_progress_of_the_call_alone(cell):
    states, shell = cell
    inner()
    bars = ['<progress value="1" max="4"></progress> pass 1/4', "<progress></progress> &lt;b&gt; 2"]
    assert states == ["preparing", *bars, ""]
    states.clear()
    with pytest.raises(KeyboardInterrupt):
        outer()
    assert states == ["preparing", '<progress value="3" max="4"></progress> render 3/4', ""]
    states.clear()
    own = []
    inner(progress=own.append)
    del shell.kernel  # a terminal
    inner()
    assert (len(own), states) == (2, [])


def test_every_public_function_with_progress_shows_it():
    public = {name: getattr(mitransient_lidar, name) for name in mitransient_lidar.__all__}
    taking = {
        name: one for name, one in public.items() if callable(one) and "progress" in inspect.signature(one).parameters
    }
    assert {"render", "render_shots", "fit", "bounds", "campaign", "fly"} <= taking.keys()
    assert all("progress_of" in one.__code__.co_names for one in taking.values())
