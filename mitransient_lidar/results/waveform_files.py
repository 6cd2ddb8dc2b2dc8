"""Waveforms that lidars have recorded, from full-waveform LAS and LAZ files and from PulseWaves files.

Their datasets are like a receiver's record: ``signal`` over (shot, pixel, time), with a channel as a pixel and a
waveform's number as its shot. As in flights, ``time`` counts from the start of each waveform's first sample.
"""

from __future__ import annotations

import logging
import os
from collections.abc import Iterable, Iterator, Mapping
from pathlib import Path
from typing import Any

import numpy as np
import xarray as xr

from mitransient_lidar.core.constants import C0
from mitransient_lidar.core.errors import UserError
from mitransient_lidar.core.files import checked_path
from mitransient_lidar.core.formats.array_files import readable_suffix
from mitransient_lidar.core.formats.pulse_waves import pulse_blocks
from mitransient_lidar.core.formats.waveform_blocks import WaveformBlock, las_blocks
from mitransient_lidar.core.validation import finite, integer, require_memory
from mitransient_lidar.physics.lidar.level_sea import snell, surface_time_ns
from mitransient_lidar.results.attributes import check_attributes, label, step_of_history

_LOG = logging.getLogger(__name__)

FILE = "waveform_file"  #: Attribute with the name of the file, by which datasets of this module are known.
#: What a user may state about lidar and sea, which files do not, with usual values of the indices.
STATED = (
    *("altitude", "sea_level", "off_nadir_deg", "pulse_fwhm_ns", "response_time_ns", "divergence_mrad"),
    *("field_of_view_mrad", "refractive_index", "group_index"),
)
_USUAL = {"refractive_index": 1.34, "group_index": 1.364}
_LAS, _PULSE_WAVES = (".las", ".laz"), (".pls", ".wvs")
_IN_WATER = 0.9  # of the speed of light, below which the way of a waveform is that in water
_EARLY = 0.05  # share of the surfaces that may come before the time at which the quiet part ends
_FEWEST_DARK = 4  # samples before the surface that the level of a waveform needs
_SAME_START = 0.05  # of a sample, by which the starts of waveforms at one place may differ
_JOINED: dict[str, Any] = {"join": "outer", "combine_attrs": "override", "fill_value": {"saturated": 0}}


def is_waveform_file(path: object) -> bool:
    """Return whether a path has a suffix that this module reads: .las, .laz, .pls or .wvs."""
    return isinstance(path, (str, os.PathLike)) and Path(path).suffix.lower() in (*_LAS, *_PULSE_WAVES)


def waveform_chunks(
    path: str | os.PathLike[str],
    waveforms: tuple[int, int | None] | None = None,
    channel: int | str | None = None,
    lidar: Mapping[str, float] | None = None,
    *,
    size: int = 4096,
) -> Iterator[xr.Dataset]:
    """Return a file's waveforms, any number, in the memory for one part.

    Parameters
    ----------
    path : path
        LAS or LAZ file of point format 4, 5, 9 or 10, with its packets in it or in a ``.wdp`` file beside it; or
        PulseWaves file ``.pls`` with its ``.wvs``. Each waveform is there once, however many returns refer to it.
    waveforms : tuple of int, optional
        First one, and the one after the last or None. Their numbers are in the points' order, for PulseWaves in the
        pulses', from 0.
    channel : int or str, optional
        Channel, all by default. It is the scanner channel of point formats 9 and 10, the user data of 4 and 5, and the
        channel of PulseWaves' sampling. ``'FIELD=VALUE'`` is a value in another field of the points, such as
        ``user_data``, ``pixel`` or ``descriptor``, the wave packet descriptor's index.
    lidar : mapping of str to float, optional
        Attributes that the file does not have, from `STATED`: ``sea_level`` is the mean sea level's height in the
        file's coordinates [m], by default the height of each waveform's first return.
    size : int
        Most points or pulses in memory, at least 1.

    Returns
    -------
    iterator of xarray.Dataset
        Waveforms with one channel, length and spacing: ``signal`` [V], or counts where the file has no gain,
        ``saturated``, whether a sample is the largest count, and the coordinates of `geometry.LinesOfSight`, with
        ``surface_time`` as in ``time``. ``sample_start_ns`` is the start of the first sample after the pulse, as the
        file has it or by ``altitude`` and ``sea_level``; else NaN.

    Raises
    ------
    UserError
        If the file cannot be read, an argument is out of range, or there is no such waveform.
    """
    path, size = checked_path("path", path), integer("size", size, 1, 2**31)
    readable_suffix(path, (*_LAS, *_PULSE_WAVES), "file of waveforms")
    known = {name: finite(name, value) for name, value in (lidar or {}).items()}
    if unknown := [name for name in known if name not in STATED]:
        raise UserError(f"lidar states {unknown[0]}, which is none of {', '.join(STATED)}")
    check_attributes("lidar", known)
    first, end = waveforms or (0, None)
    first = integer("waveforms", first, 0, 2**62)
    if end is not None and integer("waveforms", end, 0, 2**62) <= first:
        raise UserError(f"waveforms = {first}:{end} must end after {first}, the first one")
    field, equals, text = str(channel).rpartition("=")
    if channel is not None and not text.removeprefix("-").isdecimal():
        raise UserError(f"channel = {channel} must be a number, or the name of a field and a number, as user_data=1")
    value = None if channel is None else int(text)
    if path.suffix.lower() in _LAS:
        blocks = las_blocks(path, first, end, field if equals else None, size)
    elif not equals:
        blocks = pulse_blocks(path.with_suffix(".pls"), first, end, size)
    else:
        raise UserError(f"channel = {channel} names a field of points: PulseWaves files have numbers of channels")
    of_channel = "" if channel is None else f" of channel {channel}"
    nothing = f"{path} has no waveform{of_channel} from number {first} to {'the last one' if end is None else end}"
    return _datasets(path, blocks, value, known, nothing)


def _datasets(
    path: Path, blocks: Iterable[WaveformBlock], channel: int | None, known: Mapping[str, float], nothing: str
) -> Iterator[xr.Dataset]:
    """Yield each channel's waveforms, or one's; raise `UserError` with a sentence if there is none."""
    found = False
    for block in blocks:
        for one in np.unique(block.channel) if channel is None else [channel]:
            if (rows := np.flatnonzero(block.channel == one)).size:
                found = True
                yield _dataset(path, block, rows, known)
    if not found:
        raise UserError(nothing)


def read_waveforms(path: str | os.PathLike[str], *selection: Any, **options: Any) -> xr.Dataset:
    """Return a file's waveforms in one dataset, with `waveform_chunks`'s arguments.

    Several channels are pixels in the shots that each channel has; the shot number is the first channel's. They are
    drawn side by side (``angle_x``, ``angle_y``), since files do not have their angles. Shorter waveforms end in NaN.

    Raises UserError as in `waveform_chunks`, and if the waveforms take too much memory, their spacing differs, or
    channels do not have the same pulses.
    """
    parts: dict[str, list[xr.Dataset]] = {}
    size, widths = 0, set[float]()
    for part in waveform_chunks(path, *selection, **options):
        parts.setdefault(str(part["pixel"].values[0]), []).append(part)
        size, widths = size + 3 * part.nbytes, widths | {part.attrs["bin_width_ns"]}
        require_memory(f"waveforms of {path}", size, "choose fewer with waveforms = FIRST:END")
    if len(widths) > 1:
        raise UserError(f"{path} has samples {min(widths):g} and {max(widths):g} ns apart: choose one channel")
    channels = [xr.concat(listed, "shot", **_JOINED).sortby("shot") for listed in parts.values()]
    key = "gps_time" if Path(path).suffix.lower() in _LAS else "shot"
    pulses = [one[key].values for one in channels]
    alike = all(np.array_equal(own, pulses[0]) for own in pulses) and np.unique(pulses[0]).size == pulses[0].size
    if len(channels) > 1 and not alike:
        raise UserError(f"{path} has the channels {', '.join(parts)} with different pulses: choose one with channel")
    shots = [one.assign_coords(shot=channels[0]["shot"]) for one in channels]
    side = -np.arange(len(shots), dtype=np.float64)
    found = xr.concat(shots, "pixel", **_JOINED).transpose("shot", "pixel", "time")
    found.attrs |= _early_surface(found["surface_time"].values)
    return found.assign_coords(angle_x=("pixel", 0 * side), angle_y=("pixel", side))


def placed_in_time(dataset: xr.Dataset) -> xr.Dataset:
    """Return a dataset with times after the pulse, if a file has these, known and alike for all waveforms."""
    start = dataset["sample_start_ns"].values if FILE in dataset.attrs else np.empty(0)
    if not start.size or not np.ptp(start) < _SAME_START * dataset.attrs["bin_width_ns"]:  # NaN where unknown
        return dataset
    first = float(np.median(start))
    return dataset.assign_coords(time=dataset["time"] + first).assign_attrs(time_start_ns=first)


def mean_above_dark(dataset: xr.Dataset) -> xr.DataArray:
    """Return the mean over this module's waveforms, minus its level in the first half before the surface, by pixel.

    Times are those after the pulse, if all waveforms have the same.
    """
    signal = placed_in_time(dataset)["signal"].mean("shot", keep_attrs=True).reset_coords(drop=True)
    surface, width = dataset["surface_time"], float(dataset.attrs["bin_width_ns"])
    if (spread := float(surface.std("shot").max())) > width:
        _LOG.warning(
            "the first returns of %d waveforms spread by %.2g ns, and so does their mean: waveforms = N:N+1 is one of "
            "them",
            dataset.sizes["shot"],
            spread,
        )
    before = max(int(np.nan_to_num(0.5 * surface.min().item() / width)), _FEWEST_DARK)
    return (signal - signal.isel(time=slice(before)).mean("time")).assign_attrs(signal.attrs)


def check_measurable(dataset: xr.Dataset) -> None:
    """Raise `UserError` if this module's dataset lacks what echoes and depths need, which a user must state."""
    if FILE not in dataset.attrs:
        return
    if np.isnan(dataset["signal"].values).any():
        raise UserError(
            f"{dataset.attrs[FILE]} has waveforms of several lengths: choose those of one with waveforms, or measure "
            "each part of waveform_chunks"
        )
    lacking = [name for name in ("pulse_fwhm_ns", "altitude") if name not in dataset.attrs]
    of_lines = (("surface_time", "sea_level"), ("off_nadir", "off_nadir_deg"))
    lacking += [stated for name, stated in of_lines if not np.isfinite(dataset[name].values).all()]
    if lacking:
        what = " and ".join(lacking)
        raise UserError(f"{dataset.attrs[FILE]} does not state {what}: give them with lidar (--lidar NAME=VALUE)")


def _dataset(path: Path, block: WaveformBlock, rows: np.ndarray[Any, Any], known: Mapping[str, float]) -> xr.Dataset:
    """Return some waveforms in a block, from one channel."""
    width, values, counts = block.spacing_ns, {**_USUAL, **known}, block.counts[rows]
    place, step, first = block.place[rows], block.step[rows], block.first_ns[rows]
    level, speed = values.get("sea_level", np.nan), np.linalg.norm(step, axis=1)
    with np.errstate(divide="ignore", invalid="ignore"):  # a file may have no direction
        bent = np.where(speed < _IN_WATER * 0.5e-9 * C0, values["refractive_index"], 1.0)
        off_nadir = np.arcsin(np.minimum(bent * np.hypot(step[:, 0], step[:, 1]) / speed, 1.0))
        surface = (level - place[:, 2]) / step[:, 2]
    off_nadir = np.where(speed > 0, off_nadir, np.radians(values.get("off_nadir_deg", np.nan)))
    surface = np.where(np.isfinite(surface), surface, block.return_ns[rows])
    typical = {"off_nadir_deg": np.degrees(off_nadir), "altitude": place[:, 2] - first * step[:, 2] - level}
    by_level = surface_time_ns(values.get("altitude", np.nan), off_nadir) - surface + 0 * level
    water = np.cos(snell(off_nadir, values["refractive_index"]))
    zero = np.zeros(rows.size)
    lines = {
        **{"sight_x": zero, "sight_y": zero, "off_nadir": np.degrees(off_nadir), "beam_share": zero * np.nan},
        **{"surface_time": surface + 0.5 * width, "surface_spread": zero},
        "depth_per_ns": 0.5e-9 * C0 / values["group_index"] * water,
        "sample_start_ns": np.where(np.isfinite(first), first, by_level) - 0.5 * width,
    }
    coords: dict[str, Any] = {
        **{"shot": block.number[rows], "pixel": [str(block.channel[rows[0]])]},
        "time": (np.arange(counts.shape[1]) + 0.5) * width,
        "gps_time": ("shot", block.gps_time[rows]),
        **{name: (("shot", "pixel"), column[:, np.newaxis]) for name, column in lines.items()},
    }
    data = {
        "signal": block.offset + block.gain * counts if block.gain else counts.astype(np.float64),
        "saturated": (counts == np.iinfo(counts.dtype).max).astype(np.int8),
    }
    attributes = {
        **{"title": f"Waveforms of {path.name}", "history": step_of_history("read"), FILE: str(path)},
        **{"time_start_ns": 0.0, "bin_width_ns": width, **_early_surface(lines["surface_time"])},
        **{name: float(np.nanmedian(one)) for name, one in typical.items() if np.isfinite(one).any()},
        **{name: value for name, value in values.items() if name != "sea_level"},
    }
    variables = {name: (("shot", "pixel", "time"), one[:, np.newaxis]) for name, one in data.items()}
    return label(xr.Dataset(variables, coords, attributes), "flight", signal="V" if block.gain else "1")


def _early_surface(times: np.ndarray[Any, Any]) -> dict[str, float]:
    """Return the attribute for a surface that few others come before, if it is known."""
    return {"surface_time_ns": float(np.nanquantile(times, _EARLY))} if np.isfinite(times).any() else {}
