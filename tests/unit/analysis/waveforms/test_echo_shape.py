"""Shapes of ideal echoes: sums of Gaussians, and the onset of the column that waves focus."""

import numpy as np
import pytest
from rows import each_case, each_row, must_refuse
from scipy.signal import fftconvolve

from mitransient_lidar import results
from mitransient_lidar.analysis.waveforms import echo_table
from mitransient_lidar.analysis.waveforms.column_onset import ColumnOnset, Focusing
from mitransient_lidar.analysis.waveforms.echo_shape import EchoShape, Response, Template
from mitransient_lidar.physics.lidar.pulse import Pulse
from mitransient_lidar.physics.lidar.time_axis import TimeAxis
from mitransient_lidar.physics.receiver.receiver_files import RECEIVERS


@each_case((1.5, 0.5, 0.8), (0.7, 1.0, 0.0), (5.0, 1.0, 3.0), (4.0, 0.5, 2.0))
def test_other_shapes_are_sums_of_gaussians_within_a_hundredth(fwhm, bin_ns, tau):
    template = Template.of(Pulse.gaussian(fwhm), bin_ns, tau)
    shape = EchoShape.of(template)
    z = (template.time_ns[:, np.newaxis] - shape.delays) / shape.sigma
    assert np.abs(np.exp(-0.5 * z**2) @ shape.heights - template.power).max() < 0.012
    assert shape.top_of(np.array([shape.sigma])) == pytest.approx([1], abs=0.01)
    # A wider echo has the width that variances which add up give.
    wide = np.hypot(shape.sigma, 2 * fwhm)
    blur = np.exp(-0.5 * (np.arange(-10 * fwhm, 10 * fwhm, bin_ns / 15) / (2 * fwhm)) ** 2)
    blurred = np.convolve(template.power, blur)
    half = np.flatnonzero(blurred > 0.5 * blurred.max())
    assert shape.width_of(np.array([wide]))[0][0] == pytest.approx((half[-1] - half[0]) * bin_ns / 15, rel=0.06)


@each_row("apd", "pmt", "photodiode", "sipm", "ideal")
def test_template_of_a_receiver_is_the_mean_record_of_an_echo(name):
    """Arrival, height and tail of the closed form of the receiver, which does not know of templates."""
    chain, bin_ns = RECEIVERS[name], 1.0
    first, weights = chain.low_pass(bin_ns).by_bin()
    assert weights.sum() == pytest.approx(1)
    pulse = Pulse.gaussian(3.0)
    template = Template.of(pulse, bin_ns, 0.0, Response(first, weights, bin_ns))
    lag, shares = pulse.kernel(bin_ns)
    power = np.zeros(200)
    power[60 + lag : 60 + lag + shares.size] = 1e-9 * shares
    dark = chain.expected(np.zeros(200), bin_ns).mean
    record = chain.expected(power, bin_ns).mean - dark
    expected = np.interp((np.arange(200) - 60) * bin_ns, template.time_ns, template.power, left=0, right=0)
    scale = record.max() / expected.max()
    # Rounding and clipping of the converter are within a step; the cells of a sipm recover.
    np.testing.assert_allclose(record / scale, expected, atol=0.01)


@pytest.mark.parametrize("sigma", [0.5, 2.0, 6.0])
def test_onset_is_the_blurred_column_and_has_its_derivatives(sigma):
    focusing = Focusing(np.array([0.0, 0.5, 1.0, 4.0]), np.array([1.0, 3.0, 2.0, 1.2]))
    onset = ColumnOnset.of(focusing, 0.1, 10.0)
    fine = np.arange(-80, 160, 0.01)
    column = np.where(fine >= 0, focusing.at(0.1 * fine), 0)
    blur = np.exp(-0.5 * (np.arange(-60, 60, 0.01) / sigma) ** 2)
    blurred = fftconvolve(column, blur / blur.sum(), "same")
    at = np.array([-1.5, 0.0, 1.0, 3.0, 5.0, 8.0, 20.0]) + 0.005
    value, first, second = onset.at(at, np.full(at.size, sigma))
    np.testing.assert_allclose(value, np.interp(at, fine, blurred), atol=0.01)
    slope = np.gradient(blurred, 0.01)
    np.testing.assert_allclose(first, np.interp(at, fine, slope), atol=0.01 / sigma)
    np.testing.assert_allclose(second, np.interp(at, fine, np.gradient(slope, 0.01)), atol=0.03 / sigma**2)


@each_row(
    ([1.0, 2.0], [1.0]), ([2.0, 1.0], [1.0, 1.0]), ([1.0, 2.0], [1.0, -1.0]), ("near", [1.0]), ([0.0, 1.0], [2.0, 1.0])
)
def test_invalid_focusing_is_refused(depths, factors):
    must_refuse("wave_focusing", Focusing.from_attributes, {"wave_focusing_depths": depths, "wave_focusing": factors})


@pytest.mark.parametrize("estimator", ["gaussian", "peak", "centroid"])
def test_echoes_of_a_pulse_with_a_tail_have_its_shape(estimator):
    """A result that holds the samples of its pulse: a rise of 1 ns and a fall of 6 ns."""
    times = np.linspace(-4, 30, 400)
    pulse = Pulse.sampled(times, np.where(times < 0, np.exp(-0.5 * times**2), np.exp(-times / 6)))
    first, weights = pulse.kernel(0.5)
    waveform = np.zeros(400)
    surface, bottom = 80, 240
    for place, energy in ((surface, 1.0), (bottom, 0.5)):
        waveform[place + first : place + first + weights.size] += 1e-6 * energy * weights
    attributes = {"altitude": 200.0, "off_nadir_deg": 0.0, "refractive_index": 1.34, "group_index": 1.34}
    attributes |= {"pulse_fwhm_ns": pulse.fwhm_ns, "layout": "1x1"}
    start = 2e9 * 200 / 299792458 - 80.5 * 0.5

    def depth(**samples):
        made = results.build(
            *(one[np.newaxis] for one in (waveform, 0 * waveform, waveform, 0 * waveform)),
            time=TimeAxis(start, 0.5, 400),
            pixel_names=["single"],
            pixel_centres_mrad=np.zeros((1, 2)),
            attributes={**attributes, **samples},
        )
        found = echo_table.extract(made, estimator).isel(pixel=0)
        return found["time_ns"].sel(echo=["surface", "bottom"]).values - start

    own = depth(pulse_times_ns=pulse.times_ns.tolist(), pulse_power=pulse.power.tolist())
    # The others take the tail for the signal around the echo.
    np.testing.assert_allclose(own, [40.25, 120.25], atol=0.15 if estimator == "gaussian" else 0.6)
    assert own[0] == pytest.approx(40.25, abs=0.02)
    assert np.abs(depth() - [40.25, 120.25]).max() > 0.6
