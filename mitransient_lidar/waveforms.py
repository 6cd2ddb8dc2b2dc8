"""Surface, column, target and bottom echoes of every pixel and shot, as a table.

The numbers come from `optics.echoes` and its neighbours; this module knows what a result or a recorded signal holds,
and the lidar's geometry.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, replace
from typing import Any, Literal

import numpy as np
import numpy.typing as npt
import xarray as xr

from mitransient_lidar.errors import UserError
from mitransient_lidar.optics import deconvolution, echo_fits, echo_readings
from mitransient_lidar.optics.checks import FloatArray, whole
from mitransient_lidar.optics.column_fits import ColumnFit, change_points, column_fit
from mitransient_lidar.optics.echoes import Echoes, EchoFlag, Found, IntArray, Records, find_echoes
from mitransient_lidar.optics.pulse import Pulse
from mitransient_lidar.waveform_source import Source

METHODS = ("threshold", "leading_edge", "peak", "centroid", "gaussian", "deconvolution")
ECHOES = ("surface", "column", "target", "bottom")
_USUAL_DECAY = 0.03  # 1/ns, of a column too short to be fitted
_VARIABLES = {
    "time_ns": "arrival of the echo",
    "depth_m": "depth of the echo below the surface",
    "amplitude": "height of the echo",
    "energy": "integral of the echo over time",
    "width_ns": "full width of the echo at half maximum",
}
_PER_WAVEFORM = {
    "attenuation": ("1/m", "effective attenuation of the column along the path"),
    "attenuation_stderr": ("1/m", "standard error of the effective attenuation"),
    "attenuation_chi2": ("1", "squared residuals of the column's fit over its degrees of freedom"),
    "layer_depth_m": ("m", "depth of a change in the column"),
    "layer_p_value": ("1", "chance that noise makes as strong a change"),
    "layer_step": ("1", "logarithm of the signal below the change over that above it"),
    "layer_attenuation_above": ("1/m", "attenuation above the change along the path"),
    "layer_attenuation_below": ("1/m", "attenuation below the change along the path"),
}


def extract(
    dataset: xr.Dataset,
    methods: str | Sequence[str] = "gaussian",
    *,
    pulse: Pulse | None = None,
    noise: float | npt.ArrayLike | None = None,
    threshold: float = 5.0,
    contrast: float = 0.05,
    echo_fwhm_ns: float | None = None,
    saturation_level: float | None = None,
    layers: int = 0,
    depth_from: Literal["echo", "mean"] = "echo",
    iterations: int = 50,
    block: int = 2048,
) -> xr.Dataset:
    """Measure the echoes in waveforms.

    Parameters
    ----------
    dataset : xarray.Dataset
        A result with ``waveform`` [W], or what a receiver recorded, ``signal``, which is then used; over (pixel, time)
        or (row, column, time), also with ``shot`` before these. A signal behind a logarithm (the attributes
        ``receiver.logarithm.volts_per_decade`` and ``.knee_v`` of `receiver_chain.detect_waveforms`) is first expanded
        to the voltage before it, of which all numbers are.
    methods : str or sequence of str
        How times are read: ``threshold`` (where the leading edge passes `threshold` standard deviations of the noise,
        or a fiftieth of the echo if that is more), ``leading_edge`` (where it passes half the amplitude), ``peak``
        (Gaussian through the summit), ``centroid``, ``gaussian`` (decomposition into Gaussians on the column: the one
        method that tells the surface from the column behind it), or ``deconvolution`` (Richardson-Lucy).
    pulse : Pulse, optional
        The transmitted pulse. Without it, a Gaussian of the attribute ``pulse_fwhm_ns``.
    noise : float or array-like, optional
        Standard deviation of the samples; a number, or one for each pixel, or each pixel and bin. Without it,
        ``waveform_stderr`` with the attribute ``error_growth``, or ``signal_deviation``, or else the spread before the
        surface echo; of a signal at least that spread, and raised by how much means of a pulse spread more than
        independent bins do: in 20 or more shots of one result, or else before the surface echo.
    threshold, contrast
        As for `optics.echoes.find_echoes`.
    echo_fwhm_ns : float, optional
        Expected full width of an echo [ns]. Without it, that of pulse, response and the beam's spread over the surface.
    saturation_level : float, optional
        Samples, as recorded, from here on are saturated, like those of the variable ``saturated``.
    layers : int
        Number of changes in the column to test for, 0 to 8; see `optics.column_fits.change_points`.
    depth_from : {'echo', 'mean'}
        Depths from the surface echo of each waveform, or from the mean surface (attribute ``surface_time_ns``).
    iterations : int
        Of the deconvolution, 1 to 10 000.
    block : int
        Waveforms worked on at a time, at least 1; memory goes with it.

    Returns
    -------
    xarray.Dataset
        Over the dimensions of the waveforms without time, then ``estimator`` where `methods` is a sequence, and
        ``echo`` (surface, column, target, bottom): ``time_ns``, ``depth_m``, ``amplitude``, ``energy`` and ``width_ns``
        with ``_stderr``, and ``flags``, sums of `optics.echoes.EchoFlag`. Over the waveforms alone: ``attenuation``
        [1/m] along the path, its ``_stderr`` and ``attenuation_chi2``; with `layers`, over ``layer``:
        ``layer_depth_m``, ``layer_p_value``, ``layer_step`` and the attenuations ``layer_attenuation_above`` and
        ``_below``.

    Raises
    ------
    UserError
        If the dataset has other dimensions, lacks a coordinate or an attribute, holds values that are not finite, or an
        argument is out of range.

    Notes
    -----
    Depth is (t - t_surface) c0 cos(theta_water) / (2 n_g), with the angle of the lidar's axis. Of the column, time,
    depth and energy are those of the samples between the surface echo and the next one, the amplitude is its level at
    the surface, extrapolated, and the width the time in which it falls to half.

    The attenuation K is that of exp(-2 K s) over the path s, the loss by distance and refraction taken out. Rendered
    waveforms are known in correlated bins: without ``error_growth`` the errors are too small.
    """
    several = not isinstance(methods, str)
    names = tuple(methods) if several else (str(methods),)
    if not names or (unknown := [name for name in names if name not in METHODS]):
        raise UserError(f"method {unknown[0] if names else ''!r} must be one of {', '.join(METHODS)}")
    if depth_from not in ("echo", "mean"):
        raise UserError(f"depth_from = {depth_from!r} must be 'echo' or 'mean'")
    try:
        layers, block = whole("layers", layers, 0, 8), whole("block", block, 1, 10**9)
        source = Source.of(dataset, pulse, noise, echo_fwhm_ns, saturation_level)
        settings = _Settings(names, threshold, contrast, layers, iterations)
        parts = []
        for start in range(0, source.count, block):
            part = slice(start, min(start + block, source.count))
            parts.append(_measure(source, part, settings, depth_from))
    except UserError:
        raise
    except ValueError as error:
        raise UserError(str(error)) from error
    table = {name: np.concatenate([part[name] for part in parts]) for name in parts[0]}
    return _label(dataset, source, table, settings, several)


@dataclass(frozen=True)
class _Settings:
    methods: tuple[str, ...]
    threshold: float
    contrast: float
    layers: int
    iterations: int


def _measure(source: Source, rows: slice, settings: _Settings, depth_from: str) -> dict[str, npt.NDArray[Any]]:
    """Return the numbers of some of the waveforms, by name, shape (waveforms, ...)."""
    records = source.records(rows)
    width = source.echo_fwhm_ns
    found = find_echoes(
        records,
        width,
        threshold=settings.threshold,
        contrast=settings.contrast,
        earliest_ns=source.quiet_until_ns,
    )
    time = records.time_ns
    start = np.where(found.surface >= 0, time[found.surface] + 1.75 * width, np.nan)
    following = np.where(found.target >= 0, found.target, found.bottom)
    # The pulses of light that comes after the record's end are missing in its last bins.
    end = np.where(following >= 0, time[following] - 1.5 * width, time[-1] - 1.2 * source.template.fwhm_ns)
    reference = time[found.surface]
    column = column_fit(records, start, end, reference, source.gain)
    flags = _saturation(source, rows, records, found)
    sharp = None
    if "deconvolution" in settings.methods:
        kernel, iterations = source.kernel, settings.iterations
        sharp = deconvolution.richardson_lucy(records.power, kernel, offset=records.noise, iterations=iterations)
    numbers = []
    for method in settings.methods:
        echoes = _read(method, source, records, found, flags, column, sharp, settings)
        # Where a method sees no surface, the peak that was found stands in for it.
        surface = np.where(np.isfinite(echoes[0].time_ns), echoes[0].time_ns, reference)
        body = _column(records, column, start, end, surface - reference)
        numbers.append(_with_depths([echoes[0], body, *echoes[1:]], source, depth_from))
    table = {name: np.stack([one[name] for one in numbers], axis=1) for name in numbers[0]}
    to_attenuation = source.attenuation_per_decay
    table["attenuation"] = column.decay * to_attenuation
    table["attenuation_stderr"] = column.decay_stderr * to_attenuation
    table["attenuation_chi2"] = column.chi2
    if settings.layers:
        changes = change_points(records, start, end, source.gain, layers=settings.layers, blur_ns=width)
        first = table["time_ns"][:, 0, 0]
        zero = np.where(np.isfinite(first), first, reference) if depth_from == "echo" else source.surface_ns
        to_depth = source.metres_per_ns
        table["layer_depth_m"] = (changes.time_ns - np.reshape(zero, (-1, 1))) * to_depth
        table["layer_p_value"], table["layer_step"] = changes.p_value, changes.step
        table["layer_attenuation_above"] = changes.decay_before * to_attenuation
        table["layer_attenuation_below"] = changes.decay_after * to_attenuation
    return table


def _column(records: Records, column: ColumnFit, start: FloatArray, end: FloatArray, delay: FloatArray) -> Echoes:
    """Return the numbers of the columns between two times, their level a delay [ns] behind the fits' reference."""
    known = np.isfinite(column.level)
    inside = (records.time_ns >= start[:, np.newaxis]) & (records.time_ns <= end[:, np.newaxis])
    power = np.where(inside, records.power, 0)
    noise = np.where(inside, records.noise, 0)
    total = np.sum(power, axis=1)
    safe = np.where(known & (total > 0), total, 1.0)
    seconds = records.bin_ns * 1e-9
    time = np.sum(power * records.time_ns, axis=1) / safe
    time_error = np.sqrt(np.sum((noise * (records.time_ns - time[:, np.newaxis])) ** 2, axis=1)) / safe
    level = column.level * np.exp(-column.decay * delay)
    relative = column.level_stderr / column.level
    mixed = 2 * column.correlation * relative * delay * column.decay_stderr
    level_error = level * np.sqrt(np.maximum(relative**2 + (delay * column.decay_stderr) ** 2 - mixed, 0))
    # Half of a column that does not fall is never reached.
    falls = column.decay > 0
    half = np.log(2) / np.where(falls, column.decay, np.nan)
    return echo_readings.known_only(
        Echoes(
            time,
            level,
            total * seconds,
            half,
            time_error,
            level_error,
            np.sqrt(np.sum(noise**2, axis=1)) * seconds,
            half * column.decay_stderr / np.where(falls, column.decay, np.nan),
            np.where(known, 0, int(EchoFlag.NO_ECHO)),
        ),
        known,
    )


def _with_depths(echoes: list[Echoes], source: Source, depth_from: str) -> dict[str, npt.NDArray[Any]]:
    """Return the numbers of all echoes of one method with their depths, shape (waveforms, echo)."""
    table = {name: np.stack([getattr(one, name) for one in echoes], axis=1) for name in vars(echoes[0])}
    time, error = table["time_ns"], table["time_stderr"]
    table["time_ns_stderr"], table["width_ns_stderr"] = table.pop("time_stderr"), table.pop("width_stderr")
    if depth_from == "echo":
        depth, spread = time - time[:, :1], np.hypot(error, error[:, :1])
        spread[:, 0] = np.where(np.isfinite(time[:, 0]), 0.0, np.nan)
    else:
        depth, spread = time - source.surface_ns, error
    return table | {"depth_m": depth * source.metres_per_ns, "depth_m_stderr": spread * source.metres_per_ns}


def _label(
    dataset: xr.Dataset, source: Source, table: dict[str, npt.NDArray[Any]], settings: _Settings, several: bool
) -> xr.Dataset:
    """Return the table with its dimensions, units and provenance."""
    dims, shape = source.dims[:-1], source.shape[:-1]
    inner = ("estimator", "echo") if several else ("echo",)
    per_second = f"{source.unit} s".strip() if source.unit != "W" else "J"
    units = {"time_ns": "ns", "depth_m": "m", "width_ns": "ns", "amplitude": source.unit, "energy": per_second}
    data: dict[str, Any] = {}
    for name, description in _VARIABLES.items():
        for suffix, of in (("", ""), ("_stderr", "standard error of the ")):
            values = table[name + suffix]
            values = values.reshape(*shape, *values.shape[1:] if several else values.shape[2:])
            described = {"units": units[name], "long_name": of + description}
            data[name + suffix] = ((*dims, *inner), values, described)
    flags = table["flags"]
    meanings = {
        "long_name": "what is wrong with the echo",
        "flag_masks": [int(flag) for flag in EchoFlag],
        "flag_meanings": " ".join(str(flag.name).lower() for flag in EchoFlag),
    }
    flags = flags.reshape(*shape, *flags.shape[1:] if several else flags.shape[2:])
    data["flags"] = ((*dims, *inner), flags.astype(np.int64), meanings)
    for name, (unit, description) in _PER_WAVEFORM.items():
        if name in table:
            values = table[name]
            layer = ("layer",) if values.ndim > 1 else ()
            values = values.reshape(*shape, *values.shape[1:])
            data[name] = ((*dims, *layer), values, {"units": unit, "long_name": description})
    coords: dict[str, Any] = {
        str(name): coordinate for name, coordinate in dataset.coords.items() if set(coordinate.dims) <= set(dims)
    }
    coords["echo"] = list(ECHOES)
    if several:
        coords["estimator"] = list(settings.methods)
    provenance = {
        "echo_methods": list(settings.methods),
        "echo_fwhm_ns": source.echo_fwhm_ns,
        "echo_threshold": settings.threshold,
        "echo_contrast": settings.contrast,
    }
    return xr.Dataset(data, coords, {**dataset.attrs, **provenance})


def _saturation(source: Source, rows: slice, records: Records, found: Found) -> list[IntArray]:
    """Return the flags of surface, target and bottom, with saturation near their peaks."""
    full = records.power + source.baseline[np.arange(rows.start, rows.stop) % source.baseline.size, np.newaxis]
    high = full >= source.saturation_level
    if source.saturated is not None:
        high |= source.saturated[rows]
    flags = []
    sums = np.cumsum(np.pad(high, ((0, 0), (1, 0))), axis=1)
    half = int(np.ceil(source.echo_fwhm_ns / records.bin_ns))
    lines = np.arange(len(high))
    for place, flag in (
        (found.surface, found.surface_flags),
        (found.target, found.target_flags),
        (found.bottom, found.bottom_flags),
    ):
        low, top = np.clip(place - half, 0, high.shape[1]), np.clip(place + half + 1, 0, high.shape[1])
        hit = (place >= 0) & (sums[lines, top] > sums[lines, low])
        flags.append(flag | np.where(hit, int(EchoFlag.SATURATED), 0))
    return flags


def _read(
    method: str,
    source: Source,
    records: Records,
    found: Found,
    flags: list[IntArray],
    column: ColumnFit,
    sharp: FloatArray | None,
    settings: _Settings,
) -> list[Echoes]:
    """Return surface, target and bottom as one method reads them."""
    width, template = source.echo_fwhm_ns, source.template
    decay = np.where(np.isfinite(column.decay), np.maximum(column.decay, 0), _USUAL_DECAY)
    places = (found.surface, found.target, found.bottom)
    if method == "gaussian":
        surface = echo_fits.gaussian_surface(records, found.surface, width, decay, flags[0])
        later = [
            echo_fits.gaussian_echo(records, place, width, decay, flag, after=found.surface)
            for place, flag in zip(places[1:], flags[1:], strict=True)
        ]
        offset = echo_readings.calibrate(lambda _, top: (top.time_ns, top.time_stderr), template, records.bin_ns, width)
        return [replace(one, time_ns=one.time_ns - offset) for one in (surface, *later)]
    if sharp is not None and method == "deconvolution":
        offset = deconvolution.deconvolution_offset(template, source.kernel, records.bin_ns, width, settings.iterations)
        found_echoes = (
            deconvolution.deconvolved_echo(records, sharp, place, template, flag, width)
            for place, flag in zip(places, flags, strict=True)
        )
        return [replace(one, time_ns=one.time_ns - offset) for one in found_echoes]

    def time_of(window: echo_readings.Window, top: Echoes) -> tuple[FloatArray, FloatArray]:
        if method == "centroid":
            return echo_readings.centroid(window, top.time_ns, width)
        if method == "leading_edge":
            return echo_readings.leading_edge(window, top, template)
        if method == "threshold":
            noise = window.noise[:, 0]
            level = np.maximum(settings.threshold * noise, 0.02 * np.nan_to_num(top.amplitude))
            return echo_readings.crossing(window, top, level, np.zeros_like(level), template)
        return top.time_ns, top.time_stderr

    offset = (
        echo_readings.calibrate(time_of, template, records.bin_ns, width) if method in ("peak", "centroid") else 0.0
    )
    echoes = []
    for number, (place, flag) in enumerate(zip(places, flags, strict=True)):
        after = found.surface if number else None
        window = echo_readings.Window.around(records, place, width, after=after, decay=decay)
        top = echo_readings.summit(window, flag)
        time, error = time_of(window, top)
        energy, energy_error = echo_readings.gate_energy(window, top.time_ns, width)
        numbers: dict[str, Any] = {
            "time_ns": time - offset,
            "time_stderr": error,
            "energy": energy,
            "energy_stderr": energy_error,
        }
        echoes.append(echo_readings.known_only(replace(top, **numbers), np.isfinite(top.time_ns)))
    return echoes
