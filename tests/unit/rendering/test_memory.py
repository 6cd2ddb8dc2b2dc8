"""Sizes of large arrays are known before they are taken."""

import resource
import subprocess
import sys

import numpy as np
import pytest
import xarray as xr

import mitransient_lidar
from mitransient_lidar.core import validation
from mitransient_lidar.core.errors import UserError
from mitransient_lidar.loading.catalogue import scene_text
from mitransient_lidar.physics.lidar.time_axis import TimeAxis
from mitransient_lidar.rendering.session import open_scene
from mitransient_lidar.transport.merging.renderer import MergingRenderer

#: A render within a limit of the memory [bytes] of the process; prints its peak above that before it [bytes].
LIMITED = """
import re, resource, sys
resource.setrlimit(resource.RLIMIT_DATA, (int(sys.argv[1]),) * 2)
import mitransient_lidar
small = {"bin_count": 400, "time_start_ns": 1380}
mitransient_lidar.render("table1", params=small, passes=2)
# A child begins with the ru_maxrss of its parent.
peak = lambda: int(re.search(r"VmHWM:\\s*(\\d+)", open("/proc/self/status").read())[1])
before = peak()
mitransient_lidar.render("table1", params=eval(sys.argv[2]), passes=2, **eval(sys.argv[3]))
print(1024 * (peak() - before))
"""


def limited(params, options, limit=6 * 2**30):
    run = subprocess.run(
        [sys.executable, "-c", LIMITED, str(limit), repr(params), repr(options)], capture_output=True, text=True
    )
    assert run.returncode == 0, run.stderr[-2000:]
    return float(run.stdout)


def test_arrays_that_exceed_the_memory_are_refused(monkeypatch):
    monkeypatch.setattr(validation, "usable_memory", lambda: 2e9)
    validation.require_memory("histograms", 2e9, "take fewer")
    with pytest.raises(UserError, match=r"histograms take 2\.1 GB of memory, and at most 2 GB may be: take fewer"):
        validation.require_memory("histograms", 2.1e9, "take fewer")


def test_the_memory_of_a_limited_process_is_half_of_its_limit(monkeypatch):
    whole = validation.usable_memory()
    monkeypatch.setattr(resource, "getrlimit", lambda kind: (10**9, 10**9))
    assert validation.usable_memory() == 5e8 < whole


def test_records_that_exceed_the_memory_are_refused():
    coords = {"pixel": list("abcd"), "time": 1380.5 + np.arange(200.0)}
    result = xr.Dataset({"waveform": (("pixel", "time"), np.zeros((4, 200)))}, coords, {"bin_width_ns": 1.0})
    with pytest.raises(UserError, match=r"1000000000 records of 800 samples take 6\.4e\+03 GB of memory"):
        mitransient_lidar.record(result, "apd", shots=10**9)


def test_too_many_solids_for_components_are_refused_before_a_renderer_is_prepared(tmp_path, monkeypatch):
    sphere = '<shape type="sphere" id="s{}"><float name="radius" value="0.01"/><bsdf type="diffuse"/></shape>'
    text = scene_text("table1").replace("</scene>", "".join(map(sphere.format, range(400))) + "</scene>")
    (tmp_path / "many.xml").write_text(text, "utf-8")
    monkeypatch.setattr(MergingRenderer, "__init__", lambda *_: pytest.fail("a renderer is prepared"))
    for render, more in ((mitransient_lidar.render, {}), (mitransient_lidar.render_shots, {"count": 2})):
        with pytest.raises(UserError, match="components: the scene has 401 solids; allowed are at most 30"):
            render(tmp_path / "many.xml", components=True, passes=2, **more)


def test_an_automatic_record_has_a_longest_length():
    assert TimeAxis.covering(0, 1e7, 1e3).end_ns >= 1e7
    with pytest.raises(UserError, match=r"the record from 0 to 1\.1e\+07 ns is longer than 1e\+07 ns, the most of an"):
        TimeAxis.covering(0, 1.1e7, 1e3)
    assert TimeAxis.covering(0, 1.1e7, 1e3, None, 11_000).bin_count == 11_000


def test_a_long_record_needs_no_more_segments_at_first():
    """Light in a record of 1 ms would be scattered 16 000 times: its segments took 12.6 GB."""
    session = open_scene("table1", {"bin_width_ns": 1e6, "aim_x": -1e6})
    renderer = session.scene.integrator().prepare(session.scene, session.sensor)
    assert renderer.layout.light_segments == renderer.layout.sensor_segments == 64


@pytest.mark.slow
def test_a_long_record_is_rendered_in_little_memory():
    assert limited({"bin_width_ns": 1e6, "aim_x": -1e6}, {}) < 5e8


@pytest.mark.slow
@pytest.mark.parametrize(
    ("params", "options", "bins"),
    [
        ({"bin_count": 10**6, "time_start_ns": 1380}, {}, 4e6),
        ({"bin_count": 2 * 10**5, "time_start_ns": 1380}, {"components": True, "max_memory": 5}, 4 * 8e5),
        ({"bin_count": 2 * 10**5, "time_start_ns": 1380}, {"derivatives": ["attenuation", "scattering"]}, 3 * 8e5),
    ],
)
def test_the_estimate_is_within_a_factor_of_two_of_the_peak(params, options, bins):
    estimate = 116 * bins  # of `choose_accumulator`
    assert 0.5 < estimate / limited(params, options) < 2
