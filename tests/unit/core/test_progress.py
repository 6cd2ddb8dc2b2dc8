"""Progress of public functions in a notebook, which has an IPython with a kernel, and elsewhere."""

import inspect
import sys
from types import ModuleType, SimpleNamespace

import pytest

import mitransient_lidar
from mitransient_lidar.core import options as shown
from mitransient_lidar.core.options import checked
from mitransient_lidar.rendering.passes import Progress


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
