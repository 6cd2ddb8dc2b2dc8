"""One HTML file to look at a gate stack with: no network, no installation.

The page shows a gate's image, steps and plays through the gates, maps depths, and plots the record of the pixels that
are clicked on. Its parts are ``gate_page.html``, ``gate_page.css`` and ``gate_page_*.js``; the arrays are embedded as
base64 of raw deflate data of little-endian float32 numbers, whose first bytes come first, then the second ones, ...
"""

from __future__ import annotations

import base64
import html
import json
import logging
import math
import os
import re
import zlib
from collections.abc import Iterator, Sequence
from dataclasses import dataclass
from importlib import resources
from pathlib import Path
from typing import Any

import numpy as np
import numpy.typing as npt
import xarray as xr

from mitransient_lidar.errors import UserError
from mitransient_lidar.gate_files import check_stack
from mitransient_lidar.results import replacing

_LOG = logging.getLogger(__name__)

_COLOUR_MAPS = ("viridis", "magma", "turbo", "gray")
_SCRIPTS = ("data", "image", "curves", "main")  # in the order in which they are joined
_GATES = ("gate_energy", "gate_energy_stderr")
_WAVEFORMS = ("waveform", "waveform_stderr")
_POLICY = "default-src 'none'; script-src 'unsafe-inline'; style-src 'unsafe-inline'; img-src data:"
_STRIP_ASPECT = 4.0  # at most, of pixels that lie side by side


@dataclass(frozen=True)
class _Blocks:
    """Arrays whose pixels were averaged over blocks of `factor` times `factor`, ready to be embedded."""

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

    A page that would be larger than `limit_mb` shows means over blocks of 2 by 2, 4 by 4, ... pixels, of the waveforms
    first, and says so. The pixels share photons, so the error of such a mean is not known; the mean of their errors,
    which it cannot exceed, stands for it.

    Parameters
    ----------
    stack : xarray.Dataset
        A gate stack: ``gate_energy`` and ``gate_energy_stderr`` [J] over (row, column, gate) or (pixel, gate), with the
        coordinates ``gate_start`` and ``gate_width`` [ns], ``gx`` and ``gy`` [mrad] and, where the surface's time is
        known, ``gate_depth`` [m].
    path : path
        File to write, ending in ``.html``. An existing file is replaced.
    result : xarray.Dataset, optional
        The render of the same pixels, whose ``waveform`` [W] is plotted. By default that of `stack`, if it has
        one, else a pixel's record is its gates.
    limit_mb : float
        Largest size of the page [MB of 1e6 bytes], above 0.

    Raises
    ------
    UserError
        If the suffix is another one, `stack` is no gate stack, `result` has other pixels, `limit_mb` is not above 0 or
        too little for one pixel's gates (for the gates of all pixels, where they form no image), or the file cannot be
        written.
    """
    path = Path(path)
    if path.suffix.lower() != ".html":
        raise UserError(f"cannot write {path}: the file name must end in .html.")
    if not (math.isfinite(limit_mb) and limit_mb > 0):
        raise UserError(f"limit_mb = {limit_mb} must be a finite number above 0.")
    gated = check_stack(stack)
    record = _record(gated, stack if result is None and "waveform" in stack else result)
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
        # Odd pieces of the frame are the names of what stands there.
        file.writelines(filled[piece] if i % 2 else piece for i, piece in enumerate(frame))


def _record(stack: xr.Dataset, result: xr.Dataset | None) -> xr.Dataset | None:
    """Return the result, if there is one, once it is clear that it holds waveforms of the stack's pixels."""
    if result is None:
        return None
    if "waveform" not in result:
        raise UserError("the result has no variable waveform.")
    wanted = {name: size for name, size in stack["gate_energy"].sizes.items() if name != "gate"}
    found = {name: size for name, size in result["waveform"].sizes.items() if name != "time"}
    if found != wanted:
        raise UserError(f"the result has the pixels {found}; they must be those of the gate stack, {wanted}.")
    return result


def _fit(stack: xr.Dataset, record: xr.Dataset | None, room: float, limit_mb: float) -> tuple[_Blocks, _Blocks | None]:
    """Return gates and waveforms in the smallest blocks that fit into `room` bytes; waveforms may not fit at all."""
    factors = [1]
    if "pixel" not in stack["gate_energy"].dims:
        while factors[-1] < max(stack.sizes["row"], stack.sizes["column"]):
            factors.append(2 * factors[-1])
    for factor in factors:
        gates = _encode(stack, _GATES, factor)
        if gates.size <= room:
            break
    else:
        raise UserError(f"limit_mb = {limit_mb:g} is too little for this stack, even without waveforms.")
    if record is not None:
        for factor in factors[factors.index(gates.factor) :]:
            waveforms = _encode(record, _WAVEFORMS, factor)
            if gates.size + waveforms.size <= room:
                return gates, waveforms
    return gates, None


def _encode(dataset: xr.Dataset, names: Sequence[str], factor: int) -> _Blocks:
    encoded = {}
    for name in names:
        if name not in dataset:
            continue
        values = _image(dataset[name])
        if factor > 1:
            values = _means(values, factor)
        # Images are read gate by gate, waveforms pixel by pixel.
        encoded[name] = _base64(np.moveaxis(values, -1, 0) if name in _GATES else values)
    rows, columns = values.shape[:2]
    return _Blocks(factor, rows, columns, encoded)


def _image(variable: xr.DataArray) -> npt.NDArray[np.float64]:
    """Return values as (row, column, gate or time); pixels that form no image lie side by side in one row."""
    last = "gate" if "gate" in variable.dims else "time"
    if "pixel" in variable.dims:
        return np.asarray(variable.transpose("pixel", last).values, dtype=np.float64)[np.newaxis]
    return np.asarray(variable.transpose("row", "column", last).values, dtype=np.float64)


def _means(values: npt.NDArray[np.float64], factor: int) -> npt.NDArray[np.float64]:
    """Average blocks of pixels; those at the end may be smaller."""
    for axis in (0, 1):
        starts = np.arange(0, values.shape[axis], factor)
        counts = np.diff(starts, append=values.shape[axis])
        shape = [-1 if i == axis else 1 for i in range(3)]
        values = np.add.reduceat(values, starts, axis=axis) / counts.reshape(shape)
    return values


def _base64(values: npt.NDArray[np.float64]) -> str:
    # Bytes of one significance together pack better: neighbours differ in their last digits only.
    planes = np.ascontiguousarray(values, dtype="<f4").view(np.uint8).reshape(-1, 4).T.tobytes()
    packer = zlib.compressobj(3, zlib.DEFLATED, -zlib.MAX_WBITS)
    return base64.b64encode(packer.compress(planes) + packer.flush()).decode("ascii")


def _notes(gates: _Blocks, waveforms: _Blocks | None, has_record: bool, limit_mb: float) -> list[str]:
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
    """Return all that the page needs to know beside the arrays, ready for JSON."""
    start, width = (np.asarray(stack[name].values, dtype=np.float64) for name in ("gate_start", "gate_width"))
    depth = stack["gate_depth"].values if "gate_depth" in stack else np.full(len(start), np.nan)
    known = len(start) > 1 and bool(np.isfinite(depth).all())
    metadata = {
        "title": Path(str(stack.attrs.get("scene", ""))).stem or "gate stack",
        "rows": gates.rows,
        "columns": gates.columns,
        "block": gates.factor,
        "names": [str(name) for name in stack["pixel"].values] if "pixel" in stack["gate_energy"].dims else None,
        "axes": _axes(stack, gates),
        "gate_start": start.tolist(),
        "gate_width": width.tolist(),
        "gate_depth": depth.tolist() if np.isfinite(depth).all() else None,
        # The depth axis is linear in time.
        "depth_of_time": np.polyfit(start + width / 2, depth, 1)[::-1].tolist() if known else None,
        "waveform": None,
        "colour_maps": _colour_maps(),
        "attributes": [[str(name), _readable(value)] for name, value in stack.attrs.items()],
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
    """Return the left and upper edge of the image and the pitch of its blocks: in mrad, or counted in pixels."""
    if "pixel" in stack["gate_energy"].dims:
        height = max(1.0, gates.columns / _STRIP_ASPECT)
        return {"left": -0.5, "top": height / 2, "across": 1.0, "along": height}
    gx, gy = (stack[name].transpose("row", "column").values for name in ("gx", "gy"))
    along = abs(float(gx[-1, 0] - gx[0, 0])) / (len(gx) - 1) if gx.shape[0] > 1 else 0.0
    across = abs(float(gy[0, -1] - gy[0, 0])) / (gy.shape[1] - 1) if gy.shape[1] > 1 else 0.0
    # A single row or column is drawn as if its pixels were square.
    along, across = along or across or 1.0, across or along or 1.0
    return {
        "left": float(gy[0, 0]) - across / 2,
        "top": float(gx[0, 0]) + along / 2,
        "across": across * gates.factor,
        "along": along * gates.factor,
    }


def _colour_maps() -> dict[str, str]:
    """Return 256 colours of each map as base64 of their red, green and blue bytes."""
    import matplotlib

    tables = {name: matplotlib.colormaps[name](np.arange(256), bytes=True)[:, :3] for name in _COLOUR_MAPS}
    return {name: base64.b64encode(table.tobytes()).decode("ascii") for name, table in tables.items()}


def _readable(value: Any) -> str:
    if isinstance(value, (list, tuple, np.ndarray)):
        return ", ".join(_readable(item) for item in value)
    return f"{value:.10g}" if isinstance(value, float) else str(value)


def _room_for_metadata(stack: xr.Dataset) -> int:
    """Return a bound on the bytes of the metadata: numbers have at most 25 letters, a letter has at most 12 bytes."""
    letters = 3 * len(str(stack.attrs.get("scene", "")))  # it is the title, too
    letters += sum(len(str(name)) + len(_readable(value)) + 8 for name, value in stack.attrs.items())
    names = sum(len(str(name)) + 4 for name in stack["pixel"].values) if "pixel" in stack else 0
    return 12 * (letters + names) + 75 * stack.sizes["gate"] + 10_000


def _data_elements(metadata: dict[str, Any], gates: _Blocks, waveforms: _Blocks | None) -> Iterator[str]:
    text = json.dumps(metadata, allow_nan=False)
    # Nothing in the text may end the element or begin another one.
    for letter in "<>&":
        text = text.replace(letter, f"\\u{ord(letter):04x}")
    yield f'<script type="application/json" id="metadata">{text}</script>'
    for name, encoded in (gates.encoded | (waveforms.encoded if waveforms else {})).items():
        yield f'<script type="text/plain" id="{name}">{encoded}</script>'


def _frame() -> list[str]:
    """Return the page with its style and script: text and names of what is to be filled in, by turns."""
    folder = resources.files("mitransient_lidar")
    style = folder.joinpath("gate_page.css").read_text(encoding="utf-8")
    script = "\n".join(folder.joinpath(f"gate_page_{name}.js").read_text(encoding="utf-8") for name in _SCRIPTS)
    frame = folder.joinpath("gate_page.html").read_text(encoding="utf-8")
    frame = frame.replace("{{style}}", style).replace("{{script}}", script)
    return re.split(r"\{\{(\w+)\}\}", frame)
