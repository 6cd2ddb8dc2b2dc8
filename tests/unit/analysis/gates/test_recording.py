"""Frames of gate stacks: digital numbers against their moments, jitter of gates, photon transfer, and files."""

from dataclasses import replace

import numpy as np
import pytest
import xarray as xr
from command_line import assert_refused, run
from rows import each_case, refuses
from scipy.stats import norm
from significance import largest_z, variance_limits

from mitransient_lidar import results
from mitransient_lidar.analysis.gates.cut import cut_gates
from mitransient_lidar.analysis.gates.recording import photon_transfer
from mitransient_lidar.analysis.receiver import detect_waveforms as record
from mitransient_lidar.analysis.recorded import describe_recording
from mitransient_lidar.core.errors import UserError
from mitransient_lidar.physics.lidar.gate_train import GateShape, GateTrain
from mitransient_lidar.physics.lidar.time_axis import TimeAxis
from mitransient_lidar.physics.receiver.detectors import photons_per_joule
from mitransient_lidar.physics.receiver.receiver_files import CAMERAS
from mitransient_lidar.results.files import kinds_of

FWHM, TIME = 6.0, TimeAxis(0.0, 0.25, 800)


def waveforms(peak=2e-8, rows=6, columns=8):
    """Return a result with one echo of a Gaussian pulse in every pixel, later by 0.5 ns from row to row."""
    pixels, sigma = rows * columns, FWHM / 2.3548
    middle = 80 + 0.5 * np.repeat(np.arange(rows), columns)
    power = peak * np.exp(-0.5 * ((TIME.centres_ns - middle[:, None]) / sigma) ** 2)
    centres = np.stack(np.meshgrid(np.arange(rows), np.arange(columns), indexing="ij"), -1).reshape(-1, 2)
    return results.build(
        *(power * scale for scale in (1e-9, 1e-11, 1, 0.01)),
        time=TIME,
        pixel_names=[],
        pixel_centres_mrad=centres[:pixels],
        grid=(rows, columns),
        attributes={"scene": "echo", "pulse_fwhm_ns": FWHM},
    )


def stack(peak=2e-8, step=1.0, count=60, pulses=100, **shape):
    return cut_gates(waveforms(peak, **shape), GateTrain(60.0, 5.0, step, count, 1.0, 1.0, pulses))


@pytest.fixture(scope="module")
def flat():
    """Gates with the light of 0 to 400 events of the intensified camera, the same in all pixels."""
    gates = stack(count=60, rows=16, columns=16)
    levels = np.linspace(0, 400, 60) / (CAMERAS["iccd"].quantum_efficiency * photons_per_joule(532.0))
    return gates.assign(gate_energy=gates["gate_energy"] * 0 + levels)


def test_frames_have_their_mean_and_deviation_and_averages_the_root_of_their_number(flat):
    recorded = record(flat, replace(CAMERAS["iccd"], gate_jitter_ns=0.0), shots=64, seed=3)
    assert recorded["signal"].dims == ("frame", "row", "column", "gate")
    assert recorded["signal"].dtype == np.uint16
    signal = recorded["signal"].astype(float)
    z = (signal.mean("frame") - recorded["signal_mean"]) / recorded["signal_deviation"] * 8
    assert np.abs(z).max() < largest_z(10**6, z.size)
    averages = signal.coarsen(frame=16).mean()
    for one, number in ((signal, 1), (averages, 16)):
        ratio = number * (one - recorded["signal_mean"]) ** 2 / recorded["signal_deviation"] ** 2
        # The intensifier makes 256 pixels as certain as about 30 independent ones.
        low, high = variance_limits(one.sizes["frame"] * 60 * 30)
        assert low < float(ratio.mean()) < high
    snr = (recorded["signal_mean"] - recorded["dark_level"]) / recorded["signal_deviation"]
    assert np.allclose(recorded["snr"], snr.where(recorded["saturation"] < 0.5), rtol=1e-5, equal_nan=True)


@each_case(
    *zip([one if one in ("iccd", "spad_camera") else pytest.param(one, marks=pytest.mark.slow) for one in CAMERAS])
)
def test_photon_transfer_finds_gain_and_read_out_noise(name, flat):
    one = replace(CAMERAS[name], gate_jitter_ns=0.0, hot_pixels=0.0, frame_dark=0.0, dark_current_hz=0.0)
    scale = 1e-2 if one.kind == "counting" else 1.0
    recorded = record(flat.assign(gate_energy=scale * flat["gate_energy"]), one, shots=40, seed=1)
    found = photon_transfer(recorded)
    squares = np.sum(one.spread(np.eye(16).reshape(16, 1, 16)) ** 2) / 16  # of the weights along a line, with its ends
    noise = one.excess_noise
    if one.intensifier_mtf < 1:
        noise = (one.excess_noise - 1 / one.gain) * squares**2 + 1 / one.gain
    slope = one.gain * noise / one.electrons_per_dn
    # The counts of a photon counter saturate, and responses differ: 3 %.
    assert abs(found.electrons_per_dn * slope - 1) < 0.03 + largest_z(20) * found.electrons_per_dn_stderr * slope
    read = np.hypot(one.read_noise / one.electrons_per_dn, 0 if one.kind == "counting" else 12**-0.5)
    if read > 2:
        assert abs(found.dark_deviation - read) < 0.03 * read + largest_z(20) * found.dark_deviation_stderr
    assert found.electrons_per_dn_stderr * slope < 0.03


def test_gate_jitter_is_the_same_by_waveforms_and_by_neighbours():
    one = replace(CAMERAS["gated_cmos"], gate_jitter_ns=0.6, optics_mtf=1.0, response_spread=0.0)
    gates = stack(2e-7, step=0.5, count=80, pulses=4)
    both = gates.assign(waveforms(2e-7)[["waveform", "waveform_stderr"]])
    near, exact, none = (
        record(each, used) for each, used in ((gates, one), (both, one), (gates, replace(one, gate_jitter_ns=0.0)))
    )
    inner = {"gate": slice(1, -1)}
    largest = float(exact["signal_deviation"].max())
    assert np.abs(near["signal_deviation"] - exact["signal_deviation"]).isel(inner).max() < 0.01 * largest
    assert np.abs(near["signal_mean"] - exact["signal_mean"]).isel(inner).max() < 2e-3 * float(
        exact["signal_mean"].max()
    )
    # Closed form on the rising edge of the echo in the first row: 4 pulses halve the deviation of their mean.
    sigma, start = FWHM / 2.3548, gates["gate_start"].values
    edge = norm(80, sigma).pdf
    area = 2e-7 * 1e-9 * sigma * np.sqrt(2 * np.pi) * 4
    slope = area * (edge(start + 5) - edge(start))
    counts = slope * one.quantum_efficiency * photons_per_joule(532.0) / one.electrons_per_dn
    added = np.sqrt(np.maximum(exact["signal_deviation"] ** 2 - none["signal_deviation"] ** 2, 0))[0, 0]
    assert np.abs(added - np.abs(counts) * 0.3).max() < 0.04 * float(added.max())


def test_gates_too_far_apart_for_their_jitter_are_said(caplog):
    far = stack(step=7.0, count=5)
    assert np.array_equal(
        record(far, "iccd")["signal_mean"], record(far, replace(CAMERAS["iccd"], gate_jitter_ns=0.0))["signal_mean"]
    )
    assert "the gate jitter of 0.05 ns is left out: it needs waveforms, or gates that follow within 6 ns" in caplog.text


def test_a_measured_gate_is_open_for_the_integral_of_its_transmission():
    shape = GateShape.sampled([0, 2, 8, 10], [0, 0.8, 0.8, 0])
    train = GateTrain.measured(shape, 60.0, 4.0, 9, 1000)
    gates = cut_gates(waveforms(1e-13), train)
    one = replace(CAMERAS["gated_cmos"], gate_jitter_ns=0.0, leakage=0.0, response_spread=0.0, optics_mtf=1.0)
    sky = xr.DataArray(np.linspace(0, 2e-9, 48).reshape(6, 8), dims=("row", "column"))
    bright, dark = (record(gates, one, background_power=power)["signal_mean"] for power in (sky, 0.0))
    wanted = sky * 1000 * 6.4e-9 * 0.5 * photons_per_joule(532.0) / one.electrons_per_dn
    assert np.allclose(
        (bright - dark).transpose("row", "column", "gate"), wanted.expand_dims(gate=9, axis=-1), rtol=2e-3, atol=0.1
    )
    both = cut_gates(waveforms(1e-9), train).assign(waveforms(1e-9)[["waveform", "waveform_stderr"]])
    plain, shifted = (record(both, replace(one, gate_jitter_ns=each))["signal_deviation"] for each in (0.0, 2.0))
    assert float((shifted - plain).max()) > 1 > 1e-3 > float((shifted - plain)[0, 0, 0])


def test_a_sea_for_each_frame_gives_frames_of_their_own(flat):
    seas = xr.concat(
        [flat, 2 * flat[["gate_energy", "gate_energy_stderr"]]], "frame", coords="minimal", compat="override"
    )
    seas = seas.transpose("frame", "row", "column", "gate").assign_coords(
        pulse_time=(("frame", "gate"), np.arange(120.0).reshape(2, 60))
    )
    seas.attrs = flat.attrs
    recorded = record(seas, "icmos", shots=3)
    assert recorded.sizes["frame"] == 6
    assert recorded["signal_mean"].dims == ("frame", "row", "column", "gate")
    assert np.array_equal(recorded["pulse_time"][:, 0], [0, 0, 0, 60, 60, 60])
    light = recorded["signal_mean"] - recorded["dark_level"]
    assert np.allclose(light[3, ..., :6], 2 * light[0, ..., :6], atol=1)


def test_frames_are_files_of_integers(tmp_path, flat):
    name = "spad_camera"
    recorded = record(flat, name, shots=2, gain=None, optical_density=0.3)
    assert recorded.attrs["receiver"] == name
    assert recorded.attrs["receiver.kind"] == CAMERAS[name].kind
    results.save(recorded, tmp_path / "frames.nc")
    again = results.open(tmp_path / "frames.nc")
    xr.testing.assert_identical(again, recorded)
    assert again["signal"].dtype == np.uint16
    assert kinds_of(again) == {"frames"}
    assert again["signal"].attrs["units"] == "count"
    assert "2 frames of 60 gates" in describe_recording(recorded)[0]
    with pytest.raises(UserError, match="holds frames of a gated camera, but must have"):
        results.dataset_of("dataset", recorded, "waveforms", "signals", "gates")


def test_a_filter_dims_the_light_and_a_gain_multiplies_it(flat):
    one = replace(CAMERAS["icmos"], gate_jitter_ns=0.0)
    light = {
        key: record(flat, one, **given)
        for key, given in (("", {}), ("filter", {"optical_density": 1}), ("gain", {"gain": 0.5}))
    }
    light = {key: (each["signal_mean"] - each["dark_level"])[..., 3] for key, each in light.items()}
    assert np.allclose(light["filter"], 0.1 * light[""], atol=0.1)
    assert np.allclose(light["gain"], 0.5 * light[""], atol=0.1)


@refuses(
    (
        waveforms,
        {"chain": "iccd"},
        "chain = 'iccd' is a camera, but the dataset has no gates: cut them with gates first",
    ),
    (stack, {"chain": "pmt"}, "chain = 'pmt' is one of waveforms, but gates need a camera: iccd"),
    (stack, {}, "the dataset has gates alone, which need a camera: iccd, icmos"),
    (stack, {"chain": "iccd", "gain": "auto"}, "gain = 'auto' needs a receiver of waveforms"),
    (stack, {"chain": "spad_camera", "gain": 2}, "gain = 2 is no parameter of a camera of kind 'counting'"),
    (stack, {"chain": "iccd", "background_power": [1.0, 2.0]}, r"background_power has the shape \(2,\)"),
    (lambda: -1 * stack(), {"chain": "iccd"}, "gate_energy holds .*; it must be finite and not negative"),
)
def test_what_cannot_be_recorded_is_refused(dataset, options):
    given = dataset()
    given.attrs = given.attrs or stack().attrs
    record(given, **options)


def test_photon_transfer_needs_frames_and_light(flat):
    with pytest.raises(UserError, match="the dataset has 2 frames, but photon transfer needs at least 4"):
        photon_transfer(record(flat, "iccd", shots=2))


def test_the_command_records_gates(tmp_path, flat):
    results.save(flat, tmp_path / "gates.exr")
    done = run("record", tmp_path / "gates.exr", "--receiver", "ebcmos", "--shots", 2, "-q")
    assert done.exit_code == 0, done.output
    assert "largest mean signal-to-noise ratio of a pixel and frame: " in done.stdout
    recorded = results.open(tmp_path / "gates_recorded.nc")
    assert recorded["signal"].max() < 1024
    assert_refused(
        run("record", tmp_path / "gates.exr", "-q"), "the dataset has gates alone, which need a camera: iccd, icmos"
    )
    shown = run("info", tmp_path / "gates_recorded.nc")
    assert "receiver.electrons_per_dn" in shown.stdout
