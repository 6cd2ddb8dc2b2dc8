"""One thread at a time uses Mitsuba."""

import ast
import os
import signal
import subprocess
import sys
import threading
from pathlib import Path

import mitsuba as mi
import pytest

import mitransient_lidar
from mitransient_lidar.core.interruption import DeferredInterrupt
from mitransient_lidar.loading.variants import alone

#: Functions that begin a use of Mitsuba, and classes and functions that leave it to their callers to be alone.
BEGIN = {"open_scene", "choose_integrator", "find_lidar_scene"}
WITHIN = {"Differences", "ShotScene", "choose_integrator", "scene_of", "axis_of"}
WITHIN |= {"beam_spread", "fov_sweep", "scattering_orders", "target_map"}


@alone
def turn(function=lambda: None):
    return function()


@pytest.fixture
def busy():
    """Another thread that has the turn until the test ends, or the event that it yields is set."""
    begun, end = threading.Event(), threading.Event()
    thread = threading.Thread(target=lambda: turn(lambda: begun.set() or end.wait(60)))
    thread.start()
    assert begun.wait(60)
    yield end
    end.set()
    thread.join()


def test_others_wait(busy):
    order = []
    second = threading.Thread(target=lambda: turn(lambda: order.append("second")))
    second.start()
    second.join(0.3)
    assert second.is_alive()
    order.append("first")
    busy.set()
    second.join(60)
    assert order == ["first", "second"]


def test_functions_call_each_other_and_raise():
    assert turn(lambda: turn(lambda: 3)) == 3
    with pytest.raises(ZeroDivisionError):
        turn(lambda: 1 / 0)
    found = []
    thread = threading.Thread(target=lambda: found.append(turn(lambda: 4)))
    thread.start()
    thread.join(60)
    assert found == [4]


@pytest.mark.parametrize("defers", [False, True])
def test_an_interruption_ends_the_waiting(busy, default_ctrl_c, defers):
    timer = threading.Timer(0.3, os.kill, [os.getpid(), signal.SIGINT])
    timer.start()
    with pytest.raises(KeyboardInterrupt), DeferredInterrupt(at_once=defers):
        turn()
    timer.join()
    busy.set()
    turn()


@pytest.mark.skipif(mi.variant().startswith("cuda"), reason="a forked process has no GPU")
def test_a_forked_process_does_not_wait_for_threads_that_it_lacks():
    script = """
import os, threading
from mitransient_lidar.loading.variants import alone
begun, end = threading.Event(), threading.Event()
threading.Thread(target=alone(lambda: begun.set() or end.wait(60))).start()
begun.wait()
child = os.fork()
if child == 0:
    os._exit(alone(lambda: 7)())
print(os.waitstatus_to_exitcode(os.waitpid(child, 0)[1]))
end.set()
"""
    run = subprocess.run([sys.executable, "-W", "ignore", "-c", script], capture_output=True, text=True, timeout=120)
    assert run.stdout == "7\n", run.stderr


def is_alone(function):
    decorators = [one.id for one in getattr(function, "decorator_list", []) if isinstance(one, ast.Name)]
    return not {"alone", "alone_with_scene"}.isdisjoint(decorators)


def uses(tree, outer=()):
    """Yield the functions that begin a use of Mitsuba, from the outermost class or function inwards."""
    for node in ast.iter_child_nodes(tree):
        inner = (*outer, node) if isinstance(node, (ast.FunctionDef, ast.ClassDef)) else outer
        if isinstance(node, ast.Call) and getattr(node.func, "id", getattr(node.func, "attr", "")) in BEGIN:
            yield outer
        yield from uses(node, inner)


def test_functions_that_begin_a_use_of_mitsuba_are_alone():
    package = Path(mitransient_lidar.__file__).parent
    paths = [
        path for folder in ("rendering", "studies", "flights", "campaigns") for path in (package / folder).rglob("*.py")
    ]
    found = [(path.name, outer) for path in paths for outer in uses(ast.parse(path.read_text("utf-8")))]
    assert len(found) > 20
    missing = {
        f"{name}: {outer[-1].name}"
        for name, outer in found
        if not any(is_alone(one) or one.name in WITHIN for one in outer) and not outer[-1].name.startswith("_")
    }
    assert not missing
