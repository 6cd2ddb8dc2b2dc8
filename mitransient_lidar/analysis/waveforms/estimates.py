"""Surface, targets and bottom of records by one time and energy estimator."""

from __future__ import annotations

from dataclasses import replace

import numpy as np

from mitransient_lidar.analysis.waveforms import deconvolution, echo_estimators, echo_fits
from mitransient_lidar.analysis.waveforms.column_fits import ColumnFit
from mitransient_lidar.analysis.waveforms.echo_detection import DetectedEchoes, Echoes, Records
from mitransient_lidar.analysis.waveforms.first_echoes import OF_DECAY
from mitransient_lidar.analysis.waveforms.records import Waveforms
from mitransient_lidar.core.validation import FloatArray

_LEVEL = 0.2  # typical deviation of the column at the surface from the one below, relative
_IN_ECHO = 0.01  # error of shape and level of a column in its surface's echo, over the peak
_UNFITTED = 0.25  # error of the time of an echo that cannot be fitted, in echo widths
_FAINT = 0.02  # smallest level of the threshold estimator, relative to the amplitude


def estimate(
    estimator: str,
    waveforms: Waveforms,
    records: Records,
    found: DetectedEchoes,
    column: ColumnFit,
    sharp: FloatArray | None,
    threshold: float,
    iterations: int,
) -> list[Echoes]:
    """Return surface, target and bottom of one estimator.

    Parameters
    ----------
    estimator
        One of `echo_table.ESTIMATORS`.
    waveforms, records
        All waveforms, and those that are measured, n.
    found, column
        Their echoes as found, and the fit of their columns.
    sharp
        Their deconvolved samples, shape (n, time); None unless an estimator needs them.
    threshold, iterations
        Threshold estimator's level in noise standard deviations, and deconvolution iterations.
    """
    width, template = waveforms.echo_fwhm_ns, waveforms.template
    decay = np.where(np.isfinite(column.decay), np.maximum(column.decay, 0), waveforms.fading.typical_rate)
    places = list(zip(found.bins, found.flags, strict=True))
    if sharp is not None and estimator == "deconvolution":
        bias = deconvolution.deconvolution_offset(template, waveforms.kernel, records.bin_ns, width, iterations)
        return [
            deconvolution.deconvolved_echo(records, sharp, place, template, flag, width).delayed(-bias)
            for place, flag in places
        ]

    def time_of(window: echo_estimators.Window, top: Echoes) -> tuple[FloatArray, FloatArray]:
        if estimator == "centroid":
            return echo_estimators.centroid(window, top.time_ns, width)
        if estimator == "leading_edge":
            return echo_estimators.leading_edge(window, top, template)
        if estimator == "threshold":
            level = np.maximum(threshold * window.noise[:, 0], _FAINT * np.nan_to_num(top.amplitude))
            return echo_estimators.crossing(window, top, level, np.zeros_like(level), template)
        return top.time_ns, top.time_stderr

    if estimator == "gaussian":
        shape = waveforms.echo_shape
        level = column.level, np.hypot(column.level_stderr, _LEVEL * column.level)
        if waveforms.fading.opaque:
            error = _IN_ECHO * records.power.max(axis=1)
            level, records = (0 * error, error), replace(records, noise=np.hypot(records.noise, error[:, np.newaxis]))
        # Where the column is too short for a fit, its decay is as uncertain as that of any water.
        with np.errstate(divide="ignore", invalid="ignore"):
            relative = np.where(column.decay > 0, column.decay_stderr / column.decay, np.inf)
        known = relative < OF_DECAY
        rate = np.where(known, column.decay, waveforms.fading.typical_rate)
        relative = np.where(known, relative, OF_DECAY)
        surface = found.surface, width, rate, found.flags[0], shape, waveforms.onset, level
        _, following = found.neighbours(0)
        reflects = waveforms.reflects
        first = echo_fits.gaussian_surface(
            records, *surface, reflects=reflects, decay_error=relative, following=following
        )
        # The surface echo's tail would count as a column before a bottom near it.
        apart = (records.time_ns - first.time_ns[:, np.newaxis] - shape.peak_ns) / first.width_ns[:, np.newaxis]
        tail = np.nan_to_num(first.amplitude[:, np.newaxis] * np.exp(-4 * np.log(2) * apart**2))
        records, fits = replace(records, power=records.power - tail), [first]
        for number, (place, flag) in enumerate(places[1:], 1):
            around = found.neighbours(number)
            fit = echo_fits.gaussian_echo(records, place, width, decay, flag, shape, after=found.surface, around=around)
            detected = np.where(place >= 0, records.time_of(place) - shape.peak_ns, np.nan)
            fits.append(fit.or_at(detected, _UNFITTED * width))
        return fits
    bias = 0.0
    if estimator in ("peak", "centroid"):
        bias = echo_estimators.calibrate(time_of, template, records.bin_ns, width)
    echoes = []
    for number, (place, flag) in enumerate(places):
        after = found.surface if number else None
        window = echo_estimators.Window.around(records, place, width, after=after, decay=decay)
        top = echo_estimators.summit(window, flag)
        time, error = time_of(window, top)
        energy, energy_error = echo_estimators.gate_energy(window, top.time_ns, width)
        measured = replace(top, time_ns=time - bias, time_stderr=error, energy=energy, energy_stderr=energy_error)
        echoes.append(measured.known_only(np.isfinite(top.time_ns)))
    return echoes
