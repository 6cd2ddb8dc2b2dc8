import contextlib
import errno
import os
import re
import shutil
import warnings
from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest
import xarray as xr
import zarr
from rows import each_case, each_row, must_refuse

from mitransient_lidar.campaigns import sweep
from mitransient_lidar.campaigns.design import Campaign
from mitransient_lidar.campaigns.runs import Array, RunRenderer
from mitransient_lidar.campaigns.store import DONE, FAILED, PLANNED, Store, open_campaign, reporting_damage, seal
from mitransient_lidar.campaigns.sweep import describe_campaign
from mitransient_lidar.core import validation
from mitransient_lidar.core.errors import UserError
from mitransient_lidar.loading.scene_source import SceneSource
from mitransient_lidar.loading.scenes import open_scene
from mitransient_lidar.physics.lidar.time_axis import TimeAxis

CAMPAIGN = Campaign.of_file(
    {
        "scene": "table1",
        "parameters": {"time": {"low": 1, "high": 2}, "layout": ["1x1", "2x2"]},
        "design": {"kind": "random", "count": 10, "shots": 3},
    }
)
AXIS = TimeAxis(1000.0, 0.5, 4)
ARRAYS = {
    "waveform": Array(("shot", "pixel", "time"), np.zeros((3, 2, 4), dtype=np.float32), {"units": "W"}),
    "echo_flags": Array(("shot", "pixel"), np.zeros((3, 2), dtype=np.int16), {}),
    "surface_seed": Array((), np.asarray(0), {}),
}
COORDINATES = {
    "pixel": Array(("pixel",), np.array(["red", "blue"]), {}),
    "time": Array(("time",), AXIS.centres_ns, {"units": "ns"}),
}


@pytest.fixture
def path(tmp_path):
    return tmp_path / "campaign.zarr"


RECORD = SceneSource("table1", "<scene/>", True, {"time": "0"}, {})


@pytest.fixture(scope="module")
def made(tmp_path_factory):
    """Folder with a new store and with a full one: all of its runs are done, with values that are fill values, too."""
    folder = tmp_path_factory.mktemp("stores")
    renderer = RunRenderer(CAMPAIGN, RECORD, AXIS)
    store = Store.create(folder / "new", renderer, CAMPAIGN.table(), ARRAYS, COORDINATES, shard_size=4)
    shutil.copytree(folder / "new", folder / "full")
    full = Store(folder / "full")
    for shard in store.shards:
        status, errors, arrays = filled(full, shard, 0)
        arrays["waveform"][...] = np.nan if shard else 7
        full.write(shard, np.full_like(status, DONE), errors, arrays)
    assert (full.status() == DONE).all()
    return folder


@pytest.fixture
def store(made, path):
    return Store(shutil.copytree(made / "new", path))


@pytest.fixture
def full(made, path):
    return Store(shutil.copytree(made / "full", path))


def out_of_space(*_, **__):
    raise OSError(errno.ENOSPC, os.strerror(errno.ENOSPC))


def filled(store, shard, value):
    status, errors, arrays = store.read(shard)
    return status, errors, {name: np.full_like(array, value) for name, array in arrays.items()}


def test_new_store_is_empty_and_complete(store, path):
    assert list(store.shards) == [0, 1, 2]
    assert [store.runs_of(shard) for shard in store.shards] == [slice(0, 4), slice(4, 8), slice(8, 10)]
    with warnings.catch_warnings():
        warnings.simplefilter("error")
        data = xr.open_zarr(path, consolidated=False).load()
    assert dict(data.sizes) == {"run": 10, "shot": 3, "pixel": 2, "time": 4}
    assert np.isnan(data["waveform"]).all()
    assert not data["status"].any()
    # A parameter may have the name of another coordinate.
    np.testing.assert_array_equal(data["time_input"], CAMPAIGN.table()["time"])
    assert set(data["layout"].values.tolist()) == {"1x1", "2x2"}
    assert {"time_input", "layout", "surface_seed"} <= set(data.coords)
    assert data["pixel"].values.tolist() == ["red", "blue"]
    assert (data.attrs["time_start_ns"], data.attrs["bin_width_ns"]) == (1000, 0.5)


def test_a_store_is_completed_by_its_own_campaign_only(store):
    renderer = store.renderer()
    assert (renderer.plan.text, renderer.axis, renderer.scene.parameters) == (CAMPAIGN.text, AXIS, {"time": "0"})
    store.require(CAMPAIGN, CAMPAIGN.table(), lambda: RECORD)
    given = {"scene": "table1", "parameters": {"time": [1, 2]}, "design": {"kind": "random", "count": 10}}
    other, edited = Campaign.of_file(given), CAMPAIGN.table()
    edited["time"] = edited["time"] + 1e-9
    changed = replace(RECORD, text="<scene></scene>")
    for rows in ((other, other.table(), RECORD), (CAMPAIGN, edited, RECORD), (CAMPAIGN, CAMPAIGN.table(), changed)):
        with pytest.raises(UserError, match="holds another campaign, or its scene has changed"):
            store.require(*rows[:2], lambda scene=rows[2]: scene)


def test_shards_are_written_and_read(store, path):
    status, errors, arrays = filled(store, 1, 7)
    status[:], errors[:] = DONE, ""
    status[2], errors[2] = FAILED, "attenuation = -1 must not be negative: it is a rate ∞"
    store.write(1, status, errors, arrays)
    again = store.read(1)
    assert again[0].tolist() == [1, 1, 2, 1]
    assert again[1].tolist() == errors.tolist()
    data = open_campaign(path).load()
    assert (data["waveform"].isel(run=slice(4, 8)) == 7).all()
    assert np.isnan(data["waveform"].isel(run=[0, 3, 8])).all()
    assert describe_campaign(path) == [
        "10 runs: 3 done, 1 failed, 6 planned",
        f"failed 1, the first run 6: {errors[2]}",
    ]


def test_a_finished_shard_is_not_written_again(store, path):
    status, errors, arrays = filled(store, 0, 7)
    store.write(0, np.full_like(status, DONE), errors, arrays)
    store.write(0, status, errors, {name: array + 1 for name, array in arrays.items()})
    assert (open_campaign(path)["waveform"].isel(run=slice(0, 4)) == 7).all()
    assert store.status().tolist() == [1, 1, 1, 1, 0, 0, 0, 0, 0, 0]


def test_status_is_written_last(store, path, monkeypatch):
    """A disk that is full while the arrays are written leaves runs that are planned."""
    status, errors, arrays = filled(store, 0, 7)

    def write(array, runs, values, *, original=zarr.Array.__setitem__):
        return out_of_space() if array.basename == "echo_flags" else original(array, runs, values)

    monkeypatch.setattr(zarr.Array, "__setitem__", write)
    with pytest.raises(UserError, match=r"cannot write .*campaign\.zarr: No space left on device"):
        store.write(0, np.full_like(status, DONE), errors, arrays)
    assert not Store(path).status().any()


def flip(path):
    data = bytearray(path.read_bytes())
    data[len(data) // 2] ^= 4
    path.write_bytes(data)


CHUNKS = ["waveform/c/1/0/0/0", "echo_flags/c/1/0/0", "error/c/1", "status/c/1", "surface_seed/c/1"]


@each_case(
    *((chunk, flip) for chunk in CHUNKS), (CHUNKS[0], Path.unlink), (CHUNKS[1], lambda path: path.write_bytes(b""))
)
def test_damaged_shards_are_planned_again(chunk, damage, full, path, caplog):
    damage(path / chunk)
    store = Store(path)
    store.mend()
    if not (chunk.startswith("status") and damage is Path.unlink):
        assert "runs 4 to 7 are rendered again" in caplog.text
        assert chunk.split("/")[0] in caplog.text
    assert store.status().tolist() == [DONE] * 4 + [PLANNED] * 4 + [DONE] * 2
    status, errors, arrays = store.read(1)
    assert status.tolist() == [PLANNED] * 4
    assert errors.tolist() == [""] * 4
    store.write(1, np.full_like(status, DONE), errors, arrays)
    caplog.clear()
    store.mend()
    assert not caplog.text
    assert (store.status() == DONE).all()


def test_a_store_with_a_lost_chunk_is_read_without_its_runs(full, path):
    (path / "waveform/c/0/0/0/0").unlink()
    data = open_campaign(path)
    assert data["status"].values.tolist() == [PLANNED] * 4 + [DONE] * 6
    assert describe_campaign(path) == ["10 runs: 6 done, 0 failed, 4 planned"]


def test_damaged_values_are_not_read(full, path):
    flip(path / "waveform/c/0/0/0/0")
    data = open_campaign(path)
    with pytest.raises(UserError, match=r"campaign\.zarr is damaged"), reporting_damage(path):
        data["waveform"].load()
    (path / "waveform" / "zarr.json").write_text("{")
    must_refuse(r"campaign\.zarr is damaged", Store, path)


@each_row("time", "time_input", "pixel", "run", "shot", "layout")
@each_row(flip, Path.unlink)
def test_damaged_coordinates_are_refused(damage, name, made, tmp_path):
    path = shutil.copytree(made / "full", tmp_path / "campaign.zarr")
    damage(path / name / "c" / "0")
    with pytest.raises(ValueError, match=r"campaign\.zarr is damaged|checksum"):
        open_campaign(path).load()


@each_row("time", "time_input", "pixel", "run", "shot", "layout", "waveform")
def test_a_store_that_has_lost_an_array_is_refused(name, made, tmp_path):
    path = shutil.copytree(made / "full", tmp_path / "campaign.zarr")
    shutil.rmtree(path / name)
    must_refuse(rf"campaign\.zarr is damaged: (it has lost {name}|{name} cannot be read)", open_campaign, path)


@pytest.mark.parametrize(
    ("change", "message"),
    [
        ({"runs": 10**9}, "is no store"),
        ({"runs": 11}, "has the shape"),
        ({"runs": "ten"}, "is no store"),
        ({"shard_size": 5}, "has the shape"),
        ({"variables": 3}, "is no store"),
        ({"variables": ["nothing"]}, "nothing cannot be read"),
        ({"campaign": "{}"}, "is no store"),
        ({"record": [0, 1, 2]}, ""),
    ],
)
@pytest.mark.parametrize("sealed", [True, False])
def test_edited_attributes_are_refused(full, path, change, message, sealed):
    """Those of an author who has made the checksum anew, too, where they do not fit the arrays."""
    group = zarr.open_group(str(path), mode="r+")
    attributes = {**group.attrs, **change}
    group.attrs.update({**change, **({"sha256": seal(attributes)} if sealed else {})})
    if sealed and not message:
        Store(path)
        return
    must_refuse(message if sealed else "is no store|its attributes have changed", Store, path)


def test_a_store_that_another_process_has_just_made(full, path):
    """The second one of two sweeps that begin together goes on with the store of the first one."""
    renderer = RunRenderer(CAMPAIGN, RECORD, AXIS)
    made = Store.create(path, renderer, CAMPAIGN.table(), ARRAYS, COORDINATES, shard_size=4)
    assert (made.status() == DONE).all()
    assert [one.name for one in path.parent.iterdir()] == [path.name]


def test_failed_creation_leaves_nothing(path, monkeypatch):
    monkeypatch.setattr(zarr.Group, "create_array", out_of_space)
    with pytest.raises(UserError, match=r"cannot write .*campaign\.zarr: No space left on device"):
        Store.create(path, RunRenderer(CAMPAIGN, RECORD, AXIS), CAMPAIGN.table(), ARRAYS, COORDINATES)
    assert not list(path.parent.iterdir())


def test_lines_of_the_documentation_make_a_batch(tmp_path, monkeypatch):
    text = (Path(__file__).parents[3] / "docs" / "guide" / "campaigns.md").read_text()
    (code,) = re.findall(r"```python\n(.*?)```", text, re.DOTALL)
    arrays = {
        "signal": Array(("pixel", "time"), np.zeros((2, 4), dtype=np.float32), {}),
        "true_bottom_depth": Array((), np.zeros(()), {}),
    }
    columns = {"altitude": np.arange(10)}
    store = Store.create(tmp_path / "bottoms.zarr", RunRenderer(CAMPAIGN, RECORD, AXIS), columns, arrays, COORDINATES)
    for shard, runs in ((0, np.arange(8)), (1, np.arange(8, 10))):
        status, errors, values = store.read(shard)
        values["signal"][:], values["true_bottom_depth"][:] = 1e-4, runs
        store.write(shard, np.where(runs == 3, FAILED, DONE).astype(status.dtype), errors, values)
    monkeypatch.chdir(tmp_path)
    names = {}
    exec(code, names)
    x, y = names["batch"]
    # Of nine runs, those with numbers 0 and 5 are held out; each has two pixels.
    np.testing.assert_allclose(x, np.arcsinh(np.ones((14, 4))), rtol=1e-6)
    assert y.tolist() == [1, 1, 2, 2, 4, 4, 6, 6, 7, 7, 8, 8, 9, 9]


def test_size_of_shards(tmp_path):
    for count, size in ((5, 5), (64, 8), (160, 10), (2048, 128), (10**6, 1024)):
        given = RunRenderer(CAMPAIGN, RECORD, AXIS), {"altitude": np.arange(count)}, ARRAYS, COORDINATES
        assert Store.create(tmp_path / f"{count}.zarr", *given).shard_size == size


def test_shards_of_all_workers_are_within_the_memory(store, monkeypatch):
    monkeypatch.setattr(validation, "usable_memory", lambda: 2000.0)
    rendered = []
    monkeypatch.setattr(sweep, "on_this_machine", lambda few, *_: contextlib.nullcontext(few))
    monkeypatch.setattr(sweep, "_render", lambda store, shards, pool, tally: rendered.append(pool))
    sweep.complete(lambda: store, 2, None, False, None)
    with pytest.raises(UserError, match=r"4 runs, 3 at a time, take .* at most 2e-06 GB may be: take fewer workers"):
        sweep.complete(lambda: store, 4, None, False, None)
    assert rendered == [2]


@pytest.mark.parametrize("name", ["zarr.json", "waveform", "waveform/zarr.json", "status/c/0"])
def test_links_in_a_store_are_not_followed(store, path, tmp_path, name):
    status, errors, arrays = filled(store, 0, 1)
    status[:] = DONE
    store.write(0, status, errors, arrays)
    Store(path)
    victim = tmp_path / "victim"
    (path / name).rename(victim)
    (path / name).symlink_to(victim)
    for read in (Store, open_campaign, describe_campaign):
        must_refuse(f"{name} is a link, and no link in it is followed", read, path)
    os.mkfifo(victim.with_name("pipe"))
    (path / name).unlink()
    victim.with_name("pipe").rename(path / name)
    must_refuse(rf"{name}: it is a named pipe", Store, path)


def test_an_include_in_the_scene_of_a_store_is_refused(store, path):
    """Its seal is right: whoever changes the store makes it anew."""
    group = zarr.open_group(str(path), mode="r+")
    attributes = dict(group.attrs)
    attributes["scene"]["scene_xml"] = '<scene version="3.0.0"><include filename="part.xml"/></scene>'
    group.attrs.update({**attributes, "sha256": seal(attributes)})
    with pytest.raises(UserError, match=r"includes 'part.xml': only the file of a scene may include others"):
        open_scene(Store(path).renderer().scene)
