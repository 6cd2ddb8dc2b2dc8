"""Self-contained HTML page that shows a gate stack, without network or installation.

The page shows the image of a gate, steps and plays through the gates, maps depths, and plots the records of selected
pixels. Its parts are ``page.html``, ``page.css`` and the ``.js`` files. The arrays are embedded as base64 of raw
deflate data of little-endian float32 numbers: the first bytes of all numbers, then the second ones, ...
"""

from __future__ import annotations

import base64
import html
import json
import logging
import os
import re
import zlib
from collections.abc import Iterator, Sequence
from dataclasses import dataclass
from importlib import resources
from pathlib import Path
from typing import Any

import matplotlib
import numpy as np
import xarray as xr

from mitransient_lidar.core.errors import UserError
from mitransient_lidar.core.files import replacing
from mitransient_lidar.core.validation import FloatArray, positive
from mitransient_lidar.plots import drawing
from mitransient_lidar.plots.gates.images import known_depths
from mitransient_lidar.results.formats import picture_order
from mitransient_lidar.results.gate_files import check_stack

_LOG = logging.getLogger(__name__)

_COLOUR_MAPS = ("viridis", "magma", "turbo", "gray")
_SCRIPTS = ("data", "image", "curves", "main")  # in the order in which they are joined
_GATES = ("gate_energy", "gate_energy_stderr")
_SIGHTS = ("surface_time", "depth_per_ns")  # coordinates of `geometry.LinesOfSight`
_WAVEFORMS = ("waveform", "waveform_stderr")
_POLICY = "default-src 'none'; script-src 'unsafe-inline'; style-src 'unsafe-inline'; img-src data:"
_STRIP_ASPECT = 4.0  # at most, of pixels drawn side by side


@dataclass(frozen=True)
class _Blocks:
    """Encoded arrays of means over blocks of `factor` times `factor` pixels."""

    factor: int
    rows: int
    columns: int
    encoded: dict[str, str]

    @property
    def size(self) -> int:
        return sum(map(len, self.encoded.values()))


def write_page(
    stack: xr.Dataset, path: str | os.PathLike[str], result: xr.Dataset | None = None, limit_mb: float = 200.0
) -> None:
    """Write the HTML page that shows a gate stack.

    A page that would exceed `limit_mb` shows means over blocks of 2 by 2, 4 by 4, ... pixels, of the waveforms first,
    and a note about it. Since pixels share photons, the error of such a mean is unknown; the page shows its upper
    bound, the mean of the errors.

    Parameters
    ----------
    stack : xarray.Dataset
        A gate stack: ``gate_energy`` and ``gate_energy_stderr`` [J] over (row, column, gate) or (pixel, gate), with the
        coordinates ``gate_start`` and ``gate_width`` [ns], ``angle_x`` and ``angle_y`` [mrad] and, if the time of the
        surface echo is known, ``gate_depth`` [m]. With the lines of sight of a result, depths of pixels are along them,
        and those of gates and times are on the receiver's axis.
    path : path
        HTML file to write. An existing file is replaced.
    result : xarray.Dataset, optional
        A render of the same pixels, whose ``waveform`` [W] is plotted; by default `stack` itself. Without waveforms the
        record of a pixel is its energy in the gates.
    limit_mb : float
        Largest size of the page [MB of 1e6 bytes], above 0.

    Raises
    ------
    UserError
        If the file has another suffix, `stack` is no gate stack, `result` has other pixels, `limit_mb` is not above 0
        or too small for the gates of one block (of all pixels, if they form no image), or the file cannot be written.
    """
    path = Path(path)
    if path.suffix.lower() != ".html":
        raise UserError(f"cannot write {path}: the file name must end in .html.")
    positive("limit_mb", limit_mb)
    gated = check_stack(stack)
    record = _record(gated, stack if result is None and "waveform" in stack else result)
    gated = picture_order(gated)
    frame = _frame()
    room = 1e6 * limit_mb - sum(len(piece.encode()) for piece in frame) - _room_for_metadata(gated)
    gates, waveforms = _fit(gated, record, room, limit_mb)
    notes = _notes(gates, waveforms, record is not None, limit_mb)
    for note in notes:
        _LOG.warning("%s: %s", path, note)
    metadata = _metadata(gated, record, gates, waveforms) | {"notes": notes}
    filled = {
        "policy": _POLICY,
        "title": html.escape(metadata["title"]),
        "data": "\n".join(_data_elements(metadata, gates, waveforms)),
    }
    with replacing(path) as temporary, temporary.open("w", encoding="utf-8") as file:
        # Odd pieces of the frame are names of placeholders.
        file.writelines(filled[piece] if i % 2 else piece for i, piece in enumerate(frame))


def _record(stack: xr.Dataset, result: xr.Dataset | None) -> xr.Dataset | None:
    """Return the result, if any, in picture order, after checking that it has waveforms of the pixels of the stack."""
    if result is None:
        return None
    if "waveform" not in result:
        raise UserError("the result has no variable waveform.")
    wanted = {name: size for name, size in stack["gate_energy"].sizes.items() if name != "gate"}
    found = {name: size for name, size in result["waveform"].sizes.items() if name != "time"}
    if found != wanted:
        raise UserError(f"the result has the pixels {found}; they must be those of the gate stack, {wanted}.")
    # A result without angles is in the order of the stack.
    known = {name: stack[name].variable for name in ("angle_x", "angle_y") if name not in result.coords}
    return picture_order(result.assign_coords(known))


def _fit(stack: xr.Dataset, record: xr.Dataset | None, room: float, limit_mb: float) -> tuple[_Blocks, _Blocks | None]:
    """Return gates and waveforms in the smallest blocks that fit into `room` bytes, or None for the waveforms."""
    factors = [1]
    if "pixel" not in stack["gate_energy"].dims:
        while factors[-1] < max(stack.sizes["row"], stack.sizes["column"]):
            factors.append(2 * factors[-1])
    for factor in factors:
        gates = _encode(stack, (*_GATES, *_SIGHTS), factor)
        if gates.size <= room:
            break
    else:
        raise UserError(f"limit_mb = {limit_mb:g} is too small for this stack, even without waveforms.")
    if record is not None:
        for factor in factors[factors.index(gates.factor) :]:
            waveforms = _encode(record, _WAVEFORMS, factor)
            if gates.size + waveforms.size <= room:
                return gates, waveforms
    return gates, None


def _encode(dataset: xr.Dataset, names: Sequence[str], factor: int) -> _Blocks:
    """Encode the variables that the dataset has."""
    encoded = {}
    for name in names:
        if name not in dataset:
            continue
        values = _image(dataset[name])
        if factor > 1:
            values = _means(values, factor)
        # The page reads images gate by gate, waveforms pixel by pixel.
        encoded[name] = _base64(values if name in _WAVEFORMS else np.moveaxis(values, -1, 0))
    rows, columns = values.shape[:2]
    return _Blocks(factor, rows, columns, encoded)


def _image(variable: xr.DataArray) -> FloatArray:
    """Return values as (row, column, gate or time), the last of size 1 without it; pixels without image are one row."""
    if not {"gate", "time"} & set(variable.dims):
        variable = variable.expand_dims("gate")
    last = "gate" if "gate" in variable.dims else "time"
    if "pixel" in variable.dims:
        return np.asarray(variable.transpose("pixel", last).values, dtype=np.float64)[np.newaxis]
    return np.asarray(variable.transpose("row", "column", last).values, dtype=np.float64)


def _means(values: FloatArray, factor: int) -> FloatArray:
    """Average blocks of pixels; the last ones may be smaller."""
    for axis in (0, 1):
        starts = np.arange(0, values.shape[axis], factor)
        counts = np.diff(starts, append=values.shape[axis])
        shape = [-1 if i == axis else 1 for i in range(3)]
        values = np.add.reduceat(values, starts, axis=axis) / counts.reshape(shape)
    return values


def _base64(values: FloatArray) -> str:
    # Bytes of equal significance compress better together: neighbours differ only in their last digits.
    planes = np.ascontiguousarray(values, dtype="<f4").view(np.uint8).reshape(-1, 4).T.tobytes()
    packer = zlib.compressobj(3, zlib.DEFLATED, -zlib.MAX_WBITS)
    return base64.b64encode(packer.compress(planes) + packer.flush()).decode("ascii")


def _notes(gates: _Blocks, waveforms: _Blocks | None, has_record: bool, limit_mb: float) -> list[str]:
    """Return one sentence for each reduction of the data."""
    reason = f"because the page would have exceeded {limit_mb:g} MB"
    means = "means over blocks of {0} by {0} pixels, with upper bounds of their errors, " + reason
    notes = []
    if gates.factor > 1:
        notes.append(f"The images show {means.format(gates.factor)}.")
    if waveforms is not None and waveforms.factor > 1:
        notes.append(f"The waveforms are {means.format(waveforms.factor)}.")
    if has_record and waveforms is None:
        notes.append(f"The waveforms were left out, {reason}.")
    return notes


def _metadata(
    stack: xr.Dataset, record: xr.Dataset | None, gates: _Blocks, waveforms: _Blocks | None
) -> dict[str, Any]:
    """Return the data of the page except the arrays, ready for JSON."""
    start, width = (np.asarray(stack[name].values, dtype=np.float64) for name in ("gate_start", "gate_width"))
    depth = known_depths(stack)
    # The depth axis is linear in time.
    line = np.polyfit(start + width / 2, depth, 1)[::-1] if depth is not None and len(start) > 1 else None
    metadata = {
        "title": drawing.scene_name(stack.attrs) or "gate stack",
        "rows": gates.rows,
        "columns": gates.columns,
        "block": gates.factor,
        "names": [str(name) for name in stack["pixel"].values] if "pixel" in stack["gate_energy"].dims else None,
        "axes": _axes(stack, gates),
        "gate_start": start.tolist(),
        "gate_width": width.tolist(),
        "gate_depth": None if depth is None else depth.tolist(),
        "depth_of_time": None if line is None else line.tolist(),
        "waveform": None,
        "colour_maps": _colour_maps(),
        "attributes": _attributes(stack),
    }
    if record is not None and waveforms is not None:
        time = record["time"].values
        metadata["waveform"] = {
            "columns": waveforms.columns,
            "block": waveforms.factor // gates.factor,
            "bins": len(time),
            "time": float(time[0]),
            "step": float(time[1] - time[0]) if len(time) > 1 else 1.0,
        }
    return metadata


def _axes(stack: xr.Dataset, gates: _Blocks) -> dict[str, float]:
    """Return the left and upper edges of the image and the pitch of its blocks [mrad], or in pixels if no image.

    The pitch is the change of angle_x from a row to the one above it, and of angle_y from a column to the next one.
    """
    if "pixel" in stack["gate_energy"].dims:
        height = max(1.0, gates.columns / _STRIP_ASPECT)
        return {"left": -0.5, "top": height / 2, "across": 1.0, "along": height}
    left, _, _, top = drawing.image_extent(stack)
    along, across = drawing.pixel_pitch(stack)
    return {"left": left, "top": top, "across": -across * gates.factor, "along": along * gates.factor}


def _colour_maps() -> dict[str, str]:
    """Return 256 colours of each map as base64 of their red, green and blue bytes."""
    tables = {name: matplotlib.colormaps[name](np.arange(256), bytes=True)[:, :3] for name in _COLOUR_MAPS}
    return {name: base64.b64encode(table.tobytes()).decode("ascii") for name, table in tables.items()}


def _attributes(stack: xr.Dataset) -> list[list[str]]:
    """Return names and values of the attributes, without the text of the scene, its files and its objects."""
    long = ("scene_xml", "scene_dict", "scene_files", "plugin_parameters")
    return [[str(name), _readable(value)] for name, value in stack.attrs.items() if name not in long]


def _readable(value: Any) -> str:
    if isinstance(value, (list, tuple, np.ndarray)):
        return ", ".join(_readable(item) for item in value)
    return f"{value:.10g}" if isinstance(value, float) else str(value)


def _room_for_metadata(stack: xr.Dataset) -> int:
    """Return a bound on the bytes of the metadata: 25 letters in a number, 12 bytes in a letter."""
    letters = 3 * len(str(stack.attrs.get("scene", "")))  # also the title
    letters += sum(len(name) + len(value) + 8 for name, value in _attributes(stack))
    names = sum(len(str(name)) + 4 for name in stack["pixel"].values) if "pixel" in stack else 0
    return 12 * (letters + names) + 75 * stack.sizes["gate"] + 10_000


def _data_elements(metadata: dict[str, Any], gates: _Blocks, waveforms: _Blocks | None) -> Iterator[str]:
    """Yield the HTML elements that hold the metadata and the arrays."""
    text = json.dumps(metadata, allow_nan=False)
    # The text must not end its element or begin another one.
    for letter in "<>&":
        text = text.replace(letter, f"\\u{ord(letter):04x}")
    yield f'<script type="application/json" id="metadata">{text}</script>'
    for name, encoded in (gates.encoded | (waveforms.encoded if waveforms else {})).items():
        yield f'<script type="text/plain" id="{name}">{encoded}</script>'


def _frame() -> list[str]:
    """Return the page with its style and script, as alternating text and names of placeholders."""
    folder = resources.files("mitransient_lidar.plots.gate_viewer")
    style = folder.joinpath("page.css").read_text(encoding="utf-8")
    script = "\n".join(folder.joinpath(f"{name}.js").read_text(encoding="utf-8") for name in _SCRIPTS)
    frame = folder.joinpath("page.html").read_text(encoding="utf-8")
    frame = frame.replace("{{style}}", style).replace("{{script}}", script)
    return re.split(r"\{\{(\w+)\}\}", frame)
