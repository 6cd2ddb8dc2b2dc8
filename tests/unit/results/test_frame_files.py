"""Frames of a camera and gates in files of other programs, on pages and in drawings."""

import json

import command_line
import numpy as np
import OpenImageIO
import pytest
import xarray as xr
from PIL import Image

from mitransient_lidar import results, view
from mitransient_lidar.core.errors import UserError
from mitransient_lidar.results.gate_stack import as_stack

ROWS, COLUMNS, GATES, FRAMES = 6, 9, 5, 2


@pytest.fixture
def frames():
    """Frames of random numbers of 16 bits, each pixel and gate another one."""
    rng = np.random.default_rng(1)
    image, dims = (ROWS, COLUMNS, GATES), ("row", "column", "gate")
    coords = {
        "angle_x": (dims[:2], np.repeat(np.linspace(3, -3, ROWS)[:, None], COLUMNS, 1)),
        "angle_y": (dims[:2], np.repeat(np.linspace(2, -2, COLUMNS)[None], ROWS, 0)),
        "gate_start": ("gate", 1400 + 2.0 * np.arange(GATES)),
        "gate_width": ("gate", np.full(GATES, 4.0)),
        "gate_depth": ("gate", 0.2 * np.arange(GATES)),
        **{name: np.arange(size) for name, size in zip((*dims, "frame"), (*image, FRAMES), strict=True)},
    }
    names = ("signal_mean", "signal_deviation", "snr", "saturation", "signal_mean_stderr")
    moments = {name: (dims, rng.uniform(100, 6e4, image).astype(np.float32)) for name in names}
    values = {
        "signal": (("frame", *dims), rng.integers(0, 2**16, (FRAMES, *image), dtype=np.uint16)),
        "saturated": (("frame", *dims), rng.random((FRAMES, *image)) > 0.5),
        "dark_level": (dims[:2], rng.uniform(90, 110, image[:2]).astype(np.float32)),
    }
    return xr.Dataset(moments | values, coords, {"scene": "mine", "receiver": "iccd", "frames": FRAMES})


@pytest.mark.parametrize("suffix", [".nc", ".exr"])
def test_round_trip(frames, tmp_path, suffix):
    results.save(frames, tmp_path / f"frames{suffix}")
    found = results.open(tmp_path / f"frames{suffix}")
    xr.testing.assert_equal(found, frames)
    assert found["signal"].dtype == np.uint16
    assert found["saturated"].dtype == bool


def pages(path):
    """Return the pages of a TIFF file as OpenImageIO and as Pillow read them, and their descriptions."""
    file, found, about = OpenImageIO.ImageInput.open(str(path)), [], []
    with Image.open(path) as image:
        for page in range(image.n_frames):
            image.seek(page)
            assert file.seek_subimage(page, 0)
            other = file.read_image("uint16")[..., 0]
            assert (np.array(image) == other).all()
            found.append(other)
            about.append(json.loads(image.tag_v2[270]))
        assert not file.seek_subimage(image.n_frames, 0)
    return np.array(found), about


def test_images_of_frames(frames, tmp_path):
    """TIFF pages and PNG files are the digital numbers, gate after gate of each frame, row 0 on top."""
    results.save(frames, tmp_path / "a.tif")
    results.save(frames, tmp_path / "a.png")
    expected = frames["signal"].transpose("frame", "gate", "row", "column").values
    found, about = pages(tmp_path / "a.tif")
    assert (found == expected.reshape(found.shape)).all()
    assert about[GATES + 3] | {"gate_depth_m": 0.6} == {
        **{"frame": 1, "gate": 3, "gate_start_ns": 1406.0, "gate_width_ns": 4.0},
        **{"gate_depth_m": 0.6, "unit": "DN", "scale": 1.0},
    }
    image = OpenImageIO.ImageInput.open(str(tmp_path / "a_frame0001_gate003.png")).read_image("uint16")[..., 0]
    assert (image == expected[1, 3]).all()
    assert len(list(tmp_path.glob("a_frame*.png"))) == FRAMES * GATES
    wide = frames.assign(signal=frames["signal"].astype(np.uint32) + 2**16)
    with pytest.raises(UserError, match="exceeds 16 bits"):
        results.save(wide, tmp_path / "b.tif")
    assert not (tmp_path / "b.tif").exists()


def test_energies_in_images(frames, tmp_path):
    """Energies are within half a number; those that are not finite or negative are 0."""
    energy = frames["signal_mean"].astype(float) * 1e-20
    energy[0, 0, 0], energy[0, 1, 0] = np.nan, -1e-16
    stack = frames[["signal_mean"]].drop_vars("signal_mean")
    stack = stack.assign(gate_energy=energy, gate_energy_stderr=0.1 * energy)
    results.save(stack, tmp_path / "a.tif")
    found, about = pages(tmp_path / "a.tif")
    expected = np.maximum(np.nan_to_num(energy.transpose("gate", "row", "column").values), 0)
    assert np.abs(found * about[0]["scale"] - expected).max() <= 0.5001 * about[0]["scale"]
    assert found.max() == 65535
    assert about[0]["unit"] == "J"


def test_mean_of_frames(frames):
    """Drawings and depths take the mean above the dark level, and its standard error."""
    stack = as_stack(frames)
    mean = frames["signal"].values.mean(0) - frames["dark_level"].values[..., None]
    np.testing.assert_allclose(stack["gate_energy"], mean, rtol=1e-6)
    np.testing.assert_allclose(stack["gate_energy_stderr"], frames["signal_deviation"] / FRAMES**0.5, rtol=1e-6)


def test_frames_of_seas():
    """Gates with a sea for each frame become their mean, with the error of a mean of independent frames."""
    dims, coords = ("frame", "pixel", "gate"), {"angle_x": ("pixel", [0.0]), "angle_y": ("pixel", [0.0])}
    coords |= {"gate_start": ("gate", [1400.0]), "gate_width": ("gate", [4.0])}
    coords |= {"frame": [0, 1], "pulse_time": (("frame", "gate"), [[0.0], [1.0]])}
    values = {"gate_energy": (dims, [[[1e-15]], [[3e-15]]]), "gate_energy_stderr": (dims, [[[3e-16]], [[4e-16]]])}
    stack = as_stack(xr.Dataset(values, coords))
    assert stack["gate_energy"].item() == pytest.approx(2e-15)
    assert stack["gate_energy_stderr"].item() == pytest.approx(2.5e-16)


def test_commands(frames, tmp_path):
    path = tmp_path / "record.nc"
    results.save(frames, path)
    assert "signal above the dark level" in view(frames).page
    done = command_line.run("gates", path, "--tiff", "--images", "--gif", "--no-plot", "-o", tmp_path / "out")
    assert done.exit_code == 0, done.output
    names = {file.name for file in (tmp_path / "out").iterdir()}
    assert {"record_gates.exr", "record_gates.tif", "record_gates.gif", "record_frame0001_gate004.png"} <= names
    assert command_line.run("view", path, "--plot").exit_code == 0
    refused = command_line.run("gates", path, "--start-ns", 1400, "--width-ns", 2)
    assert refused.exit_code == 2
    assert "record these" in refused.output
