"""Every format of heights against every property: unit, sign, no data, coordinate system, axes and decimal mark.

All files are one bottom 5 m below the sea, 20 m wide, in cells of 1 m, with a rise of 0.25 m at the last x so that a
wrong order of axes shows. A wrong unit gives 16.4 m (feet taken as metres), 500 m (centimetres) or 5.00001 m (feet of
US surveys taken as international ones, by 2e-6).
"""

import logging
import warnings
from dataclasses import dataclass, field

import numpy as np
import OpenEXR
import pyproj
import pytest
import rasterio
import xarray as xr
from array_inputs import write_bag
from rows import each_row, must_refuse

from mitransient_lidar.core.errors import UserError
from mitransient_lidar.physics.sea.height_maps import read_height_map

N = 21
HEIGHTS = np.full((N, N), -5.0)
HEIGHTS[:, -1] += 0.25
FT, FTUS = 0.3048, 1200 / 3937

#: Places of the map's centre: in UTM zone 33, in State Plane of New York [ftUS], in Web Mercator at 58 degrees north,
#: and in Lambert's projection of Europe.
UTM, STATE_PLANE = (500000.0, 6430000.0), (984000.0, 194000.0)
MERCATOR = pyproj.Transformer.from_crs(4326, 3857, always_xy=True).transform(12, 58)
LAMBERT = pyproj.Transformer.from_crs(4326, 3035, always_xy=True).transform(14, 60)


@dataclass(frozen=True)
class Content:
    """What a file holds: values in its unit, and how it is described."""

    values: np.ndarray = field(default_factory=HEIGHTS.copy)
    cell: float = 1.0  #: In the unit of positions.
    centre: tuple = UTM
    crs: object = None
    no_data: float | None = None
    unit: str = ""
    more: dict = field(default_factory=dict)


def _positions(content):
    return [place + content.cell * (np.arange(N) - N // 2) for place in content.centre]


def write_asc(path, content):
    x, y = (float(one[0]) - content.cell / 2 for one in _positions(content))
    no_data = "" if content.no_data is None else f"NODATA_value {content.no_data!r}\n"
    rows = "\n".join(
        " ".join(content.more.get("text", "{:.12g}").format(one) for one in row) for row in content.values[::-1]
    )
    path.write_text(
        f"ncols {N}\nnrows {N}\nxllcorner {x!r}\nyllcorner {y!r}\ncellsize {content.cell!r}\n{no_data}{rows}\n"
    )
    if content.crs is not None:
        wkt = content.crs if isinstance(content.crs, str) else pyproj.CRS(content.crs).to_wkt("WKT1_ESRI")
        path.with_suffix(".prj").write_text(content.more.get("bom", "") + wkt, "utf-8")


def write_tif(path, content):
    values = content.values[::-1].astype(content.more.get("dtype", "float64"))
    x, y = _positions(content)
    place = rasterio.Affine(content.cell, 0, x[0] - content.cell / 2, 0, -content.cell, y[-1] + content.cell / 2)
    shape = {"width": N, "height": N, "count": 1, "dtype": values.dtype, "nodata": content.no_data}
    crs = None if content.crs is None else rasterio.CRS.from_user_input(content.crs)
    with warnings.catch_warnings():
        warnings.simplefilter("ignore", rasterio.errors.NotGeoreferencedWarning)
        with rasterio.open(path, "w", driver="GTiff", crs=crs, transform=place, **shape) as file:
            file.write(values, 1)
            file.units = [content.unit]


def write_nc(path, content):
    x, y = _positions(content)
    more = {"name": "elevation", "attributes": {}, "axis_unit": "", "dims": ("y", "x"), "axes": ("x", "y")}
    more |= content.more
    units = {"units": content.unit} if content.unit else {}
    axis = {"units": more["axis_unit"]} if more["axis_unit"] else {}
    x_name, y_name = more["axes"]
    dims = [dict(zip("xy", (x_name, y_name), strict=True))[one] for one in more["dims"]]
    values = content.values if more["dims"] == ("y", "x") else content.values.T
    standard = [{"standard_name": f"projection_{one}_coordinate"} if x_name != "x" else {} for one in "xy"]
    data = {more["name"]: (dims, values.astype(more.get("dtype", "float64")), {**units, **more["attributes"]})}
    if content.crs is not None:
        data["crs"] = ((), 0, pyproj.CRS(content.crs).to_cf())
    coordinates = {x_name: (x_name, x, {**axis, **standard[0]}), y_name: (y_name, y, {**axis, **standard[1]})}
    encoding = {} if content.no_data is None else {more["name"]: {"_FillValue": content.no_data}}
    xr.Dataset(data, coordinates).to_netcdf(path, engine="h5netcdf", encoding=encoding)


def write_points(path, content):
    x, y = (one.ravel() for one in np.meshgrid(*_positions(content)))
    columns = {"x": x, "y": y, "z": content.values.ravel(), "s": np.full(x.size, 0.25)}
    order, separator = content.more.get("order", "xyz"), content.more.get("separator", ",")
    rows = [separator.join(f"{columns[name][row]:.9f}" for name in order) for row in range(x.size)]
    text = "\n".join(([content.more["heading"]] if "heading" in content.more else []) + rows)
    path.write_text(content.more.get("change", lambda one: one)(text))


def write_bag_file(path, content):
    x, y = _positions(content)
    system = {} if content.crs is None else {"system": pyproj.CRS(content.crs).to_wkt("WKT1_GDAL")}
    write_bag(path, content.values, (float(x[0]), float(y[0])), (content.cell, content.cell), **system)


def write_npz(path, content):
    x, y = _positions(content)
    np.savez(path, heights=content.values, x=x, y=y)


def write_npy(path, content):
    np.save(path, content.values)


def write_exr(path, content):
    kind = {"compression": OpenEXR.ZIP_COMPRESSION, "type": OpenEXR.scanlineimage}
    with OpenEXR.File(kind, {"Y": np.ascontiguousarray(content.values[::-1].astype(np.float32))}) as file:
        file.write(str(path))


WRITERS = {
    "asc": write_asc, "tif": write_tif, "nc": write_nc, "csv": write_points, "bag": write_bag_file,
    "npz": write_npz, "npy": write_npy, "exr": write_exr,
}  # fmt: skip
POSITIONED = ("asc", "tif", "nc", "csv", "npz")


def read(tmp_path, kind, content, **options):
    path = tmp_path / f"map.{kind}"
    WRITERS[kind](path, content)
    if kind in ("npy", "exr"):
        options["size"] = float(N - 1)
    return read_height_map(path, **options)


def with_holes(value):
    values = HEIGHTS.copy()
    values[3:7, 2:5] = value
    return values


def swapped(text):
    return text.replace(".", ",")


# What is read as the bottom, in metres: format, what the file holds, and options.
READ = {
    "plain": [(kind, Content(), {}) for kind in WRITERS],
    "feet in a heading": [("csv", Content(HEIGHTS / FT, more={"heading": "x_m,y_m,z_ft"}), {})],
    "feet of US surveys in a heading": [
        (
            "csv",
            Content(HEIGHTS / FTUS, 1 / FTUS, more={"heading": "Easting (ftUS),Northing (ftUS),Elevation (ftUS)"}),
            {},
        ),
        (
            "csv",
            Content(HEIGHTS / FTUS, 1 / FTUS, more={"heading": "x [US survey foot],y [US survey foot],z [us-ft]"}),
            {},
        ),
    ],
    "centimetres in a heading": [("csv", Content(100 * HEIGHTS, more={"heading": "x [m],y [m],z [cm]"}), {})],
    "units of NetCDF": [
        ("nc", Content(HEIGHTS / FT, unit="ft"), {}),
        ("nc", Content(HEIGHTS / FTUS, unit="US_survey_foot"), {}),
        ("nc", Content(100 * HEIGHTS, unit="cm"), {}),
        ("nc", Content(HEIGHTS / 1000, 1e-3, (500.0, 6430.0), unit="km", more={"axis_unit": "km"}), {}),
        ("nc", Content(HEIGHTS, 1e-3, (500.0, 6430.0), 32633, unit="m", more={"axis_unit": "km"}), {}),
    ],
    "unit of a GeoTIFF": [
        ("tif", Content(HEIGHTS / FT, unit="ft", crs=32633), {}),
        ("tif", Content(HEIGHTS / FTUS, unit="US survey foot"), {}),
        ("tif", Content(HEIGHTS / FTUS, 1 / FTUS, STATE_PLANE, "EPSG:2263+6360"), {}),
        ("tif", Content(HEIGHTS / FTUS, 1 / FTUS, STATE_PLANE, "EPSG:2263+6360"), {"unit": "ftUS"}),
        ("tif", Content(HEIGHTS / FTUS, 1 / FTUS, STATE_PLANE, "EPSG:2263", unit="ftUS"), {}),
    ],
    "State Plane in a .prj": [
        ("asc", Content(HEIGHTS / FTUS, 1 / FTUS, STATE_PLANE, 2263), {"unit": "ftUS"}),
        ("asc", Content(HEIGHTS, 1 / FTUS, STATE_PLANE, 2263), {"unit": "m"}),
        ("asc", Content(HEIGHTS / FTUS, 1 / FTUS, STATE_PLANE, 2263, more={"bom": "\ufeff"}), {"unit": "us-ft"}),
        ("asc", Content(HEIGHTS / FTUS, 1 / FTUS, STATE_PLANE, pyproj.CRS("EPSG:2263+6360").to_wkt("WKT1_GDAL")), {}),
        ("asc", Content(HEIGHTS / FTUS, 1 / FTUS, STATE_PLANE, pyproj.CRS("EPSG:2263+6360").to_wkt("WKT2_2019")), {}),
    ],
    "old .prj": [
        ("asc", Content(crs="Projection    UTM\nZone 33\nDatum WGS84\nUnits METERS\nZunits METERS\nParameters\n"), {}),
        ("asc", Content(HEIGHTS / FT, 1 / FT, crs="PROJECTION STATEPLANE\nUNITS FEET\nZUNITS FEET\n"), {}),
    ],
    "unit of the user": [(kind, Content(HEIGHTS / FT), {"unit": "ft"}) for kind in WRITERS if kind != "bag"],
    "depths by the user": [(kind, Content(-HEIGHTS), {"values": "depths"}) for kind in WRITERS],
    "depths by name or attribute": [
        ("csv", Content(-HEIGHTS, more={"heading": "x,y,depth"}), {}),
        ("csv", Content(HEIGHTS, more={"heading": "x,y,depth"}), {"values": "heights"}),
        ("nc", Content(-HEIGHTS, more={"name": "depth"}), {}),
        ("nc", Content(-HEIGHTS, more={"attributes": {"positive": "down"}}), {}),
        ("nc", Content(HEIGHTS, more={"name": "depth", "attributes": {"positive": "up"}}), {}),
        ("nc", Content(-HEIGHTS, more={"attributes": {"standard_name": "sea_floor_depth_below_mean_sea_level"}}), {}),
        ("nc", Content(HEIGHTS, more={"name": "depth", "attributes": {"standard_name": "height"}}), {}),
        ("tif", Content(-HEIGHTS, crs="EPSG:32633+5831"), {}),
    ],
    "other columns beside": [
        ("csv", Content(-HEIGHTS, more={"heading": "x,y,depth,depth_uncertainty", "order": "xyzs"}), {}),
        ("csv", Content(-HEIGHTS, more={"heading": "x,y,depth_uncertainty,depth", "order": "xysz"}), {}),
        ("csv", Content(HEIGHTS, more={"heading": "z_std;z;y;x", "order": "szyx", "separator": ";"}), {}),
        ("csv", Content(HEIGHTS, more={"heading": "# x y height_error height", "order": "xysz", "separator": " "}), {}),
    ],
    "decimal commas and quotation marks": [
        ("csv", Content(more={"heading": "x;y;z", "separator": ";", "change": swapped}), {}),
        ("csv", Content(more={"separator": "\t", "change": swapped}), {}),
        ("csv", Content(more={"separator": " ", "change": swapped}), {}),
        (
            "csv",
            Content(more={"separator": '";"', "change": lambda text: '"' + swapped(text).replace("\n", '"\n"') + '"'}),
            {},
        ),
        ("asc", Content(more={"text": "{:.2f}"}), {}),
    ],
    "order of axes": [
        ("nc", Content(more={"dims": ("x", "y")}), {}),
        ("nc", Content(more={"axes": ("easting", "northing"), "axis_unit": "m"}), {}),
        ("nc", Content(more={"axes": ("easting", "northing"), "dims": ("x", "y")}), {}),
        ("csv", Content(more={"heading": "Northing [m],Easting [m],Height [m]", "order": "yxz"}), {}),
    ],
    "coordinate systems whose metres are those on the ground": [
        *((kind, Content(crs=32633), {}) for kind in ("asc", "tif", "nc", "bag")),
        *((kind, Content(crs="EPSG:3006"), {}) for kind in ("asc", "tif", "nc")),
        ("tif", Content(crs="EPSG:3035", centre=LAMBERT), {}),
    ],
    "fathoms": [("csv", Content(HEIGHTS / 1.8288, more={"heading": "x_m,y_m,z_fathom"}), {})],
}


@each_row(*[pytest.param(*row, id=f"{name}, {row[0]}") for name, rows in READ.items() for row in rows])
def test_heights_are_in_metres_and_positive_up(kind, content, options, tmp_path, caplog):
    caplog.set_level(logging.INFO)
    found = read(tmp_path, kind, content, **options)
    # 32-bit formats keep seven digits; feet taken as those of US surveys would be 1e-5 m off.
    tolerance = 1e-6 if kind in ("exr", "bag") else 2e-9
    np.testing.assert_allclose(found.heights, HEIGHTS, rtol=0, atol=tolerance)
    for positions in (found.x, found.y):
        np.testing.assert_allclose(np.diff(positions), 1.0, rtol=0, atol=2e-6)
    # Every format states the same in the log.
    line = next(one for one in caplog.messages if "heights from" in one)
    for part in ("values in ", "positive ", "zero at ", " 0 holes", "positions in ", "coordinate system "):
        assert part in line


# What is refused: format, what the file holds, options, and the message.
DEGREES = (12.5, 58.25)
REFUSED = {
    "unknown units": [
        ("csv", Content(more={"heading": "x_m,y_m,z [hPa]"}), {}, r"unknown unit in column 'z \[hPa\]' .*\[m, cm, mm"),
        ("nc", Content(unit="dbar"), {}, "has heights in 'dbar': allowed are m, cm, km, ft, ftUS, fathom"),
        ("nc", Content(more={"axis_unit": "furlong"}), {}, "has positions in 'furlong': allowed are m, cm"),
        ("tif", Content(unit="kPa"), {}, "has heights in 'kPa': allowed are m, cm"),
        *((kind, Content(), {"unit": "kPa"}, "map_unit is in 'kPa': allowed are m") for kind in WRITERS),
        ("asc", Content(crs="Projection UTM\nUnits YARDS\n"), {}, r"Units YARDS in .*prj: allowed are METERS, FEET"),
        ("asc", Content(crs="Projection UTM\nZunits YARDS\n"), {}, r"has Zunits YARDS in .*prj: allowed are METERS"),
    ],
    "units that contradict each other": [
        ("csv", Content(more={"heading": "x_m,y_m,z_m"}), {"unit": "ft"}, "map_unit = 'ft' must not differ from .*, m"),
        ("bag", Content(), {"unit": "ft"}, "map_unit = 'ft' must not differ from that of .*map.bag, m"),
    ],
    "heights without a unit beside positions in feet": [
        ("csv", Content(more={"heading": "x_ft,y_ft,z"}), {}, "has positions in ft but does not state the unit of its"),
        ("asc", Content(cell=1 / FTUS, centre=STATE_PLANE, crs=2263), {}, "has positions in US survey foot but does"),
        ("tif", Content(cell=1 / FTUS, centre=STATE_PLANE, crs=2263), {}, "has positions in US survey foot but does"),
        ("nc", Content(more={"axis_unit": "ft"}), {}, "has positions in ft but does not state the unit of its heights"),
    ],
    "undeclared values for no data": [
        (kind, Content(with_holes(value)), {}, f"12 of 441 heights of {text}.*no_data = {text.partition(',')[0]}")
        for kinds, value, text in (
            ("tif nc csv bag npz npy exr", -9999.0, "-9999, far from all others"),
            (" ".join(WRITERS), -32768.0, "-32768, beyond 12000 m"),
            ("asc tif nc csv bag npz npy exr", float(np.finfo(np.float32).min), r"-3\.4028234\d*e\+38, beyond 12000 m"),
            ("csv", -999.0, "-999, far from all others"),
            ("asc", -99.0, "-99, far from all others"),
            ("csv", 9999.0, "9999, far from all others"),
            ("npy", 99999.0, "99999, beyond 12000 m"),
        )
        for kind in kinds.split()
    ],
    "heights of no sea": [
        ("csv", Content(3 * HEIGHTS, more={"heading": "x_m,y_m,z_km"}), {}, "420 of 441 heights of -15, beyond"),
    ],
    "angles": [
        *((kind, Content(cell=1e-5, centre=DEGREES), {}, r"has positions about \(12.5, 58.25\) .* look like degrees")
          for kind in POSITIONED),
        ("csv", Content(cell=1e-5, centre=DEGREES, more={"heading": "x,y,z"}), {}, "look like degrees"),
        ("csv", Content(more={"heading": "lon,lat,z"}), {}, "has columns of degrees"),
        ("csv", Content(more={"heading": "Longitude (deg),Latitude (deg),Depth (m)"}), {}, "has columns of degrees"),
        ("nc", Content(more={"axis_unit": "degrees_east"}), {}, "has positions [xy] in degrees"),
        ("nc", Content(more={"axes": ("lon", "lat")}), {}, "has positions lat in degrees"),
        *((kind, Content(cell=1e-5, centre=DEGREES, crs=4326), {}, r"has coordinates in degrees \(WGS 84")
          for kind in ("asc", "tif", "nc", "bag")),
        ("asc", Content(crs="Projection    GEOGRAPHIC\nDatum WGS84\nUnits DD\n"), {}, r"in degrees \(.*prj"),
        ("asc", Content(crs=pyproj.CRS("EPSG:4326+5773").to_wkt("WKT1_GDAL")), {}, "has coordinates in degrees"),
        ("asc", Content(crs="\ufeff" + pyproj.CRS(4326).to_wkt("WKT1_ESRI")), {}, "has coordinates in degrees"),
    ],
    "metres that are not those on the ground": [
        (kind, Content(cell=1.887, centre=MERCATOR, crs=3857), {}, "Mercator, whose lengths at .* are 1.887 times")
        for kind in ("asc", "tif", "nc", "bag")
    ],
    "axes to west and south": [
        (kind, Content(centre=(0.0, 3e6), crs=2053), {}, "has coordinates in .*, to west and south: they must be")
        for kind in ("asc", "tif", "nc")
    ],
    "systems that cannot be read": [
        ("asc", Content(crs="what is this"), {}, r"map.prj = 'what is this' is no coordinate system that pyproj knows"),
    ],
    "ambiguous columns": [
        ("csv", Content(more={"heading": "x,y,height,depth", "order": "xyzs"}), {}, "2 columns height and depth that"),
        ("csv", Content(more={"heading": "x,y,depth_uncertainty"}), {}, "no column z or depth .*found: x, y, depth_"),
        ("csv", Content(), {"values": "up"}, "map_values = 'up' must be heights or depths"),
    ],
    "decimal commas between commas": [
        ("csv", Content(more={"heading": "x,y,z", "change": swapped}), {}, "line 2 has 6 values"),
    ],
}  # fmt: skip


@each_row(*[pytest.param(*row, id=f"{name}, {row[0]}") for name, rows in REFUSED.items() for row in rows])
def test_what_is_no_height_is_refused_in_one_sentence(kind, content, options, message, tmp_path):
    with pytest.raises(UserError, match=message) as error:
        read(tmp_path, kind, content, holes="fill", **options)
    assert "\n" not in str(error.value)


@each_row(
        # Declared by the file, to six digits in the cells of a header of sixteen.
        ("asc", Content(with_holes(-3.40282e38), no_data=-3.4028234663852886e38), {}),
        ("asc", Content(with_holes(-9999.0)), {}),
        ("asc", Content(with_holes(1e6), no_data=1e6), {}),
        ("tif", Content(with_holes(-32768.0), no_data=-32768.0), {}),
        ("tif", Content(with_holes(-3.4e38), no_data=-3.4e38, more={"dtype": "float32"}), {}),
        ("nc", Content(with_holes(-9999.9), no_data=-9999.9, more={"dtype": "float32"}), {}),
        ("bag", Content(with_holes(1e6)), {}),
        *((kind, Content(with_holes(np.nan)), {}) for kind in WRITERS),
        # Declared by the user.
        *((kind, Content(with_holes(-9999.0)), {"no_data": -9999}) for kind in WRITERS),
        *((kind, Content(with_holes(-3.4e38)), {"no_data": "-3.4e38"}) for kind in ("tif", "nc", "csv", "npz", "npy")),
        ("csv", Content(with_holes(-9999.0 * FT) / FT, more={"heading": "x_m,y_m,z_ft"}), {"no_data": -9999}),
        ("csv", Content(more={"change": lambda text: text.replace("-5.000000000", "NA", 12)}), {}),)  # fmt: skip
def test_declared_holes_are_refused_or_filled(kind, content, options, tmp_path):
    must_refuse("has holes, 12 of 441 heights", read, tmp_path, kind, content, **options)
    found = read(tmp_path, kind, content, holes="fill", **options)
    np.testing.assert_allclose(found.heights[:, :-1], -5, rtol=0, atol=1e-6)
    assert found.filled.sum() == 12


def test_a_deep_sea_is_no_missing_value(tmp_path):
    values = -9999.0 + 10 * HEIGHTS + 50
    values[0, 0] = -9999.0
    assert read(tmp_path, "tif", Content(values)).heights.min() == -9999


def test_the_log_states_what_the_file_does(tmp_path, caplog):
    caplog.set_level(logging.INFO)
    content = Content(HEIGHTS / FTUS, 1 / FTUS, STATE_PLANE, "EPSG:2263+6360")
    read(tmp_path, "tif", content)
    assert caplog.messages[-1].endswith(
        "values in US survey foot, positive up, zero at NAVD88 height (ftUS), 0 holes; positions in US survey foot,"
        " coordinate system NAD83 / New York Long Island (ftUS) + NAVD88 height (ftUS)"
    )
