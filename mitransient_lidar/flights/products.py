"""Points and waveforms of a flight whose pulses are rendered."""

from __future__ import annotations

from collections.abc import Iterator
from dataclasses import dataclass
from enum import IntFlag
from pathlib import Path
from typing import Any

import numpy as np
import numpy.typing as npt
import xarray as xr

from mitransient_lidar.analysis.waveforms.depth_correction import correct_depths, corrections_for
from mitransient_lidar.analysis.waveforms.depth_errors import mean_slope
from mitransient_lidar.analysis.waveforms.echo_classes import FEW_EVENTS_CHANCE
from mitransient_lidar.analysis.waveforms.echo_detection import EchoClass, EchoFlag
from mitransient_lidar.campaigns.store import PLANNED, Store
from mitransient_lidar.core.constants import C0
from mitransient_lidar.core.errors import UserError
from mitransient_lidar.core.tables.written import table_lines
from mitransient_lidar.core.validation import FloatArray, IntArray
from mitransient_lidar.flights.las import MOST_CHANNELS, MOST_RETURNS, read_las, write_points, write_waveforms
from mitransient_lidar.flights.plan import FlightPlan
from mitransient_lidar.flights.poses.mounting import pixel_turns, poses_of
from mitransient_lidar.flights.positions import ECHOES, IN_AIR, fit_surface, numbered_returns, positions
from mitransient_lidar.flights.preparation import beyond_angles
from mitransient_lidar.loading.variants import alone
from mitransient_lidar.physics.lidar.level_sea import cos_in_water
from mitransient_lidar.physics.lidar.pose import Pose
from mitransient_lidar.results.attributes import PointClass, described, flagged, label
from mitransient_lidar.results.geometry import lidar_system

_CHUNK = 4096  #: Pulses of a chunk of a file.
_COUNTS = 65000  #: Counts of the range of all samples.
_CERTAIN = 0.9  #: Probability of a class below which it is uncertain.

#: Rows of the printed table that are left out without points.
_IF_ANY = ("land", "above the water", "bottom, merged", "withheld")

INFRARED_STORE = "infrared.zarr"  #: Store of the infrared channel with lines of its own, beside that of the flight.

#: Variables of the store that tell the truth of a shot, and their names among those of points.
_TRUTH = ("true_surface_height", "true_bottom_depth", "true_bottom_depth_below_surface")


class Quality(IntFlag):
    """What is to be known of a point before it is used."""

    SATURATED = 1  # its echo, or that of the surface from which its depth counts, is clipped
    POOR_FIT = 2  # too few usable samples, a fit that has not converged, or one with a doubtful amplitude
    CORRECTED = 4  # its depth is corrected by a table
    BEYOND_TABLE = 8  # its angle from nadir or its depth is outside the table
    MERGED = 16  # a bottom and its surface are less than 1.8 echo widths apart
    ABOVE_WATER = 32  # an object that stands above the water, such as a pier
    UNCERTAIN = 64  # its class has a probability below 90 %
    INFRARED = 128  # its surface is that of the infrared channel


@dataclass(frozen=True)
class Flown:
    """A store's rendered pulses, in time order."""

    store: Store  #: The store.
    rows: IntArray  #: Their rows in it.

    @classmethod
    def of(cls, store: Store) -> Flown:
        """Return a store's pulses; raise `UserError` if none is rendered, or it is no flight of this version."""
        if store.kind != "flight":
            raise UserError(f"{store.path} is the store of a {store.kind}, not of a flight")
        if "echo_class" not in store.variables:
            raise UserError(f"{store.path} is of an earlier version, without echo classes: fly into another folder")
        pulse = store.inputs(slice(0, store.count))["pulse"]
        order = np.argsort(pulse)
        rows = order[store.status()[order] != PLANNED]
        if not rows.size:
            raise UserError(f"{store.path} has no pulse that is rendered")
        return cls(store, rows)

    def values(self, name: str) -> Any:
        """Return a variable of all pulses."""
        store = self.store
        inputs: dict[str, str] = store.attributes["inputs"]
        return store.stored(inputs.get(name, name))[self.rows]

    @property
    def poses(self) -> Pose:
        """Poses of all pulses."""
        return poses_of(self.values)

    def coordinate(self, name: str) -> Any:
        """Return a coordinate of the pixels, times or echoes."""
        return self.store.stored(name)

    @property
    def attributes(self) -> dict[str, Any]:
        """Attributes of the echoes."""
        return dict(self.store.attributes["echo_attributes"])


def echoes_of(flown: Flown, corrections: str = "none") -> xr.Dataset:
    """Return all pulses' echoes, with times after their pulse, and depths for each angle.

    `flown`: the pulses. `corrections`: ``none``, ``auto`` or a file, as of `depth_correction.corrections_for`. With
    them there is ``beyond_table``: whether the angle of the pulse or the depth is outside the table.
    """
    attributes, store = flown.attributes, flown.store
    later = flown.values("time_offset_ns")
    data: dict[str, Any] = {}
    for name in store.variables:
        if name.startswith("echo_"):
            array: Any = store.array(name)
            dims = array.metadata.dimension_names
            values: Any = store.stored(name)[flown.rows]
            if name.endswith("time_ns"):
                values = values + later.reshape(-1, *[1] * (values.ndim - 1))
            data[name.removeprefix("echo_")] = (("shot", *dims[1:]), values, dict(array.attrs))
    angles = {name: ("pixel", flown.coordinate(name)) for name in ("angle_x", "angle_y")}
    echoes = xr.Dataset(
        data,
        {"shot": flown.values("pulse"), "pixel": flown.coordinate("pixel"), "echo": flown.coordinate("echo"), **angles},
        attributes,
    )
    angle = flown.values("group_angle_deg")
    turns = pixel_turns(flown.poses)
    kinds, kind = np.unique(np.stack([flown.values("group"), turns]), axis=1, return_inverse=True)
    table = None if corrections == "none" else corrections_for(str(attributes.get("instrument", "")), corrections)
    if table is not None:
        uncorrected = echoes["depth_m"]
        parts, places = [], []
        for number, turn in enumerate(kinds[1].tolist()):
            place = np.flatnonzero(kind.reshape(-1) == number)
            part = echoes.isel(shot=place).assign_attrs(off_nadir_deg=float(angle[place[0]]))
            parts.append(correct_depths(part, table, turn_deg=turn))
            places.append(place)
        order = np.argsort(np.concatenate(places))
        echoes = xr.concat(parts, "shot", combine_attrs="override").isel(shot=order)
        depths = table["depth"].values
        beyond = xr.DataArray(beyond_angles(angle, table), dims="shot") | (uncorrected > depths[-1])
        echoes["beyond_table"] = beyond | (uncorrected < depths[0])
    # Depths were measured along the line of sight of the group's lidar.
    index = float(attributes["refractive_index"])
    down, of_group = -flown.values("axis_z"), np.cos(np.radians(angle))
    ratio = xr.DataArray(cos_in_water(-down, index) / cos_in_water(of_group, index), dims="shot")
    ratio = ratio.where(~echoes["class"].isin([*IN_AIR]), xr.DataArray(down / of_group, dims="shot"))
    for name in ("depth_m", "depth_m_stderr", "depth_m_method_error"):
        echoes[name] = (echoes[name] * ratio).transpose(*echoes[name].dims)
    return echoes


def points_of(flown: Flown, plan: FlightPlan) -> xr.Dataset:
    """Return all echoes' points, in scene coordinates.

    Returns points from `positions.positions`, with ``scan_angle_deg``, ``line``, ``quality`` (`Quality` sums) and
    ``withheld``, whether the echo is saturated or its fit poor; ``pseudo_reflectance``, ``optical_depth`` and
    ``class_probability``; and the truth: ``true_z`` [m], the mean surface height in the beam or, for points below it,
    the highest solid at x and y; ``true_target``, whether that solid is a target; and of the pulse
    ``true_surface_height``, ``true_bottom_depth`` and ``true_bottom_depth_below_surface`` [m]. Points from an infrared
    channel with its own lines follow, with ``transmitter`` 1 and their own numbers as ``shot``. Both channels then give
    the surface.
    """
    infrared = None
    if plan.infrared_lines is not None:
        infrared = points_of(Flown.of(Store(flown.store.path.parent / INFRARED_STORE)), plan.of_infrared())
    echoes = echoes_of(flown, plan.corrections)
    attributes = flown.attributes
    angles = [1e-3 * flown.coordinate(name) for name in ("sight_x", "sight_y")]
    poses, time_s = flown.poses, flown.values("time_s")
    options: dict[str, Any] = {
        "refractive_index": float(attributes["refractive_index"]),
        "group_index": float(attributes["group_index"]),
        "errors": plan.errors,
        "forward": _forward(poses.origin, time_s),
        "time_s": time_s,
    }
    points = positions(echoes, poses, *angles, **options)
    measured = points if infrared is None else _joined(points, infrared)
    if np.any(measured["kind"].values == PointClass.SURFACE):
        width = float(attributes.get("divergence_mrad", 1.0)) * 1e-3 * float(np.mean(poses.origin[:, 2]))
        surface = fit_surface(measured, mean_slope(attributes, width), plan.surface_radius)
        points = positions(echoes, poses, *angles, surface=surface, **options)
    shot = points["shot"].values
    points["scan_angle_deg"] = ("point", flown.values("scan_angle_deg")[shot])
    points["line"] = ("point", flown.values("line")[shot])
    by_infrared = flown.values("infrared_surface") if plan.infrared else np.zeros(len(time_s), dtype=bool)
    points = points.assign(_quality(points, echoes, by_infrared)).assign(_of_light(flown, points, echoes))
    points.attrs["merged_below_m"] = float(attributes["merged_below_m"])
    points = label(points.assign(_truth(flown, plan, points)), "points")
    return points if infrared is None else _joined(points, infrared)


def _joined(points: xr.Dataset, infrared: xr.Dataset) -> xr.Dataset:
    """Return the points of both channels, with their ``transmitter``."""
    both = [
        one.assign(transmitter=("point", np.full(one.sizes["point"], number), described("transmitter")))
        for number, one in enumerate((points, infrared))
    ]
    names = [name for name in both[0] if name in both[1]]
    return xr.concat([one[names] for one in both], "point", combine_attrs="override")


def read_points(path: Path) -> xr.Dataset:
    """Return a flight's points in a folder or store, or a LAS or LAZ file's.

    A store's points are as from `points_of`. Those of a file have ``x``, ``y``, ``z`` [m], ``kind`` and, if the file
    has it, ``vertical_uncertainty`` [m].

    Raises UserError if nothing of these is there, or it has no points.
    """
    if path.is_dir():
        flown = Flown.of(Store(path / "flight.zarr" if (path / "flight.zarr").is_dir() else path))
        points = points_of(flown, flown.store.renderer().plan)
    else:
        points = read_las(path)
    if not points.sizes["point"]:
        raise UserError(f"{path} has no points")
    return points


def _quality(points: xr.Dataset, echoes: xr.Dataset, infrared: npt.NDArray[np.bool_]) -> dict[str, Any]:
    """Return the quality of points, and whether they are withheld from maps.

    Pulses in `infrared` have their surface from the infrared channel.
    """
    place = points["shot"].values, points["pixel"].values
    flags, kind = points["flags"].values, points["kind"].values
    silent = kind == PointClass.NO_ECHO

    def of_echo(name: str) -> npt.NDArray[Any]:
        values = echoes[name].transpose("shot", "pixel", "echo").sel(echo=list(ECHOES)).values
        return np.where(silent, np.zeros((), values.dtype), values[(*place, points["echo"].values)])

    clipped = (flags & int(EchoFlag.SATURATED)) > 0
    of_surface = echoes["flags"].sel(echo="surface").transpose("shot", "pixel").values[place]
    poor = ((flags & int(EchoFlag.POOR_FIT)) > 0) & ~silent
    quality = np.where(clipped | ((of_surface & int(EchoFlag.SATURATED)) > 0), int(Quality.SATURATED), 0)
    quality |= np.where(poor, int(Quality.POOR_FIT), 0)
    wet = ~silent & ~np.isin(kind, [*IN_AIR.values()])
    quality |= np.where(infrared[place[0]] & wet, int(Quality.INFRARED), 0)
    quality |= np.where(kind == PointClass.UNCLASSIFIED, int(Quality.ABOVE_WATER), 0)
    if "class" in echoes:
        quality |= np.where(of_echo("class") == EchoClass.MERGED, int(Quality.MERGED), 0)
        chance = _with_few_events(echoes["class_probability"].transpose("shot", "pixel").values[place], flags)
        quality |= np.where(~silent & (chance < _CERTAIN), int(Quality.UNCERTAIN), 0)
    if "beyond_table" in echoes:
        behind = (kind == PointClass.BOTTOM) | (kind == PointClass.OBJECT)
        corrected = behind & np.isfinite(of_echo("depth_correction_m"))
        quality |= np.where(corrected, int(Quality.CORRECTED), 0)
        quality |= np.where(behind & of_echo("beyond_table"), int(Quality.BEYOND_TABLE), 0)
    return {
        "quality": ("point", quality.astype(np.uint8), flagged(Quality)),
        "withheld": ("point", ~silent & (clipped | poor)),
    }


def _of_light(flown: Flown, points: xr.Dataset, echoes: xr.Dataset) -> dict[str, Any]:
    """Return what the points' light states: reflectance, column optical depth above them, and probability.

    The pseudo-reflectance is pi R^2 E / (E_0 eta A), with the echo energy E on the detector. It solves the lidar
    equation for a Lambertian plane across the beam in air, at the point's distance along the path.
    """
    attributes, kind = flown.attributes, points["kind"].values
    place = points["shot"].values, points["pixel"].values
    silent = kind == PointClass.NO_ECHO
    energy, depth, attenuation, chance = (
        echoes[name].sel(echo=list(ECHOES)).transpose("shot", "pixel", "echo").values[(*place, points["echo"].values)]
        if "echo" in echoes[name].dims
        else echoes[name].transpose("shot", "pixel").values[place]
        for name in ("energy", "depth_m", "attenuation", "class_probability")
    )
    index = float(attributes["refractive_index"])
    path = depth / cos_in_water(flown.values("axis_z")[place[0]], index)
    wet = (kind == PointClass.BOTTOM) | (kind == PointClass.OBJECT)
    apart = np.stack([points[name].values for name in "xyz"], axis=1) - flown.poses.origin[place[0]]
    system = lidar_system(attributes)
    share = np.nan_to_num(flown.coordinate("beam_share"), nan=1.0)[place[1]]
    sensitivity = flown.values("sensitivity")[place]
    sent = share * system.energy * system.aperture_area * np.where(sensitivity > 0, sensitivity, np.nan)
    reflectance = np.pi * np.sum(apart**2, axis=1) * energy / sent
    return {
        "pseudo_reflectance": ("point", np.where(silent, np.nan, reflectance)),
        "optical_depth": ("point", np.where(wet, attenuation * path, np.nan)),
        "class_probability": ("point", np.where(silent, np.nan, _with_few_events(chance, points["flags"].values))),
    }


def _with_few_events(chance: npt.NDArray[Any], flags: npt.NDArray[Any]) -> npt.NDArray[Any]:
    """Return probabilities of points, at most one half where they may be single events of the detector."""
    few = (flags & int(EchoFlag.FEW_EVENTS)) > 0
    return np.where(few, np.minimum(chance, FEW_EVENTS_CHANCE), chance)


def describe_points(points: xr.Dataset) -> list[str]:
    """Return table lines for points by class: numbers, and height errors against the truth [cm]."""
    if "transmitter" in points:
        green, infrared = (points.isel(point=points["transmitter"].values == one) for one in (0, 1))
        names = [name for name in points if name != "transmitter"]
        return [*describe_points(green[names]), "", "Infrared channel", *describe_points(infrared[names])]
    columns = [("class", "<22"), ("points", ">9"), *((name, ">8.1f") for name in ("bias", "spread", "rms", "stated"))]
    error = points["z"].values - points["true_z"].values
    stated = points["vertical_uncertainty"].values
    target = points["true_target"].values.astype(bool)
    kind = points["kind"].values
    withheld = points["withheld"].values.astype(bool)
    good = ~withheld
    merged = (points["quality"].values & int(Quality.MERGED)) > 0
    classes = {
        "land": (kind == PointClass.GROUND) & good,
        "above the water": (kind == PointClass.UNCLASSIFIED) & good,
        "water surface": (kind == PointClass.SURFACE) & good,
        "bottom": (kind == PointClass.BOTTOM) & ~target & ~merged & good,
        "bottom, merged": (kind == PointClass.BOTTOM) & ~target & merged & good,
        "bottom, above a target": (kind == PointClass.BOTTOM) & target & good,
        "object": (kind == PointClass.OBJECT) & good,
        "withheld": withheld,
        "no echo": kind == PointClass.NO_ECHO,
    }
    classes = {name: chosen for name, chosen in classes.items() if name not in _IF_ANY or chosen.any()}
    rows: list[list[Any]] = []
    for name, chosen in classes.items():
        own = chosen & np.isfinite(error)
        rows.append([name, np.count_nonzero(chosen)])
        if np.any(own) and name != "no echo":
            values = error[own]
            numbers = (values.mean(), values.std(), np.sqrt(np.mean(values**2)), np.median(stated[own]))
            rows[-1] += [100 * number for number in numbers]
            rows[-1] += [np.sqrt(np.mean((values / stated[own]) ** 2)), np.mean(np.abs(values) > 0.5)]
    return table_lines([*columns, ("z", ">7.2f"), ("> 0.5 m", ">9.2%")], rows) + _describe_pulses(points)


def _describe_pulses(points: xr.Dataset) -> list[str]:
    """Return lines on what the waveforms over land are, if any, and how many over water have a bottom."""
    kind, height = points["kind"].values, -points["true_bottom_depth"].values
    waveform, first = np.unique(np.stack([points["shot"], points["pixel"]]), axis=1, return_index=True)
    del waveform
    dry = height > 0
    if not dry.any():
        return []
    number = np.cumsum(np.isin(np.arange(len(kind)), first)) - 1
    lines = []
    for name, own in (("land", dry), ("water", ~dry)):
        found = {
            one.text: len(np.unique(number[own & (kind == one)])) for one in PointClass if np.any(own & (kind == one))
        }
        listed = ", ".join(f"{text} {count}" for text, count in found.items())
        lines.append(f"{len(np.unique(number[own]))} waveforms over {name}: {listed or 'none'}")
    if "merged_below_m" in points.attrs:
        lines.append(f"surface and bottom merge in water of less than {points.attrs['merged_below_m']:.2f} m")
    return lines


@alone
def _truth(flown: Flown, plan: FlightPlan, points: xr.Dataset) -> dict[str, Any]:
    """Return the truth about points: sea height in the beam or highest solid there, and pulse height."""
    from mitransient_lidar.loading.scenes import open_scene
    from mitransient_lidar.rendering.shots.truth import solids_below
    from mitransient_lidar.transport.scene_parts import find_lidar_scene

    session = open_scene(flown.store.renderer().scene, dict(plan.parameters))
    lidar = find_lidar_scene(session.scene, session.sensor)
    height, target = solids_below(lidar, points["x"].values, points["y"].values)
    shot, dry = points["shot"].values, points["kind"].values == PointClass.SURFACE
    known = {name: flown.values(name)[shot] for name in _TRUTH}
    true_z = np.where(dry, known["true_surface_height"], height)
    found: dict[str, Any] = {
        "true_z": ("point", true_z),
        "true_target": ("point", target & ~dry),
    }
    return found | {name: ("point", values, dict(flown.store.array(name).attrs)) for name, values in known.items()}


def write_files(flown: Flown, plan: FlightPlan, points: xr.Dataset, folder: Path) -> list[Path]:
    """Write points.laz, waveforms.las and waveforms.wdp of all pulses; return their paths."""
    placed = points.copy()
    for name, first in zip("xyz", plan.origin, strict=True):
        placed[name] = placed[name] + first
    placed["kind"].attrs["object_class"] = plan.object_class
    placed = with_channels(placed, len(flown.coordinate("pixel")))
    placed["gps_time"].attrs["time_system"] = plan.time_system(flown.values("time_s"))
    # The amplitude of a clipped echo is what its flanks make of it.
    clear = (placed["quality"].values & int(Quality.SATURATED)) == 0
    brightest = float(np.nanmax(placed["intensity"].values, initial=0.0, where=clear))
    placed["intensity"].attrs["full_scale"] = brightest or 1.0
    paths = [folder / "points.laz", folder / "waveforms.las", folder / "waveforms.wdp"]
    write_points(paths[0], placed, plan.crs)
    green = placed.isel(point=placed["transmitter"].values == 0) if "transmitter" in placed else placed
    write_waveforms(paths[1], _with_packets(flown, green), _packets(flown), plan.crs)
    return paths


def with_channels(points: xr.Dataset, pixels: int) -> xr.Dataset:
    """Return points with the scanner channels and return numbers of LAS.

    Up to four pixels are the channels. More form four groups of neighbours; their returns from a pulse are numbered
    together, highest first. Those after the fifteenth have its number.
    """
    pixel, shot = points["pixel"].values, points["shot"].values
    if pixels <= MOST_CHANNELS:
        return points.assign(channel=("point", pixel))
    if "transmitter" in points:
        shot = shot + 2**32 * points["transmitter"].values
    channel = pixel * MOST_CHANNELS // pixels
    order = np.lexsort((-points["z"].values, channel, shot))
    found = {"channel": channel}
    for name, values in zip(
        ("return_number", "number_of_returns"), numbered_returns(shot[order], channel[order]), strict=True
    ):
        found[name] = np.empty(shot.size, dtype=np.int64)
        found[name][order] = np.minimum(values, MOST_RETURNS)
    return points.assign({name: ("point", values) for name, values in found.items()})


def _chunks(flown: Flown) -> Iterator[slice]:
    """Return the pulses of each chunk."""
    for first in range(0, len(flown.rows), _CHUNK):
        yield slice(first, min(first + _CHUNK, len(flown.rows)))


def _packets(flown: Flown) -> Iterator[xr.Dataset]:
    """Return each chunk's pulse samples, one packet a pixel."""
    signal = flown.values("signal")
    low, high = float(np.nanmin(signal)), float(np.nanmax(signal))
    width = float(flown.store.attributes["bin_width_ns"])
    about = {"gain": max(high - low, 1e-12) / _COUNTS, "offset": low, "sampling_ns": width}
    for chunk in _chunks(flown):
        samples = signal[chunk].reshape(-1, signal.shape[-1])
        yield xr.Dataset({"waveform": (("packet", "sample"), samples, about)})


def _with_packets(flown: Flown, points: xr.Dataset) -> Iterator[xr.Dataset]:
    """Return each chunk's points, with their packets, times in them, and light directions."""
    attributes, echoes = flown.attributes, echoes_of(flown)
    width = float(flown.store.attributes["bin_width_ns"])
    time = echoes["time_ns"].transpose("shot", "pixel", "echo").values
    surface = echoes["surface_time_ns"].transpose("shot", "pixel").values
    shot, pixel, kind = (points[name].values for name in ("shot", "pixel", "kind"))
    names = [str(name) for name in flown.coordinate("echo")]
    arrival = np.array(surface[shot, pixel])
    echo = points["echo"].values
    places = np.array([names.index(name) for name in ECHOES])
    found = time[shot, pixel, places[echo]]
    arrival = np.where((echo >= 0) & np.isfinite(found), found, arrival)
    start = flown.values("sample_start_ns")[shot] + 0.5 * width
    wet = (kind == PointClass.BOTTOM) | (kind == PointClass.OBJECT)
    within = np.nan_to_num(arrival - start, nan=0.0)
    direction = _directions(flown, shot, pixel)
    index = float(attributes["refractive_index"])
    bent = direction / index
    bent[:, 2] = -np.sqrt(1 - np.sum(bent[:, :2] ** 2, axis=1))
    pixels = len(flown.coordinate("pixel"))
    extra = {
        "time_in_packet_ns": ("point", within),
        "direction": (("point", "axis"), np.where(wet[:, None], bent, direction)),
        "group_speed": ("point", np.where(wet, C0 / float(attributes["group_index"]), C0)),
    }
    whole = points.assign(extra)
    bounds = np.searchsorted(shot, [chunk.start for chunk in _chunks(flown)] + [len(flown.rows)])
    for chunk, first, last in zip(_chunks(flown), bounds[:-1], bounds[1:], strict=True):
        part = whole.isel(point=slice(int(first), int(last)))
        packet = (part["shot"].values - chunk.start) * pixels + part["pixel"].values
        yield part.assign(packet=("point", packet))


def _directions(flown: Flown, shot: IntArray, pixel: IntArray) -> FloatArray:
    """Return the points' unit lines of sight, shape (points, 3)."""
    angles = [1e-3 * flown.coordinate(name)[pixel] for name in ("sight_x", "sight_y")]
    return flown.poses.part(shot).directions(np.stack(angles, axis=1))


def _forward(origin: FloatArray, time_s: FloatArray) -> FloatArray:
    """Return the horizontal direction of flight at each pulse, +x where the platform rests, shape (shots, 3)."""
    if len(origin) < 2:
        return np.array([[1.0, 0.0, 0.0]] * len(origin))
    velocity = np.gradient(origin, time_s, axis=0)
    velocity[:, 2] = 0.0
    still = np.linalg.norm(velocity, axis=1) < 1e-6
    velocity[still] = [1.0, 0.0, 0.0]
    return np.asarray(velocity)
