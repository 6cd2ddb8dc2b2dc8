"""HTML page that shows a scene, or a flight's points, in three dimensions to scale, without network.

``page.html`` is the page; Plotly's script and the traces are embedded as base64 of raw deflate data.
"""

from __future__ import annotations

import json
from collections.abc import Iterator, Mapping, Sequence
from html import escape
from importlib import resources
from typing import TYPE_CHECKING, Any

import numpy as np
import numpy.typing as npt
import xarray as xr

from mitransient_lidar.core.validation import FloatArray, IntArray
from mitransient_lidar.physics.sea.sea_mesh import grid_faces
from mitransient_lidar.plots import palette
from mitransient_lidar.plots.gate_viewer.page import POLICY, packed, part
from mitransient_lidar.results.attributes import PointClass

if TYPE_CHECKING:
    from mitransient_lidar.rendering.geometry import Bundle, Relief, SceneGeometry, Solid

_RAYS, _MOST_LAYERS = 4, 12  #: Rays drawn along a beam or pixel, and most boundaries of layers drawn.
_MOST_POINTS = 80_000  #: Most points of a flight that are drawn.


def scene_traces(geometry: SceneGeometry) -> Iterator[dict[str, Any]]:
    """Yield a scene's traces."""
    brightest = max([0.5, *(np.nanmax(one.reflectance, initial=0.0) for one in geometry.reliefs)])
    for relief in geometry.reliefs:
        if np.isfinite(relief.z).any():
            yield _relief(relief, float(brightest))
    for solid in geometry.solids:
        yield _solid(solid)
    for row in _drawn_layers(geometry):
        yield _layer(row, geometry.box)
    pixels = [one for one in geometry.bundles if one.kind == "pixel"]
    colours = palette.pixel_colours(len(pixels))
    for bundle in geometry.bundles:
        colour = (
            colours[pixels.index(bundle)]
            if bundle in pixels
            else palette.BEAM
            if bundle.kind == "beam"
            else palette.VIEW
        )
        yield from _bundle(bundle, colour)
    for name, place in geometry.lidar.items():
        text = f"{name}<br>height {place[2]:.4g} m"
        marker = {"size": 5, "color": palette.BEAM if name == "laser" else palette.VIEW, "symbol": "diamond"}
        yield _points(place[None], mode="markers", marker=marker, name=name, hovertext=text, hoverinfo="text")


def scene_views(geometry: SceneGeometry) -> dict[str, FloatArray]:
    """Return the boxes of the water about the footprints, and up to the lidar."""
    places = np.stack([*geometry.lidar.values()])
    low, high = np.minimum(geometry.box[0], places.min(axis=0)), np.maximum(geometry.box[1], places.max(axis=0))
    high[2] += 0.02 * (high[2] - low[2])
    return {"Water": geometry.box, "Whole beam": np.stack([low, high])}


def scene_notes(geometry: SceneGeometry) -> list[str]:
    """Return sentences on what is drawn."""
    (x, y, _), spacing = np.ptp(geometry.box, axis=0), geometry.spacing
    notes = [
        f"Sea and bottom are drawn at points {spacing:.2g} m apart, as rays meet them in a box of {x:.3g} × {y:.3g} m "
        "about the footprints. Lighter bottoms have a higher reflectance. Beam and pixels are refracted as by a level "
        "sea."
    ]
    for solid in geometry.solids:
        if solid.share < 1:
            notes.append(f"{solid.name}: a part of its triangles is drawn, {solid.share:.0%} of them.")
    if (drawn := len(_drawn_layers(geometry))) < (count := len(geometry.layers)):
        notes.append(f"{drawn} of {count} boundaries between layers are drawn.")
    return notes


def _drawn_layers(geometry: SceneGeometry) -> FloatArray:
    return geometry.layers[:: -(-len(geometry.layers) // _MOST_LAYERS) or 1]


def point_traces(points: xr.Dataset) -> Iterator[dict[str, Any]]:
    """Yield the traces for points from `flights.products.read_points`, one for each class."""
    drawn, origin = points.isel(point=slice(None, None, _step(points))), _origin(points)
    for kind in np.unique(drawn["kind"].values):
        own = drawn.isel(point=drawn["kind"].values == kind)
        known = kind in iter(PointClass)
        name = PointClass(kind).text if known else f"class {kind}"
        places = np.stack([own[axis].values for axis in "xyz"], axis=1)
        about = {"stated error": own.get("vertical_uncertainty")}
        about |= {"error": own["z"] - own["true_z"]} if "true_z" in own and kind != PointClass.NO_ECHO else {}
        listed = {key: 100 * one.values.astype(np.float32) for key, one in about.items() if one is not None}
        lines = [f"{key} %{{customdata[{number}]:.1f}} cm" for number, key in enumerate(listed)]
        text = "<br>".join([name, "x %{x:.2f} m, y %{y:.2f} m", "height %{z:.2f} m", *lines]) + "<extra></extra>"
        style = {"name": f"{name} ({own.sizes['point']})", "mode": "markers", "hovertemplate": text}
        marker = {"size": 2, "color": palette.CLASSES.get(kind, palette.LAYER)}
        custom = {"customdata": np.stack([*listed.values()], axis=1)} if listed else {}
        yield _points(places - origin, marker=marker, **style, **custom)


def point_views(points: xr.Dataset) -> dict[str, FloatArray]:
    """Return the box of all points."""
    places = np.stack([points[axis].values for axis in "xyz"], axis=1) - _origin(points)
    low, high = places.min(axis=0), places.max(axis=0)
    margin = 0.02 * float((high - low).max()) + 0.1
    return {"All points": np.stack([low - margin, high + margin])}


def point_notes(points: xr.Dataset) -> list[str]:
    """Return sentences on the points that are drawn."""
    (x, y, _), step = _origin(points), _step(points)
    part = f", one in {step} drawn" if step > 1 else ""
    place = f" x and y count from {x:.0f} and {y:.0f} m." if x or y else ""
    truth = " Errors are those of heights against the truth." if "true_z" in points else ""
    return [f"{points.sizes['point']} points{part}.{place}{truth}"]


def _step(points: xr.Dataset) -> int:
    return -(-points.sizes["point"] // _MOST_POINTS)


def _origin(points: xr.Dataset) -> FloatArray:
    """Return the place from which coordinates count [m], to whole kilometres where they have many digits."""
    place = np.array([float(points[axis].values[0]) for axis in "xy"] + [0.0])
    return np.where(np.abs(place).max() > 1e4, 1e3 * np.floor(1e-3 * place), 0.0)


def _points(points: FloatArray, **style: Any) -> dict[str, Any]:
    """Return a trace of points, shape (n, 3)."""
    return {"type": "scatter3d", **_columns(points), **style}


def _columns(points: FloatArray) -> dict[str, Any]:
    return dict(zip("xyz", points.astype(np.float32).T, strict=True))


def _mesh(points: FloatArray, faces: npt.NDArray[np.integer], text: str, **style: Any) -> dict[str, Any]:
    """Return a trace of triangles."""
    corners = dict(zip("ijk", faces.astype(np.uint16 if len(points) < 2**16 else np.uint32).T, strict=True))
    about = {"hoverinfo": "text", "hovertext": text, "showlegend": True, "flatshading": True}
    return {"type": "mesh3d", **_columns(points), **corners, **about, **style}


def _span(values: FloatArray) -> str:
    """Return the range of values as text."""
    known = values[np.isfinite(values)]
    ends = (float(known.min()), float(known.max())) if known.size else ()
    # Adding 0 turns -0 into 0; equal ends are one.
    texts = dict.fromkeys(f"{round(end, 3) + 0.0:.4g}" for end in ends)
    return " to ".join(texts) or "unknown"


def _relief(relief: Relief, brightest: float) -> dict[str, Any]:
    name = escape(relief.name) or ("sea surface" if relief.is_sea else "bottom")
    trace = {
        "type": "surface",
        "name": name,
        **{axis: getattr(relief, axis).astype(np.float32) for axis in "xyz"},
        "showscale": False,
        "showlegend": True,
        "contours": {axis: {"highlight": False} for axis in "xyz"},
        "hovertext": f"{name}<br>height {_span(relief.z)} m",
    }
    place = "x %{x:.2f} m, y %{y:.2f} m<br>"
    if relief.is_sea:
        light = {"ambient": 0.8, "diffuse": 0.5, "specular": 0.1}
        text = f"{name}<br>{place}height %{{z:.3f}} m<extra></extra>"
        return trace | {"colorscale": palette.WAVES, "opacity": 0.6, "hovertemplate": text, "lighting": light}
    return trace | {
        "surfacecolor": relief.reflectance.astype(np.float32),
        "colorscale": palette.SAND,
        "cmin": 0.0,
        "cmax": brightest,
        "lighting": {"ambient": 0.75, "diffuse": 0.4, "specular": 0.0},
        "hovertext": f"{trace['hovertext']}<br>reflectance {_span(relief.reflectance)}",
        "hovertemplate": f"{name}<br>{place}height %{{z:.2f}} m<br>reflectance %{{surfacecolor:.3g}}<extra></extra>",
    }


def _solid(solid: Solid) -> dict[str, Any]:
    sides = " × ".join(f"{side:.3g}" for side in np.ptp(solid.points, axis=0))
    reflectance = _span(np.array([solid.reflectance]))
    name = escape(solid.name) or "target"
    text = f"{name}<br>height {_span(solid.points[:, 2])} m<br>{sides} m<br>reflectance {reflectance}"
    if not len(solid.faces):
        return _points(
            solid.points, mode="markers", marker={"size": 2, "color": palette.TARGET}, name=name, hovertext=text
        )
    return _mesh(solid.points, solid.faces, text, name=name, color=palette.TARGET, lighting={"ambient": 0.8})


def _layer(row: FloatArray, box: FloatArray) -> dict[str, Any]:
    depth, above, below = row
    corners = np.array([[x, y, -depth] for y in box[:, 1] for x in box[:, 0]])
    text = f"boundary of layers, {depth:.3g} m deep<br>attenuation {above:.3g} /m above, {below:.3g} /m below"
    return _mesh(corners, grid_faces(2, 2), text, name=f"layer below {depth:.3g} m", color=palette.LAYER, opacity=0.3)


def _bundle(bundle: Bundle, colour: str) -> Iterator[dict[str, Any]]:
    """Yield outlines and some rays of a beam or pixel as lines, and its walls."""
    name = escape(bundle.name)
    end = np.concatenate([loop[-1, :, 2] for loop in bundle.loops])
    sizes = [" × ".join(f"{side:.3g}" for side in bundle.size(level)) for level in (1, -1)]
    widths = " × ".join(f"{500 * angle:.3g}" for angle in bundle.angles)
    text = (
        f"{name}<br>half angles {widths} mrad<br>on the sea {sizes[0]} m<br>"
        f"where it ends {sizes[1]} m, at a height of {_span(end)} m"
    )
    gap, lines = np.full((1, 3), np.nan), []
    for loop in bundle.loops:
        rings = loop[[-1]] if bundle.kind == "lines" else loop[1:]
        lines += [part for ring in rings for part in (ring, gap)]
        if bundle.kind != "lines":
            chosen = np.linspace(0, loop.shape[1] - 1, _RAYS, endpoint=False).astype(int)
            lines += [part for ray in chosen for part in (loop[:, ray], gap)]
    line = {"color": colour, "width": 1 if bundle.kind == "lines" else 3}
    group = {"name": name, "legendgroup": name}
    yield _points(np.concatenate(lines), mode="lines", line=line, hovertext=text, hoverinfo="text", **group)
    if bundle.kind != "lines":
        points, faces = _walls(bundle)
        yield _mesh(points, faces, text, color=colour, opacity=0.13, meta="wall", **group | {"showlegend": False})


def _walls(bundle: Bundle) -> tuple[FloatArray, IntArray]:
    """Return points and triangles between neighbouring rays of closed outlines."""
    points, faces, first = [], [], 0
    for loop in bundle.loops:
        levels, count, _ = loop.shape
        faces.append(grid_faces(levels, count).astype(np.int64) + first)
        points.append(loop.reshape(-1, 3))
        first += levels * count
    return np.concatenate(points), np.concatenate(faces)


def page_text(
    title: str, kind: str, traces: Sequence[Mapping[str, Any]], views: Mapping[str, FloatArray], notes: Sequence[str]
) -> str:
    """Return a page's text.

    `title`, `kind`: what the page shows, its name and kind. `traces`: Plotly traces with coordinates x, y, z [m].
    `views`: boxes that the page can show by name, lowest and highest corner [m], shape (2, 3); it opens with the first
    one. `notes`: sentences below the drawing.
    """
    import plotly.graph_objects as go
    from plotly.offline import get_plotlyjs

    boxes = {name: box.tolist() for name, box in views.items()}
    filled = {
        "policy": POLICY,
        "title": escape(title),
        "kind": escape(kind),
        "notes": "".join(f"<p>{escape(note)}</p>" for note in notes),
        "views": escape(json.dumps(boxes)),
        "figure": packed(go.Figure(list(traces)).to_json().encode(), 9),
        "unpack": part("unpack.js"),
        "library": packed(get_plotlyjs().encode(), 9),
    }
    text = resources.files(__package__).joinpath("page.html").read_text(encoding="utf-8")
    for name, value in filled.items():
        text = text.replace(f"{{{{{name}}}}}", value)
    return text
