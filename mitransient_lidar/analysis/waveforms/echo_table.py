"""Tables of surface, column, target and bottom echoes for every pixel and shot."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, replace
from typing import Annotated, Any, Literal

import numpy as np
import numpy.typing as npt
import xarray as xr

from mitransient_lidar.analysis.waveforms import deconvolution
from mitransient_lidar.analysis.waveforms.column_fits import change_points, column_between, column_echoes, column_fit
from mitransient_lidar.analysis.waveforms.depth_errors import TYPICAL_SLOPE_VARIANCE, DepthErrors
from mitransient_lidar.analysis.waveforms.echo_classes import IN_AIR, Detection, EchoClass, decide
from mitransient_lidar.analysis.waveforms.echo_detection import EchoFlag, has_echo
from mitransient_lidar.analysis.waveforms.estimates import estimate
from mitransient_lidar.analysis.waveforms.first_echoes import SEPARATE
from mitransient_lidar.analysis.waveforms.records import Waveforms
from mitransient_lidar.analysis.waveforms.saturation import longest_run, may_be_second_return, saturated_spans, widen
from mitransient_lidar.analysis.waveforms.surface_times import (
    GRAZING,
    LEAST_SHARE,
    SurfaceLevel,
    infrared_level,
    surface_times,
)
from mitransient_lidar.core.errors import UserError
from mitransient_lidar.core.options import Option, checked, positive_option
from mitransient_lidar.core.validation import IntArray, integer
from mitransient_lidar.physics.lidar.pulse import Pulse
from mitransient_lidar.physics.receiver.shot_jitter import timing_jitter
from mitransient_lidar.results.attributes import flagged, label, made_from, split
from mitransient_lidar.results.files import Given, dataset_of
from mitransient_lidar.results.geometry import optional_number
from mitransient_lidar.results.waveform_files import check_measurable

ESTIMATORS = ("threshold", "leading_edge", "peak", "centroid", "gaussian", "deconvolution")
ECHOES = ("surface", "column", "target", "bottom")
_SIGNIFICANT = 3.0  # standard errors of the amplitude of an echo that is distinct from the column and other echoes
_QUANTITIES = ("time_ns", "depth_m", "amplitude", "energy", "width_ns")
_OF_ECHOES = (*_QUANTITIES, *(f"{name}_stderr" for name in _QUANTITIES), "flags", "class")
_PER_WAVEFORM = (
    "class_probability",
    *("attenuation", "attenuation_stderr", "attenuation_chi2", "column_start_ns", "column_end_ns"),
    *("layer_depth_m", "layer_p_value", "layer_step", "layer_attenuation_above", "layer_attenuation_below"),
)


@checked
def extract(
    dataset: Given,
    estimators: Annotated[
        str | Sequence[str],
        Option(
            "threshold, leading_edge, peak, centroid, gaussian (the default) or deconvolution; repeat it for several",
            form="NAME",
            flag="--estimator",
        ),
    ] = "gaussian",
    *,
    pulse: Pulse | None = None,
    noise: float | npt.ArrayLike | None = None,
    threshold: Annotated[float, positive_option("Standard deviations of the noise above which a signal counts")] = 5.0,
    contrast: Annotated[
        float, Option("Share of the signal that an echo in the water must add (at least 0, below 1)")
    ] = 0.05,
    echo_fwhm_ns: float | None = None,
    saturation_level: float | None = None,
    layers: Annotated[int, Option("Number of changes in the column to test for", 0, 8)] = 0,
    depth_from: Literal["echo", "mean"] = "echo",
    level: SurfaceLevel | None = None,
    iterations: int = 50,
    block: int = 2048,
    targets: int | None = None,
) -> xr.Dataset:
    """Measure the echoes in waveforms.

    Parameters
    ----------
    dataset : xarray.Dataset
        A result with ``waveform`` [W], or a receiver's record with ``signal``, which takes precedence; over (pixel,
        time) or (row, column, time), optionally after ``shot``. A signal after a logarithm (attributes
        ``receiver.logarithm.volts_per_decade`` and ``.knee_v`` of `receiver.detect_waveforms`) is expanded to the
        voltage before it. All quantities have its unit.
    estimators : str or sequence of str
        Estimators of time: ``threshold`` (the leading edge crosses `threshold` noise standard deviations, at least a
        fiftieth of the echo), ``leading_edge`` (it crosses half the amplitude), ``peak`` (Gaussian through the summit),
        ``centroid``, ``gaussian`` (decomposition into Gaussians and column), or ``deconvolution`` (Richardson-Lucy).
        Only ``gaussian`` separates the surface from the column.
    pulse : Pulse, optional
        The transmitted pulse. By default, the attributes ``pulse_times_ns`` and ``pulse_power``, or a Gaussian with
        ``pulse_fwhm_ns``.
    noise : float or array-like, optional
        Sample standard deviation: a number, or one per pixel, or per pixel and bin. By default, ``waveform_stderr``
        with the ``error_correlation``, or ``signal_deviation``, or the spread before the surface echo. For a signal it
        is at least this spread, times an inflation: standard deviation of means over a pulse to the one for independent
        bins, from at least 20 shots, or else before the surface echo. It includes ``signal_mean_stderr``, so that
        render errors are no echoes.
    echo_fwhm_ns : float, optional
        Expected full width of an echo [ns]. By default, from pulse, response and the beam's spread over the surface.
    saturation_level : float, optional
        Smallest saturated sample, as recorded, in addition to the variable ``saturated``.
    depth_from : {'echo', 'mean'}
        Depths from each waveform's surface echo, or from the mean sea level along the pixel's line of sight.
    level : SurfaceLevel, optional
        Surface arrival in each waveform as known without it, NaN where unknown. It serves land and very shallow water,
        and depths as far as it is better known than by the waveform. By default the infrared channel's level
        (`surface_times.infrared_level`), or else the mean sea level, with an error of 0.15 m and the waves. Where a
        first echo is uncertain, the median surface of eight or more waveforms with certain surfaces above a column
        replaces it (`surface_times.SurfaceLevel.of_neighbours`).
    iterations : int
        Deconvolution iterations, 1 to 10 000.
    block : int
        Waveforms in memory at a time, at least 1.
    targets : int, optional
        Targets in the table, 1 to 100; by default as many as the waveform with most, at least 1.

    Returns
    -------
    xarray.Dataset
        Over the dimensions of the waveforms without time, then ``estimator`` if `estimators` is a sequence, and
        ``echo`` (surface, column, target, target_2, ..., bottom; the strongest target first): ``time_ns``, ``depth_m``,
        ``amplitude``, ``energy`` and ``width_ns`` with ``_stderr``, ``depth_m_method_error``, ``class``, an
        `echo_classes.EchoClass`, and ``flags``, sums of `echo_detection.EchoFlag`. Land is the echo ``bottom``, objects
        above the water are targets, both timed in air, with negative depths. Without ``echo``: ``surface_time_ns``, the
        arrival of the surface in the pixel, with ``_stderr`` and ``_method_error``, which ``depth_m_method_error``
        includes. Over the dimensions of the waveforms alone: ``class_probability``, ``attenuation`` [1/m] along the
        path, its ``_stderr``, ``attenuation_chi2``, ``column_start_ns`` and
        ``_end_ns``; with `layers`, over ``layer``: ``layer_depth_m``, ``layer_p_value``, ``layer_step``,
        ``layer_attenuation_above`` and ``_below``.

    Raises
    ------
    UserError
        If the dataset has other dimensions, lacks a coordinate or an attribute, has non-finite values, or an argument
        is out of range.

    Notes
    -----
    Depth is (t - t_surface) c0 cos(theta_water) / (2 n_g), with the pixel's line-of-sight angle; see
    `geometry.LinesOfSight`. Column time, depth and energy come from the samples between the surface echo and the next
    one. The amplitude is extrapolated to the surface; the width is the decay time to one half.

    An ideal echo is shaped like the pulse after bins and responses; for signals after ``receiver_response``, too.
    ``gaussian`` fits Gaussian sums with this shape. The column after the surface has the mean wave focusing that the
    result states (``wave_focusing``). Later than the lowest point of the sea there is no surface echo.

    Surface echoes are held against beam and geometry; see `surface_times.surface_times`. A pixel without direct light
    has the flag ``no_surface_light``, ``surface_time_ns`` from the other pixels of its shot, and echoes with the flag
    ``scattered_light``. Echoes no higher than single events of the detector are ``few_events``. ``gaussian`` flags
    targets and bottoms below 3 standard errors as ``poor_fit``, and surfaces as ``column_onset``. The latter have the
    time of the column's onset, like all beyond 60 degrees from nadir. They have neither amplitude nor width.

    Saturated samples do not count for ``gaussian`` and the column: an echo may be anywhere in the clipped time. Light
    that a bottom returns twice arrives from twice its depth: where the half depth is clipped, an echo is ``saturated``,
    too, and has this half as an error. ``depth_m_stderr`` is the error by noise, by saturation, and by the jitter of
    the record's trigger and clocks, which cancels where the pixel's own surface echo counts. The method errs by more:
    For ``gaussian``, ``depth_m_method_error`` states the typical error by waves, by scattered light that arrives later,
    and by the light distribution in the pixel, which the surface echo samples at few places; see
    `depth_errors.DepthErrors`. Its constants are from 40 random level seas and 36 shots on waves; scattering,
    undercutting and ripples follow from theory. In waters IB to 7C at 6 m/s the rms error over both errors together was
    0.8 to 1.3 for ``published_airborne``, 2 to 11 m deep. The error has the sign of the biases below, which the other
    estimators have.

    Biases by method over a flat bottom, from three renders each: ``table1`` with 1x1 pixels, ``spectrum`` flat and 0.5
    ns bins. Positive is too deep [m]. In each pair, the first number is the surface bias, the second the bottom bias
    against the mean sea level (`depth_from` ``mean``); with ``echo`` they add up. Angles are in degrees; d is the
    divergence [mrad], with 20 mrad fields of view for 2 and 30 mrad for 10. Attenuation, scattering and backscattering
    [1/m] and depth [m] are 0.15, 0.08, 0.0015 and 8 (clear), 0.3, 0.15, 0.006 and 8 (coastal), and 1, 0.8, 0.016 and 4
    (turbid). Standard errors are at most 0.013, those of ``peak`` up to 0.1.

    ======= ===== == =========== =========== =========== =========== =========== ===========
    water   angle  d threshold   edge        peak        centroid    gaussian    deconvolved
    ======= ===== == =========== =========== =========== =========== =========== ===========
    clear       5  2 +0.01 +0.01 +0.01 +0.01 +0.01 +0.02 +0.01 +0.02 +0.01 +0.02 +0.01 +0.02
    clear       5 10 +0.03 -0.01 +0.01 +0.01 +0.00 +0.03 +0.00 +0.03 +0.00 +0.03 +0.00 +0.03
    clear      20  2 +0.00 -0.04 -0.02 -0.01 -0.09 +0.02 -0.14 +0.02 +0.00 +0.02 -0.08 +0.02
    clear      20 10 +0.37 -0.35 +0.20 -0.15 -0.23 +0.02 -0.25 +0.03 +0.09 +0.03 -0.12 +0.02
    clear      40  2   -   -0.33 -0.22 -0.10 -0.90 +0.02 -0.81 +0.02 -0.01 +0.02 -0.49 +0.03
    clear      40 10 +0.97 -1.54 -0.01 -0.65 -1.78 +0.02 -1.67 +0.03 -0.01 +0.04 -1.42 +0.01
    coastal     5  2 +0.01 -0.01 +0.01 +0.03 +0.01 +0.05 +0.01 +0.05 +0.01 +0.05 +0.00 +0.05
    coastal     5 10 +0.03 -0.04 +0.01 +0.03 +0.00 +0.06 +0.00 +0.07 +0.00 +0.06 +0.00 +0.06
    coastal    20  2 -0.03 -0.10 -0.08 -0.00 -0.47 +0.04 -0.38 +0.04 +0.01 +0.04 -0.21 +0.04
    coastal    20 10 +0.28   -   +0.02 -0.13 -0.64 +0.06 -0.60 +0.07 +0.19 +0.07 -0.42 +0.05
    coastal    40  2   -     -   -0.19 -0.13 -0.67 +0.03 -0.64 +0.03 -0.03 +0.02 -0.45 +0.02
    coastal    40 10 +1.02   -   +0.08 -0.69 -1.14 +0.04 -1.26 +0.02 -0.06 +0.06 -1.12 -0.03
    turbid      5  2 +0.01   -   +0.01 +0.07 +0.00 +0.09 +0.00 +0.10 +0.01 +0.10 +0.00 +0.08
    turbid      5 10 +0.03   -   +0.01 +0.06 +0.00 +0.10 -0.00 +0.11 +0.00 +0.10 -0.00 +0.09
    turbid     20  2 -0.07   -   -0.13 +0.03 -0.55 +0.08 -0.49 +0.08 +0.06 +0.08 -0.30 +0.07
    turbid     20 10 +0.21   -   -0.07 -0.09 -0.68 +0.11 -0.68 +0.11 +0.06 +0.11 -0.53 +0.08
    turbid     40  2 -0.04   -   -0.18 -0.10 -0.65 +0.05 -0.59 +0.05 -0.02 +0.04 -0.43 +0.03
    turbid     40 10   -   -0.64   -   -0.36   -   +0.27   -   +0.34 +0.03 +0.12 -1.02 -0.23
    ======= ===== == =========== =========== =========== =========== =========== ===========

    In water that only absorbs, up to 20 degrees, all methods but threshold and edge have surface biases up to 0.06, as
    near facets return most light. Bottom biases reach 0.01; edges of wide echoes are early. The water causes the rest.
    Light scattered near the surface follows the surface echo and delays its peak and centroid by 0.1 to 1.8 (surface
    penetration). Scattered light reaches the bottom 0.02 to 0.1 later. It arrives no earlier than direct light
    (undercutting) on average. At 40 degrees in turbid water, a wide beam has no bottom echo. The attenuation K is that
    of exp(-2 K s) over the path s, corrected for distance and refraction.
    """
    dataset, infrared = split(dataset_of("dataset", dataset, "waveforms", "signals"))
    check_measurable(dataset)
    several = not isinstance(estimators, str)
    names = tuple(estimators) if several else (str(estimators),)
    if not names or (unknown := [name for name in names if name not in ESTIMATORS]):
        raise UserError(f"estimator {unknown[0] if names else ''!r} must be one of {', '.join(ESTIMATORS)}")
    if depth_from not in ("echo", "mean"):
        raise UserError(f"depth_from = {depth_from!r} must be 'echo' or 'mean'")
    layers, block = integer("layers", layers, 0, 8), integer("block", block, 1, 10**9)
    waveforms = Waveforms.from_dataset(dataset, pulse, noise, echo_fwhm_ns, saturation_level)
    if infrared is not None and level is None:
        level = infrared_level(extract(infrared), infrared, dataset, waveforms.lines, waveforms.count)
    wanted = None if targets is None else integer("targets", targets, 1, 100)
    settings = _Settings(names, threshold, contrast, layers, depth_from, level, iterations, wanted)
    table = _measured(waveforms, np.arange(waveforms.count), block, settings)
    unsure = np.flatnonzero(table["class_probability"] < 1)
    better = _level_of_neighbours(waveforms, table, settings) if settings.level is None and unsure.size else None
    if better is not None:
        again = _measured(waveforms, unsure, block, replace(settings, level=better))
        count = max(one["flags"].shape[-1] for one in (table, again)) - len(ECHOES) + 1
        table, again = (_with_targets(one, count) for one in (table, again))
        for name, values in again.items():
            table[name][unsure] = values
    table = _with_depths(dataset, waveforms, table, settings)
    return _label(dataset, waveforms, table, settings, several)


echoes = extract  #: Name at the top of the package.


@dataclass(frozen=True)
class _Settings:
    estimators: tuple[str, ...]
    threshold: float
    contrast: float
    layers: int
    depth_from: str
    level: SurfaceLevel | None
    iterations: int
    targets: int | None


def echo_names(targets: int = 1) -> list[str]:
    """Return the echo names of a table with so many targets."""
    return [*ECHOES[:3], *(f"target_{number}" for number in range(2, targets + 1)), ECHOES[3]]


def _with_targets(part: dict[str, npt.NDArray[Any]], targets: int) -> dict[str, npt.NDArray[Any]]:
    """Return quantities with so many targets, of which those that are not there are unknown."""
    missing = targets + len(ECHOES) - 1 - part["flags"].shape[-1]
    filled = dict(part)
    for name in part.keys() & {*_OF_ECHOES} if missing > 0 else ():
        value = {"flags": int(EchoFlag.NO_ECHO), "class": int(EchoClass.NONE)}.get(name, np.nan)
        filled[name] = np.insert(part[name], [part[name].shape[-1] - 1] * missing, value, axis=-1)
    return filled


def _measured(waveforms: Waveforms, rows: IntArray, block: int, settings: _Settings) -> dict[str, npt.NDArray[Any]]:
    """Return some waveforms' quantities, with one block in memory at a time."""
    parts = [_measure(waveforms, rows[start : start + block], settings) for start in range(0, rows.size, block)]
    count = settings.targets or max(part["flags"].shape[-1] for part in parts) - len(ECHOES) + 1
    parts = [_with_targets(part, count) for part in parts]
    return {name: np.concatenate([part[name] for part in parts]) for name in parts[0]}


def _level_of_neighbours(
    waveforms: Waveforms, table: dict[str, npt.NDArray[Any]], settings: _Settings
) -> SurfaceLevel | None:
    """Return the surface's arrival by surfaces whose class is certain; None without them."""
    if "gaussian" not in settings.estimators:
        return None
    rows, number = slice(0, waveforms.count), settings.estimators.index("gaussian")
    lines = waveforms.lines_of(rows)
    column, error = (table[name][:, number, ECHOES.index("column")] for name in ("amplitude", "amplitude_stderr"))
    certain = (table["class"][:, 0] == EchoClass.SURFACE) & (table["class_probability"] == 1)
    certain &= (column > _SIGNIFICANT * error) & (lines.off_nadir < GRAZING)
    certain &= ~(lines.beam_share < LEAST_SHARE * waveforms.brightest)
    time, error = (table[name][:, number, 0] for name in ("time_ns", "time_ns_stderr"))
    certain &= np.isfinite(time) & np.isfinite(error)
    if not certain.any():
        return None
    return waveforms.surface_level(rows).of_neighbours(time, error, certain, 1 / (IN_AIR * np.cos(lines.off_nadir)))


def _measure(waveforms: Waveforms, rows: IntArray, settings: _Settings) -> dict[str, npt.NDArray[Any]]:
    """Return some waveforms' quantities by name, shape (waveforms, ...)."""
    records, width, level = waveforms.records(rows), waveforms.echo_fwhm_ns, waveforms.surface_level(rows)
    decision = decide(
        waveforms,
        rows,
        records,
        level if settings.level is None else settings.level.part(rows).or_else(level),
        waveforms.fading.typical_rate,
        Detection(settings.threshold, settings.contrast, settings.targets),
    )
    found = decision.found
    time, surface = records.time_ns, found.surface
    start = np.where(surface >= 0, time[surface] + waveforms.column_from_ns, np.nan)
    later = np.where(found.bins[1:] > surface, found.bins[1:], time.size).min(axis=0)
    following = np.where(later < time.size, later, -1)
    # The last bins lack the rising edges of pulses after the end of the record.
    end = np.where(following >= 0, time[following] - 1.5 * width, time[-1] - 1.2 * waveforms.template.fwhm_ns)
    reference, gain = time[surface], waveforms.gain(rows)
    saturated = waveforms.saturated_samples(rows, records)
    spans = records.bin_ns * saturated_spans(saturated, found.bins, waveforms.echo_fwhm_ns / records.bin_ns)
    found = replace(found, flags=found.flags | np.where(spans > 0, int(EchoFlag.SATURATED), 0))
    clear = records.without(saturated)
    column = column_fit(clear, start, end, reference, gain)
    sharp = None
    if "deconvolution" in settings.estimators:
        sharp = deconvolution.richardson_lucy(
            records.power, waveforms.kernel, offset=records.noise, iterations=settings.iterations
        )
    quantities = []
    for estimator in settings.estimators:
        usable = clear if estimator == "gaussian" else records
        limits = settings.threshold, settings.iterations
        echoes = estimate(estimator, waveforms, usable, found, column, sharp, *limits)
        if estimator == "gaussian":
            early, spread = waveforms.fading.delay(echoes[0].energy, waveforms.column_signal(rows))
            echoes = decision.fitted([echoes[0].delayed(-early, spread), *echoes[1:]])
        # The detected peak replaces a surface time that the estimator cannot determine.
        surface_ns = np.where(np.isfinite(echoes[0].time_ns), echoes[0].time_ns, reference)
        quantities.append([echoes[0], column_echoes(records, column, start, end, surface_ns - reference), *echoes[1:]])
    table = {
        name: np.stack([np.stack([getattr(one, name) for one in echoes], axis=1) for echoes in quantities], axis=1)
        for name in vars(quantities[0][0])
    }
    table["time_ns_stderr"], table["width_ns_stderr"] = table.pop("time_stderr"), table.pop("width_stderr")
    widen(table["time_ns_stderr"], spans)
    table["class"] = np.insert(decision.classes(width), 1, np.where(np.isfinite(column.level), EchoClass.COLUMN, 0), 1)
    table["class_probability"] = decision.probability
    table["near_ns"], table["near_stderr"] = decision.surfaces()
    table["film_ns"] = decision.films()
    of_column, short = quantities[0][1].amplitude, [quantities[0][0], *quantities[0][2:]]
    between = column_between(clear, short, width, reference, waveforms.fading.typical_rate)
    table["column_level"] = np.where(np.isfinite(of_column), of_column, between)
    table["peak_ns"] = np.where(surface >= 0, reference, np.nan)
    table["clipped_ns"] = time[np.stack(longest_run(saturated), axis=1)]
    per_metre = 0.5 / waveforms.geometry.metres_per_ns
    table |= {"attenuation": column.decay * per_metre, "attenuation_stderr": column.decay_stderr * per_metre}
    table |= {"attenuation_chi2": column.chi2, "column_start_ns": start, "column_end_ns": end}
    if settings.layers:
        changes = change_points(clear, start, end, gain, layers=settings.layers, blur_ns=width)
        table |= {
            "layer_time_ns": changes.time_ns,
            "layer_p_value": changes.p_value,
            "layer_step": changes.step,
            "layer_attenuation_above": changes.decay_before * per_metre,
            "layer_attenuation_below": changes.decay_after * per_metre,
        }
    return table


def _with_depths(
    dataset: xr.Dataset, waveforms: Waveforms, table: dict[str, npt.NDArray[Any]], settings: _Settings
) -> dict[str, npt.NDArray[Any]]:
    """Return the table of all waveforms with their surface and depths, shape (waveforms, estimator, echo)."""
    lines = waveforms.lines_of(slice(0, waveforms.count))
    shots = waveforms.count // waveforms.baseline.size
    variance = optional_number(dataset.attrs, "surface_slope_variance")
    lowest, highest = dataset.attrs.get("surface_heights_m", (-np.inf, np.inf))
    time, error, peak = table["time_ns"], table["time_ns_stderr"], table.pop("peak_ns")
    errors = DepthErrors.of(dataset.attrs, lines, shots, waveforms.geometry, waveforms.template.fwhm_ns)
    trigger, clock = timing_jitter(dataset.attrs)
    zero, zero_error, by_light = (np.empty(time.shape[:2]) for _ in range(3))
    dark = lines.beam_share < LEAST_SHARE * waveforms.brightest
    table["flags"][..., 2:] |= np.where(dark, int(EchoFlag.SCATTERED_LIGHT), 0)[:, np.newaxis, np.newaxis]
    for number, estimator in enumerate(settings.estimators):
        measured = time[:, number, 0]
        faint = np.isnan(measured)
        if estimator == "gaussian":
            weak = table["amplitude"][:, number] < _SIGNIFICANT * table["amplitude_stderr"][:, number]
            # The height of a clipped echo is not known.
            weak &= (table["flags"][:, number] & int(EchoFlag.SATURATED)) == 0
            faint |= weak[:, 0]
            table["flags"][:, number, 2:] |= np.where(weak[:, 2:], int(EchoFlag.POOR_FIT), 0)
        found = surface_times(
            measured.reshape(shots, -1),
            error[:, number, 0].reshape(shots, -1),
            errors.of_surface(faint).reshape(shots, -1),
            lines.reshaped((shots, -1)),
            slope_variance=TYPICAL_SLOPE_VARIANCE if variance is None else variance,
            heights_m=(lowest, highest),
            echo_fwhm_ns=waveforms.echo_fwhm_ns,
            trigger_ns=trigger,
            clock_ns=clock,
        )
        own = found.own.ravel()
        flags = table["flags"][:, number, 0]
        flags |= np.where((own | np.isnan(measured)) & ~dark, 0, int(EchoFlag.NO_SURFACE_LIGHT))
        absent = np.isnan(measured) | ~own
        faint |= absent
        flags |= np.where(absent, int(EchoFlag.NO_ECHO), np.where(faint, int(EchoFlag.COLUMN_ONSET), 0))
        for name in ("amplitude", "energy", "width_ns"):
            for column in (name, f"{name}_stderr"):
                table[column][faint, number, 0] = np.nan
        time[absent, number, 0] = error[absent, number, 0] = np.nan
        by_light[:, number] = found.method_ns.ravel()
        zero[:, number], zero_error[:, number] = found.time_ns.ravel(), found.stderr_ns.ravel()
    # Where surface and bottom are not apart, what their joint fit has of the surface.
    near, near_error = (table.pop(name)[:, np.newaxis] for name in ("near_ns", "near_stderr"))
    near_error = np.hypot(near_error, errors.of_surface(np.isfinite(near[:, 0]))[:, np.newaxis])
    zero, zero_error = (np.where(np.isfinite(near), *pair) for pair in ((near, zero), (near_error, zero_error)))
    if settings.level is not None:
        zero, zero_error, by_light = settings.level.combined(zero, zero_error, by_light)
    half = 0.5 * (time - lines.surface_time[:, np.newaxis, np.newaxis])
    second = may_be_second_return(time, half, table.pop("clipped_ns"), waveforms.echo_fwhm_ns)
    table["flags"] |= np.where(second, int(EchoFlag.SATURATED), 0)
    error[second] = np.hypot(error, half)[second]
    table |= {"surface_time_ns": zero, "surface_time_ns_stderr": zero_error, "surface_time_ns_method_error": by_light}
    if settings.depth_from == "echo":
        delay, spread = time - zero[..., np.newaxis], np.hypot(error, zero_error[..., np.newaxis])
        spread[..., 0] = np.where(np.isfinite(time[..., 0]), 0.0, np.nan)
        first = zero[:, 0]
        layer_zero = np.where(np.isfinite(first), first, peak)
    else:
        delay, spread = 2 * half, np.hypot(error, np.hypot(trigger, clock))
        layer_zero = lines.surface_time
    classes = np.where(has_echo(table["flags"]), table["class"][:, np.newaxis], int(EchoClass.NONE))
    table["class"] = classes
    in_air = (classes == EchoClass.LAND) | (classes == EchoClass.ABOVE)
    per_ns = (IN_AIR * np.cos(lines.off_nadir))[:, np.newaxis, np.newaxis]
    for name, one in (("depth_m", delay), ("depth_m_stderr", spread)):
        table[name] = np.where(in_air, per_ns * one, lines.depth_of_delay(one))
    from_mean = settings.depth_from == "mean"
    sensitivity = np.resize(waveforms.sensitivity, waveforms.count)
    power = table.pop("column_level")
    level = np.divide(power, sensitivity, out=np.full(power.shape, np.nan), where=sensitivity > 0)
    known = table["depth_m"], table["attenuation"], level
    by_water = errors.of_echoes(time, *known, width_ns=table["width_ns"], from_mean=from_mean)
    by_water = np.hypot(by_water, errors.of_scattered_light(table["depth_m"], dark))
    # The surface is where depths count from, or an echo of its own.
    by_water[..., 0] = 0
    film = table.pop("film_ns")[:, np.newaxis, np.newaxis]
    of_land = np.hypot(per_ns * errors.of_land()[:, np.newaxis, np.newaxis], per_ns * film - lines.depth_of_delay(film))
    by_water = np.where(in_air, of_land, by_water)
    of_surface = (table["flags"] & int(EchoFlag.COLUMN_ONSET) > 0) | ((np.arange(time.shape[-1]) > 0) != from_mean)
    method = np.hypot(by_water, lines.depth_of_delay(by_light)[..., np.newaxis] * of_surface)
    table["depth_m_method_error"] = np.where(np.isfinite(table["depth_m"]), method, np.nan)
    if "layer_time_ns" in table:
        table["layer_depth_m"] = lines.depth_of_delay(table.pop("layer_time_ns") - layer_zero[:, np.newaxis])
    return table


def _label(
    dataset: xr.Dataset, waveforms: Waveforms, table: dict[str, npt.NDArray[Any]], settings: _Settings, several: bool
) -> xr.Dataset:
    """Return the table with its dimensions, units and provenance."""
    dims, shape = waveforms.dims[:-1], waveforms.shape[:-1]

    def of_echoes(values: npt.NDArray[Any], **described: Any) -> tuple[Any, ...]:
        inner = ("estimator", "echo") if several else ("echo",)
        return (*dims, *inner), values.reshape(*shape, *values.shape[3 - len(inner) :]), described

    names = [*_QUANTITIES, *(f"{name}_stderr" for name in _QUANTITIES), "depth_m_method_error"]
    data: dict[str, Any] = {name: of_echoes(table[name]) for name in names}
    for suffix in ("", "_stderr", "_method_error"):
        values = table["surface_time_ns" + suffix]
        inner, sizes = ("estimator",) * several, values.shape[1 : 1 + several]
        data["surface_time_ns" + suffix] = (*dims, *inner), values.reshape(*shape, *sizes)
    data["class"] = of_echoes(table["class"].astype(np.int64), **flagged(EchoClass))
    data["flags"] = of_echoes(table["flags"].astype(np.int64), **flagged(EchoFlag))
    for name in _PER_WAVEFORM:
        if name in table:
            layer = ("layer",) if table[name].ndim > 1 else ()
            data[name] = ((*dims, *layer), table[name].reshape(*shape, *table[name].shape[1:]))
    coords: dict[str, Any] = {
        str(name): coordinate for name, coordinate in dataset.coords.items() if set(coordinate.dims) <= set(dims)
    }
    coords["echo"] = ("echo", echo_names(table["flags"].shape[-1] - 3))
    if several:
        coords["estimator"] = ("estimator", list(settings.estimators))
    provenance = {
        **made_from(dataset.attrs, "Echoes", "measured"),
        "estimators": list(settings.estimators),
        "echo_fwhm_ns": waveforms.echo_fwhm_ns,
        "echo_threshold": settings.threshold,
        "echo_contrast": settings.contrast,
        "merged_below_m": SEPARATE * waveforms.echo_fwhm_ns * waveforms.geometry.depth_per_ns,
    }
    energy = f"{waveforms.unit} s".strip() if waveforms.unit != "W" else "J"
    found = xr.Dataset(data, coords, {**dataset.attrs, **provenance})
    return label(found, "mean" if settings.depth_from == "mean" else "", amplitude=waveforms.unit, energy=energy)
