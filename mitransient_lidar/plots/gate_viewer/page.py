"""Self-contained HTML page that shows a gate stack or waveforms, without network or installation.

The page shows a gate image, steps and plays through the gates, maps depths, and plots the records of selected pixels.
For waveforms, time bins replace the gates. Its parts are ``page.html``, ``page.css`` and the ``.js`` files. The arrays
are embedded as base64 from raw deflate data. These contain little-endian float32 numbers: all numbers' first bytes,
then the second ones, ... Many values are rounded to within 1/16 of their standard errors, and these to within 2 %.
"""

from __future__ import annotations

import base64
import html
import json
import logging
import re
import zlib
from collections.abc import Iterator, Sequence
from dataclasses import dataclass
from importlib import resources
from typing import Any

import matplotlib
import numpy as np
import xarray as xr

from mitransient_lidar.core.errors import UserError
from mitransient_lidar.core.validation import FloatArray, positive
from mitransient_lidar.plots import drawing, palette
from mitransient_lidar.plots.drawing import as_seen
from mitransient_lidar.plots.gates.images import known_depths
from mitransient_lidar.results.attributes import check_attributes, check_coordinates, described
from mitransient_lidar.results.dataset import record_dims, time_axis
from mitransient_lidar.results.gate_stack import as_stack, has_frames
from mitransient_lidar.results.geometry import LinesOfSight, lidar_geometry

#: Variables with a record in time, and their errors; for a signal the standard deviation of one record.
RECORDS = {"signal": "signal_deviation", "waveform": "waveform_stderr"}


def one_record(dataset: xr.Dataset) -> xr.Dataset:
    """Return every pixel's record in time as ``waveform`` and ``waveform_stderr``, in picture order.

    For a shot series it is the mean, with the mean's standard error. The waveform's attribute ``units`` is W, V or 1,
    and its ``long_name`` belongs to the variable shown.

    Raises UserError if it has another shape, no pixel angles, or attributes or times that are invalid. `dataset`: a
    result with ``waveform``, or a record with ``signal``, over (pixel, time) or (row, column, time), after ``shot`` if
    it has shots.
    """
    name = next(name for name in RECORDS if name in dataset)
    dims = record_dims(dataset, name, shots=True)
    check_attributes("the result", dataset.attrs)
    check_coordinates("the result", dataset, name)
    values = dataset[name]
    error = dataset.get(RECORDS[name], values * np.nan).broadcast_like(values)
    if dims[0] == "shot":
        error = (error**2).sum("shot", skipna=False) ** 0.5 / values.sizes["shot"]
        values = values.mean("shot")
    pixels = [dim for dim in dims if dim not in ("shot", "time")]
    own = {key: one for key, one in dataset.coords.items() if {*one.dims} <= {*pixels, "time"}}
    for angle in ("angle_x", "angle_y"):
        if angle not in own or set(own[angle].dims) != set(pixels):
            raise UserError(f"the result has no coordinate {angle} over ({', '.join(pixels)}): it has no map to draw")
    about = {**described(name), **{key: str(text) for key, text in dataset[name].attrs.items() if key == "units"}}
    arrays = {"waveform": (values, about), "waveform_stderr": (error, {})}
    order = (*pixels, "time")
    data = {key: (order, one.transpose(*order).values, text) for key, (one, text) in arrays.items()}
    return as_seen(xr.Dataset(data, own, dataset.attrs))


def time_bins(record: xr.Dataset) -> xr.Dataset:
    """Return the time bins of `one_record` with a gate stack's coordinates: its starts, widths and depths.

    Depths are on the axis, NaN where the geometry is unknown; where it is known, ``surface_time`` and ``depth_per_ns``
    are the pixels' lines of sight.
    """
    axis = time_axis(record)
    try:
        depth = lidar_geometry(record.attrs, surface="measured").depth_of_time(axis.centres_ns)
    except UserError:
        depth = np.full(axis.bin_count, np.nan)
    bins = record.drop_vars(["time", "waveform_stderr"]).rename(waveform="gate_energy", time="gate")
    coordinates = {
        "gate_start": axis.centres_ns - 0.5 * axis.bin_width_ns,
        "gate_width": np.full(axis.bin_count, axis.bin_width_ns),
        "gate_depth": depth,
    }
    bins = bins.assign_coords({name: ("gate", values) for name, values in coordinates.items()})
    try:
        lines = LinesOfSight.from_dataset(record)
    except UserError:
        return bins.drop_vars(["surface_time", "depth_per_ns"], errors="ignore")
    dims = record["waveform"].dims[:-1]
    shape = record["waveform"].shape[:-1]
    sights = {"surface_time": lines.surface_time, "depth_per_ns": lines.depth_per_ns}
    return bins.assign_coords({name: (dims, values.reshape(shape)) for name, values in sights.items()})


_LOG = logging.getLogger(__name__)

_COLOUR_MAPS = ("viridis", "magma", "turbo", "gray")
_SCRIPTS = ("unpack", "data", "image", "curves", "files", "main")  # in the order in which they are joined
_GATES = ("gate_energy", "gate_energy_stderr")
_SIGHTS = ("surface_time", "depth_per_ns")  # coordinates of `geometry.LinesOfSight`
_WAVEFORMS = ("waveform", "waveform_stderr")
POLICY = "default-src 'none'; script-src 'unsafe-inline'; style-src 'unsafe-inline'; img-src data:"
_STRIP_ASPECT = 4.0  # at most, of pixels drawn side by side
_EXACT = 400_000  #: Most numbers that are embedded exactly.

#: Binary digits kept of values without errors, of errors, and of values per error.
_VALUE_BITS, _ERROR_BITS, _BITS_PER_ERROR = 12, 5, 3


@dataclass(frozen=True)
class _Blocks:
    """Encoded arrays with means over blocks with `factor` times `factor` pixels."""

    factor: int
    rows: int
    columns: int
    encoded: dict[str, str]

    @property
    def size(self) -> int:
        return sum(map(len, self.encoded.values()))


def page_text(stack: xr.Dataset, result: xr.Dataset | None = None, limit_mb: float = 200.0) -> str:
    """Return the HTML page that shows a gate stack or waveforms.

    A page that would exceed `limit_mb` shows means over 2 by 2, 4 by 4, ... pixels, first for the waveforms, and a note
    about it. Since pixels share photons, such a mean's error is unknown; the page shows its upper bound, the mean of
    the errors.

    Raises UserError if `stack` has neither gates nor a record in time, `result` has other pixels, or `limit_mb` is not
    above 0 or too small for the gates of one block (of all pixels, if they form no image). `stack`: a result with
    ``waveform`` [W], or a record with ``signal``, over (pixel, time) or (row, column, time); the map shows one of its
    time bins. For a shot series, the page shows the mean. Pixels with outlines (``pixel_outlines``) have their shapes.
    Or camera frames, whose mean above the dark level the page shows, or a gate stack: ``gate_energy`` and
    ``gate_energy_stderr`` [J] over (row, column, gate) or (pixel, gate), with the coordinates ``gate_start`` and
    ``gate_width`` [ns], ``angle_x`` and ``angle_y`` [mrad] and, if the surface echo time is known, ``gate_depth`` [m].
    With a result's lines of sight, pixel depths are along them; gate and time depths are on the receiver's axis.
    `result`: a render of the same pixels, whose ``waveform`` [W] is plotted; by default `stack` itself. Without
    waveforms a pixel's record is its energy in the gates. `limit_mb`: largest page size [MB of 1e6 bytes], above 0.
    """
    positive("limit_mb", limit_mb)
    record: xr.Dataset | None
    gated_already = "gate_energy" in stack or has_frames(stack)
    if is_record := not gated_already and bool({*RECORDS} & {*stack.data_vars}):
        record = one_record(stack)
        gated = time_bins(record)
    else:
        gated = as_stack(stack)
        record = _record(gated, stack if result is None and "waveform" in stack else result)
        gated = drawing.as_seen(gated)
    frame = _frame()
    room = 1e6 * limit_mb - sum(len(piece.encode()) for piece in frame) - _room_for_metadata(gated)
    gates, waveforms = _fit(gated, record, room, limit_mb, is_record=is_record)
    notes = _notes(gates, waveforms, record is not None, limit_mb)
    if is_record and "shot" in stack.dims:
        notes.insert(0, f"The waveforms are means over {stack.sizes['shot']} shots.")
    for note in notes:
        _LOG.warning("the page: %s", note)
    metadata = _metadata(gated, record, gates, waveforms) | {"notes": notes}
    metadata |= _words(record if is_record else None, gated) | {"time_label": drawing.time_label(stack)}
    filled = {
        "policy": POLICY,
        "title": html.escape(metadata["title"]),
        "kind": "waveforms" if is_record else "gate stack",
        "data": "\n".join(_data_elements(metadata, gates, waveforms)),
    }
    # Odd pieces of the frame are placeholder names.
    return "".join(filled[piece] if i % 2 else piece for i, piece in enumerate(frame))


def _record(stack: xr.Dataset, result: xr.Dataset | None) -> xr.Dataset | None:
    """Return the result, if any, after checking that its waveforms have the stack's pixels."""
    if result is None:
        return None
    if "waveform" not in result:
        raise UserError("the result has no variable waveform")
    wanted = {name: size for name, size in stack["gate_energy"].sizes.items() if name != "gate"}
    found = {name: size for name, size in result["waveform"].sizes.items() if name != "time"}
    if found != wanted:
        raise UserError(f"the result has the pixels {found}; they must be those of the gate stack, {wanted}")
    # A result without angles is in the order of the stack.
    known = {name: stack[name].variable for name in ("angle_x", "angle_y") if name not in result.coords}
    return drawing.as_seen(result.assign_coords(known))


def _fit(
    stack: xr.Dataset, record: xr.Dataset | None, room: float, limit_mb: float, *, is_record: bool
) -> tuple[_Blocks, _Blocks | None]:
    """Return gates and waveforms in the smallest blocks that fit into `room` bytes, or None for the waveforms.

    For a record, the gates are its time bins, with the waveforms' values.
    """
    factors = [1]
    if "pixel" not in stack["gate_energy"].dims:
        while factors[-1] < max(stack.sizes["row"], stack.sizes["column"]):
            factors.append(2 * factors[-1])
    for factor in factors:
        gates = _encode(stack, _SIGHTS if is_record else (*_GATES, *_SIGHTS), factor)
        if is_record and record is not None:
            waveforms = _encode(record, _WAVEFORMS, factor)
            if gates.size + waveforms.size <= room:
                return gates, waveforms
        elif gates.size <= room:
            break
    else:
        without = "" if is_record else ", even without waveforms"
        raise UserError(f"limit_mb = {limit_mb:g} is too small for this stack{without}")
    if record is not None:
        for factor in factors[factors.index(gates.factor) :]:
            waveforms = _encode(record, _WAVEFORMS, factor)
            if gates.size + waveforms.size <= room:
                return gates, waveforms
    return gates, None


def _encode(dataset: xr.Dataset, names: Sequence[str], factor: int) -> _Blocks:
    """Encode the variables that the dataset has."""
    sizes = (1, dataset.sizes["pixel"]) if "pixel" in dataset.dims else (dataset.sizes["row"], dataset.sizes["column"])
    rows, columns = (-(-size // factor) for size in sizes)
    arrays = {name: _means(_image(dataset[name]), factor) for name in names if name in dataset}
    encoded = {}
    for name, values in arrays.items():
        if name not in _SIGHTS and sum(one.size for one in arrays.values()) > _EXACT:
            values = rounded(values, arrays.get(f"{name}_stderr"))
        # The page reads images gate by gate, waveforms pixel by pixel.
        encoded[name] = _base64(values if name in _WAVEFORMS else np.moveaxis(values, -1, 0))
    return _Blocks(factor, rows, columns, encoded)


def rounded(values: FloatArray, errors: FloatArray | None = None) -> FloatArray:
    """Return values with few binary digits, which deflate well: to 1/16 of their errors, or errors to 2 %."""
    scale, bits = (np.abs(values), _ERROR_BITS) if errors is None else (errors, _BITS_PER_ERROR)
    with np.errstate(divide="ignore", invalid="ignore"):
        step, own = (
            np.exp2(np.floor(np.log2(size)) - kept) for size, kept in ((scale, bits), (np.abs(values), _VALUE_BITS))
        )
        step = np.where(step > 0, step, own)
        return np.where(step > 0, np.rint(values / step) * step, values)


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
    if factor == 1:
        return values
    for axis in (0, 1):
        starts = np.arange(0, values.shape[axis], factor)
        counts = np.diff(starts, append=values.shape[axis])
        shape = [-1 if i == axis else 1 for i in range(3)]
        values = np.add.reduceat(values, starts, axis=axis) / counts.reshape(shape)
    return values


def _base64(values: FloatArray) -> str:
    # Bytes of equal significance compress better together: neighbours differ only in their last digits.
    return packed(np.ascontiguousarray(values, dtype="<f4").view(np.uint8).reshape(-1, 4).T.tobytes())


def packed(data: bytes, level: int = 6) -> str:
    """Return bytes as raw deflate data in base64, which ``unpack.js`` reads."""
    packer = zlib.compressobj(level, zlib.DEFLATED, -zlib.MAX_WBITS)
    return base64.b64encode(packer.compress(data) + packer.flush()).decode("ascii")


def _notes(gates: _Blocks, waveforms: _Blocks | None, has_record: bool, limit_mb: float) -> list[str]:
    """Return one sentence for each data reduction."""
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
    """Return the page's data except the arrays, ready for JSON."""
    start, width = (np.asarray(stack[name].values, dtype=np.float64) for name in ("gate_start", "gate_width"))
    depth = known_depths(stack)
    # The depth axis is linear in time.
    line = np.polyfit(start + width / 2, depth, 1)[::-1] if depth is not None and len(start) > 1 else None
    shapes = _shapes(stack, gates)
    metadata = {
        "title": drawing.scene_name(stack.attrs) or "result",
        "rows": gates.rows,
        "columns": gates.columns,
        "block": gates.factor,
        "names": [str(name) for name in stack["pixel"].values] if "pixel" in stack["gate_energy"].dims else None,
        "shapes": shapes,
        "axes": _axes(stack, gates, shapes),
        "gate_start": start.tolist(),
        "gate_width": width.tolist(),
        "gate_depth": None if depth is None else depth.tolist(),
        "depth_of_time": None if line is None else line.tolist(),
        "waveform": None,
        "colour_maps": _colour_maps(),
        "colours": [colour for colour in palette.CATEGORIES if colour != palette.BLACK],
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
            **_quantity(record),
        }
    return metadata


def _quantity(record: xr.Dataset) -> dict[str, str]:
    """Return name and unit for a record's waveforms, with an empty unit for counts."""
    about = record["waveform"].attrs
    unit = str(about.get("units", "W"))
    return {"name": str(about.get("long_name", "received power")), "unit": "" if unit == "1" else unit}


def _words(record: xr.Dataset | None, gated: xr.Dataset) -> dict[str, Any]:
    """Return names and units for the values shown: gate values, or a record's in its time bins."""
    if record is None:
        about = gated["gate_energy"].attrs
        quantity = {"name": about["long_name"], "unit": about["units"]}
        return {"slice": "gate", "quantity": quantity, "sum": 1.0 if about["units"] == "J" else None}
    quantity = _quantity(record)
    # The energy after a time is the sum of powers times the bin width.
    total = 1e-9 * time_axis(record).bin_width_ns if quantity["unit"] == "W" else None
    return {"slice": "time bin", "quantity": quantity, "sum": total, "window": list(drawing.time_limits(record))}


def _shapes(stack: xr.Dataset, gates: _Blocks) -> list[list[list[float]]] | None:
    """Return the pixel outlines [mrad], lines angle_x, angle_y, angle_x, ... for each; None if unknown."""
    if "pixel" not in stack.dims:
        return None
    lines = json.loads(stack.attrs.get("pixel_outlines", "[]"))
    return lines if len(lines) == gates.columns and all(lines) else None


def _axes(stack: xr.Dataset, gates: _Blocks, shapes: list[list[list[float]]] | None) -> dict[str, float]:
    """Return the image's left and upper edges and its block pitch [mrad], or in pixels if no image.

    The pitch is the change in angle_x from a row to the one above it, and in angle_y from a column to the next one. The
    image with shapes is as wide as all columns, and has one row.
    """
    if shapes is not None:
        points = np.concatenate([np.reshape(line, (-1, 2)) for lines in shapes for line in lines])
        (near, right), (far, left) = points.min(axis=0), points.max(axis=0)
        margin = 0.03 * max(far - near, left - right)
        width = left - right + 2 * margin
        return {
            "left": float(left + margin),
            "top": float(far + margin),
            "across": float(-width / gates.columns),
            "along": float(far - near + 2 * margin),
        }
    if "pixel" in stack["gate_energy"].dims:
        height = max(1.0, gates.columns / _STRIP_ASPECT)
        return {"left": -0.5, "top": height / 2, "across": 1.0, "along": height}
    left, _, _, top = drawing.image_extent(stack)
    along, across = drawing.pixel_pitch(stack)
    return {"left": left, "top": top, "across": -across * gates.factor, "along": along * gates.factor}


def _colour_maps() -> dict[str, str]:
    """Return each map's 256 colours, their red, green and blue bytes as base64."""
    tables = {name: matplotlib.colormaps[name](np.arange(256), bytes=True)[:, :3] for name in _COLOUR_MAPS}
    return {name: base64.b64encode(table.tobytes()).decode("ascii") for name, table in tables.items()}


def _attributes(stack: xr.Dataset) -> list[list[str]]:
    """Return attribute names and values, without texts for the scene, its files, objects and outlines."""
    long = {"scene_xml", "scene_dict", "scene_files", "plugin_parameters"}
    long |= {"pixel_outlines", "beam_outlines", "target_outlines"}
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
    outlines = len(stack.attrs.get("pixel_outlines", ""))
    return 12 * (letters + names) + outlines + 75 * stack.sizes["gate"] + 10_000


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
    script = "\n".join(part(f"{name}.js") for name in _SCRIPTS)
    frame = part("page.html").replace("{{style}}", part("page.css")).replace("{{script}}", script)
    return re.split(r"\{\{(\w+)\}\}", frame)


def part(name: str) -> str:
    """Return the text in a page file."""
    return resources.files(__package__).joinpath(name).read_text(encoding="utf-8")
