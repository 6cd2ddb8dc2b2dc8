"""Files of gate stacks: content for other programs, exact round trips, damage."""

import json

import numpy as np
import OpenImageIO
import pytest
import xarray as xr
from rows import must_refuse

from mitransient_lidar import results
from mitransient_lidar.results import exr, files
from mitransient_lidar.results.gate_stack import check_stack

ATTRIBUTES = {"scene": "mine field", "seed": 2**40, "gate_rise_ns": 0.1, "gate_step_ns": 5.0, "pulses": 100}
ATTRIBUTES |= {"nothing": [], "one": [1.5], "names": ["rød", ""], "surface_time_ns": 1420.0625}


def make(rows=4, columns=5, gates=3, attributes=ATTRIBUTES, seed=7):
    """Return a stack of random energies, exact in 32 bits; `rows` 0 gives `columns` pixels."""
    rng = np.random.default_rng(seed)
    shape = (rows, columns) if rows else (columns,)
    dims = ("row", "column") if rows else ("pixel",)
    energy = rng.gamma(3.0, 1e-17, (*shape, gates)).astype(np.float32).astype(np.float64)
    stderr = (0.1 * energy).astype(np.float32).astype(np.float64)
    start = 1418.1 + 5.0 * np.arange(gates)
    coords = {
        "gate": np.arange(gates),
        "gate_start": ("gate", start, {"units": "ns"}),
        "gate_width": ("gate", np.full(gates, 10.1), {"units": "ns"}),
        "gate_depth": ("gate", (start + 5.05 - 1420.0625) / 9.4, {"units": "m"}),
        "angle_x": (dims, rng.normal(size=shape), {"units": "mrad"}),
        "angle_y": (dims, rng.normal(size=shape), {"units": "mrad"}),
    }
    coords |= {"row": np.arange(rows), "column": np.arange(columns)} if rows else {"pixel": list("abcdefgh"[:columns])}
    variables = {
        "gate_energy": ((*dims, "gate"), energy, {"units": "J", "long_name": "energy"}),
        "gate_energy_stderr": ((*dims, "gate"), stderr, {"units": "J"}),
    }
    return xr.Dataset(variables, coords, attributes)


def save_sequence(stack, folder, stem):
    exr.write_sequence(check_stack(stack), folder, stem)
    return [folder / f"{stem}_gate{k:03d}.exr" for k in range(stack.sizes["gate"])]


def parts_by_other_reader(path):
    """Read all parts with OpenImageIO: name, channel names, header attributes, values (row, column, channel)."""
    image = OpenImageIO.ImageInput.open(str(path))
    assert image is not None, OpenImageIO.geterror()
    parts = []
    index = 0
    while image.seek_subimage(index, 0):
        spec = image.spec()
        header = {attribute.name: attribute.value for attribute in spec.extra_attribs}
        values = image.read_image(index, 0, 0, spec.nchannels, OpenImageIO.FLOAT)
        kinds = {str(spec.channelformat(channel)) for channel in range(spec.nchannels)}
        parts.append((header, list(spec.channelnames), kinds, values))
        index += 1
    image.close()
    return parts


def assert_parts_show(parts, stack):
    energy, stderr = (stack[name].transpose(..., "gate").values for name in ("gate_energy", "gate_energy_stderr"))
    assert len(parts) == stack.sizes["gate"]
    for k, (header, channels, kinds, values) in enumerate(parts):
        assert header["oiio:subimagename"] == f"gate{k:03d}"
        assert channels == ["Y", "Y.stderr"]
        assert kinds == {"float"}
        np.testing.assert_array_equal(values[..., 0], np.atleast_2d(energy[..., k]))
        np.testing.assert_array_equal(values[..., 1], np.atleast_2d(stderr[..., k]))
        assert header["gateStartNs"] == pytest.approx(1418.1 + 5.0 * k, rel=1e-7)
        assert header["gateWidthNs"] == pytest.approx(10.1, rel=1e-7)
        assert header["gateDepthM"] == pytest.approx((1418.1 + 5.0 * k + 5.05 - 1420.0625) / 9.4, rel=1e-6)


@pytest.mark.parametrize("rows", [4, 0])
def test_another_reader_finds_one_part_a_gate(tmp_path, rows):
    stack = make(rows=rows)
    results.save(stack, tmp_path / "a.exr")
    parts = parts_by_other_reader(tmp_path / "a.exr")
    assert_parts_show(parts, stack)
    assert parts[0][3].shape == (rows or 1, 5, 2)
    header = parts[0][0]
    # 32-bit integers are all that a header holds.
    given = {"compression": "zip", "lidar.scene": "mine field", "lidar.seed": "1099511627776", "lidar.pulses": 100}
    assert {name: header[name] for name in given} == given
    assert json.loads(header["mitransientLidar"])["attributes"] == ATTRIBUTES
    assert "lidar.scene" not in parts[1][0]


def test_another_reader_finds_every_file_of_a_sequence(tmp_path):
    stack = make()
    paths = save_sequence(stack, tmp_path / "new" / "folder", "sand")
    assert [path.name for path in paths] == ["sand_gate000.exr", "sand_gate001.exr", "sand_gate002.exr"]
    assert sorted((tmp_path / "new" / "folder").iterdir()) == paths
    parts = [part for path in paths for part in parts_by_other_reader(path)]
    assert_parts_show(parts, stack)
    # A single file of a sequence has the metadata of its origin.
    assert [part[0]["lidar.scene"] for part in parts] == ["mine field"] * 3


@pytest.mark.parametrize("suffix", [".exr", ".nc", ".EXR"])
@pytest.mark.parametrize("rows", [4, 0])
def test_stacks_are_read_back(tmp_path, rows, suffix):
    stack = make(rows=rows)
    results.save(stack, tmp_path / f"a{suffix}")
    back = results.open(tmp_path / f"a{suffix}")
    xr.testing.assert_identical(back, stack)
    # Values beyond 32 bits are rounded in EXR only.
    more = stack.assign(gate_energy=stack["gate_energy"] / 3)
    results.save(more, tmp_path / f"b{suffix}")
    exact = more["gate_energy"] if suffix == ".nc" else more["gate_energy"].astype(np.float32)
    np.testing.assert_array_equal(results.open(tmp_path / f"b{suffix}")["gate_energy"], exact)
    assert {type(value) for value in back.attrs.values()} == {str, int, float, list}
    assert back["gate"].dtype == stack["gate"].dtype


def test_sequence_is_read_from_its_folder_and_its_first_file(tmp_path):
    stack = make()
    paths = save_sequence(stack, tmp_path, "a_gate001.exr")  # a stem that looks like a number
    xr.testing.assert_identical(results.open(tmp_path), stack)
    xr.testing.assert_identical(results.open(paths[0]), stack)
    for path in paths:  # all files may be renamed in the same way
        path.rename(path.with_name(path.name.replace("a_gate001.exr", "b")))
    xr.testing.assert_identical(results.open(tmp_path), stack)


def test_one_gate_and_unknown_depth(tmp_path):
    stack = make(gates=1).drop_vars("gate_depth")
    results.save(stack, tmp_path / "a.exr")
    xr.testing.assert_identical(results.open(tmp_path / "a.exr"), stack)
    assert "gateDepthM" not in parts_by_other_reader(tmp_path / "a.exr")[0][0]
    xr.testing.assert_identical(results.open(save_sequence(stack, tmp_path, "s")[0]), stack)


def test_what_is_left_out_and_what_needs_netcdf(tmp_path):
    """As of a render with gates and `components`, `derivatives` or `batches`, whose time bins another file holds."""
    stack = make()
    for dim in ("origin", "parameter", "batch"):
        more = {"waveform_more": ((dim, "row", "column", "time"), np.ones((2, 4, 5, 7)))}
        with_more = stack.assign(more).assign_coords({f"{dim}_names": (dim, ["a", "b"])})
        results.save(with_more, tmp_path / "gates.exr")
        xr.testing.assert_identical(results.open(tmp_path / "gates.exr"), stack)
    both = stack.transpose("gate", "column", "row").assign(
        waveform=(("row", "column", "time"), np.ones((4, 5, 7))), time=("time", np.arange(7.0))
    )
    results.save(both, tmp_path / "a.exr")
    xr.testing.assert_identical(results.open(tmp_path / "a.exr"), stack)
    more = stack.assign(contrast=("gate", [1.0, 2.0, 3.0]))
    must_refuse(r"cannot store the variable contrast; use a \.nc file", results.save, more, tmp_path / "b.exr")
    assert not (tmp_path / "b.exr").exists()
    results.save(more, tmp_path / "b.nc")
    xr.testing.assert_identical(results.open(tmp_path / "b.nc"), more)


def test_wrong_names(tmp_path):
    must_refuse("without folders", save_sequence, make(), tmp_path, "a/b")
    (tmp_path / "file").write_text("text")
    must_refuse("cannot write", save_sequence, make(), tmp_path / "file", "a")


@pytest.mark.parametrize("suffix", [".exr", ".nc"])
def test_damaged_files_are_rejected(tmp_path, suffix, capfd):
    whole, part = tmp_path / f"whole{suffix}", tmp_path / f"part{suffix}"
    results.save(make(), whole)
    data = whole.read_bytes()
    for length in {*range(8, len(data), 61), len(data) - 1}:
        part.write_bytes(data[:length])
        must_refuse(r"part\.\w+ is damaged or truncated", results.open, part)
    assert capfd.readouterr() == ("", "")


def test_incomplete_sequences_are_rejected(tmp_path, caplog):
    old = save_sequence(make(seed=1, gates=4), tmp_path, "a")
    must_refuse(r"is gate 2 of a sequence: open the folder or the first file, a_gate000\.exr", results.open, old[2])
    of_old = old[1].read_bytes()
    new = save_sequence(make(seed=2), tmp_path, "a")
    assert "a_gate003.exr does not belong to this sequence of 3 gates" in caplog.text
    xr.testing.assert_identical(results.open(tmp_path), make(seed=2))
    new[1].write_bytes(of_old)
    must_refuse("its 3 gates belong to different stacks", results.open, tmp_path)
    new[1].unlink()
    must_refuse(r"a_gate001\.exr: gate 1 of the 3 gates of the sequence is missing", results.open, tmp_path)
    new[0].rename(tmp_path / "first.exr")
    must_refuse(r"its name must end in _gate000\.exr", results.open, tmp_path / "first.exr")
    must_refuse("holds no sequence of gates", results.open, tmp_path)
    for stem in ("b", "c"):
        save_sequence(make(), tmp_path, stem)
    must_refuse(r"2 sequences of gates: open the first file of one \(b_gate000\.exr, c_", results.open, tmp_path)


def test_large_stacks_are_written_without_copies_and_read_exactly(tmp_path, monkeypatch):
    """Coordinates of many pixels are channels, which other readers see; NetCDF files go to the disk directly."""
    stack = make()
    monkeypatch.setattr(exr, "_MOST_LISTED", 7)
    monkeypatch.setattr(files, "_LARGE", 0)
    for suffix in (".exr", ".nc"):
        results.save(stack, tmp_path / f"stack{suffix}")
        xr.testing.assert_identical(results.open(tmp_path / f"stack{suffix}"), stack)
    assert files.check_sum(tmp_path / "stack.nc")
    header, channels, _, _ = parts_by_other_reader(tmp_path / "stack.exr")[-1]
    assert header["oiio:subimagename"] == "coordinates"
    assert sorted(channels) == ["angle_x.high", "angle_x.low", "angle_y.high", "angle_y.low"]
