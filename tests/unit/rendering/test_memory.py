"""Sizes of large arrays are known before they are taken."""

import resource
import subprocess
import sys
from dataclasses import replace

import mitsuba as mi
import numpy as np
import pytest
import xarray as xr
from rows import each_case, must_refuse

import mitransient_lidar
from mitransient_lidar.core import validation
from mitransient_lidar.core.errors import UserError
from mitransient_lidar.loading.catalogue import scene_text
from mitransient_lidar.loading.scenes import open_scene
from mitransient_lidar.physics.lidar.time_axis import TimeAxis
from mitransient_lidar.physics.sea.sea_mesh import grid_indices
from mitransient_lidar.rendering.passive import render_passive
from mitransient_lidar.rendering.shots.batches import check_size
from mitransient_lidar.transport.merging.renderer import MergingRenderer
from mitransient_lidar.transport.rng import Shots

#: A task after a small one, within a limit of the memory; prints the bytes that were estimated, and its peak above that
#: before it [bytes].
LIMITED = """
import logging, re, resource, sys
resource.setrlimit(resource.RLIMIT_DATA, (6 * 2**30,) * 2)
import mitransient_lidar as ml
from mitransient_lidar.analysis import receiver
from mitransient_lidar.rendering.passive import render_passive
from mitransient_lidar.results.files import write_netcdf
small = {"bin_count": 400, "time_start_ns": 1380}
def record(shots):
    found = ml.record(result, "apd", shots=shots)
    write_netcdf(found, sys.argv[3])
result = ml.render("table1", params=small, passes=2)
def passive(pixels, **options):
    render_passive("passive_sea", params={"layout": f"{pixels}x{pixels}"}, passes=2, **options)
exec(sys.argv[1])
found = {}
class Handler(logging.Handler):
    def emit(self, record):
        if len(record.args) == 2 and record.msg.endswith("bytes"):
            found[record.args[0]] = record.args[1]
log = logging.getLogger("mitransient_lidar.core.validation")
log.setLevel(logging.DEBUG)
log.addHandler(Handler())
# A child begins with the ru_maxrss of its parent.
peak = lambda: int(re.search(r"VmHWM:\\s*(\\d+)", open("/proc/self/status").read())[1])
before = peak()
exec(sys.argv[2])
print(sum(found.values()), 1024 * (peak() - before))
"""


def limited(task, path, small=""):
    """Return the bytes that are estimated of a task, and its peak above that of a small one."""
    run = subprocess.run([sys.executable, "-c", LIMITED, small, task, str(path)], capture_output=True, text=True)
    assert run.returncode == 0, run.stderr[-2000:]
    return map(float, run.stdout.split())


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
    with pytest.raises(UserError, match=r"1000000000 records of 800 samples take 1\.28e\+04 GB of memory"):
        mitransient_lidar.record(result, "apd", shots=10**9)


@each_case(("lidar_merging", "photons_per_pass"), ("lidar_volpath", "paths_per_pass"))
def test_passes_that_exceed_the_memory_are_refused(integrator, count, monkeypatch):
    session = open_scene("table1", {"bin_count": 100, "time_start_ns": 1400, "spectrum": "flat"})
    options = mi.load_dict({"type": integrator, count: 2**28}, parallel=False)
    renderer = options.prepare(session.scene, session.sensor)
    monkeypatch.setattr(validation, "usable_memory", lambda: 2e9)
    must_refuse(rf"2684\d+ .*paths take .* GB of memory, .*: take fewer .*{count}", renderer.render_pass, 0)


def fitted(monkeypatch, memory, **layout):
    """Return the renderer of images of turbid water, whose capacities for segments are cut to a memory [bytes]."""
    monkeypatch.setattr(validation, "usable_memory", lambda: memory)
    water = {"attenuation": 10, "scattering": 8, "bin_count": 100, "time_start_ns": 1400, "spectrum": "flat"}
    session = open_scene("table1", {**water, "layout": "256x256"})
    renderer = session.scene.integrator().prepare(session.scene, session.sensor)
    renderer.layout = replace(renderer.layout, **layout)
    renderer._fit_segments(Shots([0]), renderer.paths)
    return renderer


def test_images_of_turbid_water_are_fitted_to_the_memory(monkeypatch):
    """Less than the capacity of 64 segments a path takes, of which 11 are stored."""
    layout = fitted(monkeypatch, 2.29e9).layout
    assert 11 < layout.light_segments < 64
    assert layout.light_segments == layout.sensor_segments
    # Until a pass has needed more.
    with pytest.raises(UserError, match=r"65536 photons and 1048576 paths take 2\.3. GB of memory"):
        fitted(monkeypatch, 2.29e9, least_segments=(62.0, 62.0))


@pytest.mark.slow
def test_a_pass_of_cut_buffers_has_the_bits_of_one_of_large_ones(monkeypatch):
    session = open_scene("table1", {"bin_count": 100, "time_start_ns": 1400, "spectrum": "flat"})
    options = mi.load_dict({"type": "lidar_merging", "paths_per_pass": 1024}, parallel=False)
    energies, segments = [], []
    for memory in (1e9, 2.92e7):
        monkeypatch.setattr(validation, "usable_memory", lambda memory=memory: memory)
        renderer = options.prepare(session.scene, session.sensor)
        energies.append(renderer.render_pass(0).histogram.energy())
        segments.append(renderer.layout.light_segments)
    np.testing.assert_array_equal(*energies)
    assert segments == [4.5, pytest.approx(2.6, abs=0.3)]
    # What a pass has needed is known after it, and no less is tried again.
    monkeypatch.setattr(validation, "usable_memory", lambda: 2.7e7)
    with pytest.raises(UserError, match=r"32768 photons and 1024 paths take 0\.02[78]. GB of memory"):
        options.prepare(session.scene, session.sensor).render_pass(0)


def test_meshes_series_and_frames_that_exceed_the_memory_are_refused(monkeypatch):
    monkeypatch.setattr(validation, "usable_memory", lambda: 1e9)
    must_refuse(r"1 meshes of 2114 x 2114 cells take 1\.25 GB", grid_indices, 2048, 50_000)
    must_refuse(r"1 meshes of 17592186044416 x 17592186044416 cells", grid_indices, 2**44, 50_000)
    must_refuse(r"64 meshes of 5.. x 5.. cells take .* GB", grid_indices, 512, 1000, 2.0, meshes=64)
    must_refuse(r"1000 shots of 4 pixels x 4000 bins take 1\.02 GB", check_size, 1000, 4, 4000)
    with pytest.raises(UserError, match=r"1000 frames of 65536 pixels take 3\.94 GB"):
        render_passive("passive_sea", {"layout": "256x256"}, frames=1000)


def test_too_many_solids_for_components_are_refused_before_a_renderer_is_prepared(tmp_path, monkeypatch):
    sphere = '<shape type="sphere" id="s{}"><float name="radius" value="0.01"/><bsdf type="diffuse"/></shape>'
    text = scene_text("table1").replace("</scene>", "".join(map(sphere.format, range(400))) + "</scene>")
    (tmp_path / "many.xml").write_text(text, "utf-8")
    monkeypatch.setattr(MergingRenderer, "__init__", lambda *_: pytest.fail("a renderer is prepared"))
    for render, more in ((mitransient_lidar.render, {}), (mitransient_lidar.render_shots, {"count": 2})):
        with pytest.raises(UserError, match="components: the scene has 401 solids; allowed are at most 30"):
            render(tmp_path / "many.xml", components=True, passes=2, **more)


def test_an_automatic_time_axis_has_a_longest_length():
    assert TimeAxis.covering(0, 1e7, 1e3).end_ns >= 1e7
    with pytest.raises(UserError, match=r"the time axis from 0 to 1\.1e\+07 ns is longer than 1e\+07 ns, the most"):
        TimeAxis.covering(0, 1.1e7, 1e3)
    assert TimeAxis.covering(0, 1.1e7, 1e3, None, 11_000).bin_count == 11_000


def test_a_long_record_needs_no_more_segments_at_first():
    """Light in a record of 1 ms would be scattered 16 000 times: its segments took 12.6 GB."""
    session = open_scene("table1", {"bin_width_ns": 1e6, "aim_x": -1e6})
    renderer = session.scene.integrator().prepare(session.scene, session.sensor)
    assert renderer.layout.light_segments == renderer.layout.sensor_segments == 64


RENDER = 'ml.render("table1", params={{**small, {}}}, passes=2, {})'
MERGING = 'integrator={{"type": "lidar_merging", "{}_per_pass": 2**19}}'
SHOTS = 'ml.render_shots("table1", params={{**small, "bin_count": {}}}, count={}, passes=2)'
#: Tasks that take memory, and small ones that compile their kernels.
TASKS = {
    "bins": (RENDER.format('"bin_count": 4 * 10**5', ""), ""),
    "derivatives": (RENDER.format('"bin_count": 10**5', 'derivatives=["attenuation", "scattering"]'), ""),
    "sea": (RENDER.format('"surface_cell_size": 0.01, "surface_refined_size": 10.24', ""), ""),
    "photons": (RENDER.format("", MERGING.format("photons")), ""),
    "paths": (RENDER.format("", MERGING.format("paths")), ""),
    "shots": (SHOTS.format(20000, 48), SHOTS.format(400, 2)),
    "record": ("record(20000)", "record(2)"),
    "passive": ("passive(1024)", "passive(64)"),
    "frames": ("passive(256, frames=40)", "passive(64, frames=2)"),
}


#: In the long tier, 5 to 30 s each: photons fill arrays as paths do; of the others the quick tier states the sizes.
LONG = ("bins", "derivatives", "sea", "photons", "shots", "record", "passive", "frames")


@each_case(*zip([pytest.param(name, marks=pytest.mark.long if name in LONG else pytest.mark.slow) for name in TASKS]))
def test_the_estimate_is_within_a_factor_of_two_of_the_peak(name, tmp_path):
    estimate, peak = limited(TASKS[name][0], tmp_path / "record.nc", TASKS[name][1])
    assert 0.5 < estimate / peak < 2, (estimate, peak)


#: Renders an image by the command, and prints the stated and the measured memory [GB].
IMAGE = """
import logging, re, sys
from mitransient_lidar.cli.app import main
found = []
class Handler(logging.Handler):
    def emit(self, record):
        found.extend(re.findall(r"the render takes ([0-9.]+) GB", record.getMessage()))
log = logging.getLogger("mitransient_lidar.rendering.render")
log.setLevel(logging.INFO)
log.addHandler(Handler())
try:
    main()
except SystemExit as ended:
    assert not ended.code
peak = int(re.search(r"VmHWM:\\s*(\\d+)", open("/proc/self/status").read())[1])
print(found[0], 1.024e-6 * peak)
"""


@each_case(
    pytest.param("256x256", "maps", 0.7, marks=pytest.mark.slow),
    pytest.param("640x512", "merging", 2, marks=pytest.mark.long),
    pytest.param("1280x1024", "maps", 1.85, marks=pytest.mark.long),
)
def test_images_take_the_memory_that_is_stated_before_the_render(layout, light, max_memory, tmp_path):
    gates = {"gate_start_ns": 1411, "gate_width_ns": 10, "gate_step_ns": 2.4, "gate_count": 40, "layout": layout}
    values = [word for name, value in gates.items() for word in ("-D", f"{name}={value}")]
    options = ["--light", light, "--max-memory", str(max_memory), "--passes", "2", "-o", str(tmp_path), "-q"]
    command = [sys.executable, "-c", IMAGE, "render", "fig09_2x2", *values, *options]
    run = subprocess.run(command, capture_output=True, text=True)
    assert run.returncode == 0, run.stderr[-2000:]
    stated, peak = map(float, run.stdout.splitlines()[-1].split())
    assert stated <= max_memory
    assert 0.85 < peak / stated < 1.15, (peak, stated)
