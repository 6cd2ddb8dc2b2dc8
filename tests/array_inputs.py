"""Files of arrays that users give to the package: height maps, images and meshes."""

from __future__ import annotations

from collections.abc import Callable
from pathlib import Path
from typing import Any
from xml.sax.saxutils import escape

import h5py
import numpy as np
import OpenEXR
import pyproj
import rasterio
import xarray as xr

from mitransient_lidar.loading import variants
from mitransient_lidar.physics.sea.height_maps import read_height_map
from mitransient_lidar.transport.sensor import image_sampling

_HEIGHTS = 0.1 * np.sin(np.arange(24.0))[:, None] * np.ones(20)


def write_bag(path: Path, heights: Any, first: tuple[float, float], cell: tuple[float, float], **changes: Any) -> Path:
    """Write a Bathymetric Attributed Grid from its south-western cell on; `changes` are parts of its metadata."""
    rows, columns = np.shape(heights)
    last = (first[0] + (columns - 1) * cell[0], first[1] + (rows - 1) * cell[1])
    corners = changes.get("corners", f"{first[0]!r},{first[1]!r} {last[0]!r},{last[1]!r}")
    axes = "".join(
        "<gmd:axisDimensionProperties><gmd:MD_Dimension><gmd:dimensionName>"
        f'<gmd:MD_DimensionNameTypeCode codeListValue="{name}">{name}</gmd:MD_DimensionNameTypeCode>'
        f"</gmd:dimensionName><gmd:dimensionSize><gco:Integer>{count}</gco:Integer></gmd:dimensionSize>"
        f'<gmd:resolution><gco:Measure uom="Metre">{size!r}</gco:Measure></gmd:resolution></gmd:MD_Dimension>'
        "</gmd:axisDimensionProperties>"
        for name, count, size in (("row", rows, cell[1]), ("column", columns, cell[0]))
    )
    systems = changes.get("system", pyproj.CRS(32633).to_wkt("WKT1_GDAL")), changes.get("datum", "")
    references = "".join(
        "<gmd:referenceSystemInfo><gmd:MD_ReferenceSystem><gmd:referenceSystemIdentifier><gmd:RS_Identifier><gmd:code>"
        f"<gco:CharacterString>{escape(wkt)}</gco:CharacterString></gmd:code><gmd:codeSpace><gco:CharacterString>WKT"
        "</gco:CharacterString></gmd:codeSpace></gmd:RS_Identifier></gmd:referenceSystemIdentifier>"
        "</gmd:MD_ReferenceSystem></gmd:referenceSystemInfo>"
        for wkt in systems
        if wkt
    )
    spaces = "".join(f' xmlns:{name}="http://www.isotc211.org/2005/{name}"' for name in ("gmi", "gmd", "gco", "gml"))
    text = (
        f"<gmi:MI_Metadata{spaces}><gmd:spatialRepresentationInfo><gmd:MD_Georectified>{axes}<gmd:cornerPoints>"
        f"<gml:Point><gml:coordinates>{corners}</gml:coordinates></gml:Point></gmd:cornerPoints></gmd:MD_Georectified>"
        f"</gmd:spatialRepresentationInfo>{references}</gmi:MI_Metadata>"
    )
    with h5py.File(path, "w") as file:
        root = file.create_group("BAG_root")
        root.attrs["Bag Version"] = np.bytes_("1.6.2")
        root["elevation"] = root["uncertainty"] = np.asarray(heights, dtype=np.float32)
        root["metadata"] = np.frombuffer(text.encode(), dtype="S1")
    return path


def height_map(suffix: str) -> Callable[[Path], Path]:
    def make(folder: Path) -> Path:
        path = folder / f"map{suffix}"
        positions = {"x": np.arange(20.0), "y": np.arange(24.0)}
        if suffix == ".npy":
            np.save(path, _HEIGHTS)
        elif suffix == ".npz":
            np.savez(path, heights=_HEIGHTS, **positions)
        elif suffix == ".exr":
            kind = {"compression": OpenEXR.ZIP_COMPRESSION, "type": OpenEXR.scanlineimage}
            with OpenEXR.File(kind, {"Y": _HEIGHTS.astype(np.float32)}) as file:
                file.write(str(path))
        elif suffix == ".nc":
            xr.Dataset({"height": (("y", "x"), _HEIGHTS)}, positions).to_netcdf(path, engine="h5netcdf")
        elif suffix == ".bag":
            write_bag(path, _HEIGHTS, (500000.0, 6000000.0), (1.0, 1.0))
        elif suffix == ".tif":
            shape = {"width": 20, "height": 24, "count": 1, "dtype": "float64", "crs": "EPSG:32633"}
            place = rasterio.Affine(1, 0, 500000, 0, -1, 6000024)
            with rasterio.open(path, "w", driver="GTiff", transform=place, **shape) as file:
                file.write(_HEIGHTS[::-1], 1)
        elif suffix == ".xyz":
            places = np.random.default_rng(0).uniform(0, 20, (200, 2))
            rows = (f"{x:.2f} {y:.2f} {0.1 * np.sin(y):.3f}" for x, y in places)
            path.write_text("\n".join(("x y z", *rows)))
        else:
            head = "ncols 20\nnrows 24\nxllcorner 0\nyllcorner 0\ncellsize 1\nnodata_value -9999\n"
            path.write_text(head + "\n".join(" ".join(f"{one:.4f}" for one in row) for row in _HEIGHTS))
        return path

    return make


def load_map(path: Path) -> None:
    holes = "fill" if path.suffix == ".xyz" else "refuse"
    read_height_map(path, size=20.0 if path.suffix in (".npy", ".exr") else None, holes=holes)


def image(suffix: str) -> Callable[[Path], Path]:
    def make(folder: Path) -> Path:
        import mitsuba as mi

        path = folder / f"image{suffix}"
        values = np.arange(1, 64, dtype=np.uint8).reshape(7, 9)
        if suffix == ".npy":
            np.save(path, values)
        else:
            with variants.several_threads():
                picture = values[..., None] if suffix == ".png" else values[..., None].astype(np.float32)
                mi.Bitmap(picture).write(str(path))
        return path

    return make


def read_image(path: Path) -> None:
    image_sampling.read_image("pixel_map", str(path))


def mesh(name: str) -> Callable[[Path], Path]:
    """Return what writes the mesh of a square, as PLY of text or binary records, or as OBJ."""
    corners = np.array([(-1, -1, -3), (1, -1, -3), (1, 1, -3), (-1, 1, -3)], dtype="<f4")
    faces = [(0, 1, 2), (0, 2, 3)]

    def make(folder: Path) -> Path:
        path = folder / name
        if path.suffix == ".obj":
            lines = [f"v {x:g} {y:g} {z:g}" for x, y, z in corners] + [
                f"f {a + 1} {b + 1} {c + 1}" for a, b, c in faces
            ]
            path.write_text("\n".join(lines) + "\n")
            return path
        binary = "binary" in name
        head = ["ply", f"format {'binary_little_endian' if binary else 'ascii'} 1.0", "element vertex 4"]
        head += [f"property float {axis}" for axis in "xyz"]
        head += ["element face 2", "property list uchar int vertex_indices", "end_header"]
        rows = [f"{x:g} {y:g} {z:g}" for x, y, z in corners] + [f"3 {a} {b} {c}" for a, b, c in faces]
        records = b"".join(b"\x03" + np.array(face, dtype="<i4").tobytes() for face in faces)
        body = corners.tobytes() + records if binary else ("\n".join(rows) + "\n").encode()
        path.write_bytes(("\n".join(head) + "\n").encode() + body)
        return path

    return make
