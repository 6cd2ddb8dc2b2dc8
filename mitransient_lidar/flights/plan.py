"""Plan of a flight: platform, scanner, pulses, instrument, scene, and what is made of the records."""

from __future__ import annotations

import importlib.resources
import json
import os
from collections.abc import Mapping
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np

from mitransient_lidar.analysis.waveforms.echo_table import ESTIMATORS
from mitransient_lidar.core.coordinate_systems import MapSystem, map_system
from mitransient_lidar.core.errors import UserError
from mitransient_lidar.core.files import read_text
from mitransient_lidar.core.toml_files import check_keys, parse_toml, required, table
from mitransient_lidar.core.validation import FloatArray, finite_array, in_range, integer, non_negative, positive, shown
from mitransient_lidar.flights.las_header import check_same_system
from mitransient_lidar.flights.poses.mounting import Mounting, PulsePoses, pulse_poses
from mitransient_lidar.flights.poses.scanner import Scanner
from mitransient_lidar.flights.poses.times import time_system
from mitransient_lidar.flights.poses.trajectory import Trajectory
from mitransient_lidar.flights.refracted_paths import PoseErrors
from mitransient_lidar.physics.receiver.receiver_files import Setting

#: Parameters of the scene that the poses of the pulses replace.
POSE_PARAMETERS = ("aim_x", "aim_y", "altitude", "off_nadir_deg")

#: Most pulses of a flight.
MOST_PULSES = 1_000_000

#: Largest difference of coordinates of one place [m], that of the rounding in files.
SAME_PLACE_M = 1e-3

#: Keys of a plan, of its table of pulses, and of that of the receiver.
_KEYS = (
    *("scene", "instrument", "parameters", "platform", "scanner", "mounting", "pulses", "receiver", "errors"),
    *("estimator", "corrections", "surface_radius", "target_error", "max_time", "seed", "still_sea", "crs", "origin"),
)
_OF_PULSES = ("rate_hz", "most", "every")
_OF_RECEIVER = ("chain", "gain", "optical_density", "background_power_w")


@dataclass(frozen=True)
class FlightPlan:
    """A flight, as its file describes it.

    Attributes
    ----------
    scene, instrument
        Scene with the parameters ``aim_x``, ``aim_y``, ``altitude`` and ``off_nadir_deg``, which the poses of the
        pulses replace, and instrument, as for `render_shots`.
    parameters
        Further parameters of the scene.
    rate_hz, most, every
        Pulse repetition rate [Hz], number of pulses after which the flight ends, and number of the pulses of which one
        is rendered.
    receiver
        Receiver as of `analysis.receiver.detect_waveforms`, None for that of the instrument; `gain`, `optical_density`
        (numbers or 'auto', which is chosen once for the flight) and `background_power_w` are those of it.
    estimator
        Estimator of `echo_table.extract`.
    corrections
        ``none``, ``auto`` or a file, as of `depth_correction.corrections_for`.
    surface_radius
        Radius of planes through surface points [m], 0 for a level sea.
    target_error
        Relative standard error of the median bin of the shots of a batch.
    max_time
        Longest time for the passes of a batch [s], None for any. Shots that it ends have other bits elsewhere.
    errors
        Standard deviations of poses.
    seed
        Seed of renders and of the receiver's noise.
    still_sea
        Whether the waves do not move.
    crs, origin
        Coordinate system of the points, such as EPSG:32633, and its coordinates x, y, z [m] of the scene's origin.
    folder
        Folder of the file, from which relative paths count.
    text
        The plan as JSON, from which `from_json` returns it.
    """

    scene: str
    instrument: str | None
    parameters: Mapping[str, Any]
    rate_hz: float
    most: int
    every: int
    receiver: str | None
    gain: Setting | None
    optical_density: Setting | None
    background_power_w: float
    estimator: str
    corrections: str
    surface_radius: float
    target_error: float
    max_time: float | None
    errors: PoseErrors
    seed: int
    still_sea: bool
    crs: str | None
    origin: tuple[float, float, float]
    folder: Path
    text: str

    @classmethod
    def read(cls, flight: str | os.PathLike[str]) -> FlightPlan:
        """Read a TOML file, or a shipped flight by name; raise `UserError` if it is no flight."""
        path = Path(flight)
        if path.suffix != ".toml" and path.name == str(flight):
            names = flights()
            if str(flight) not in names:
                raise UserError(f"flight {shown(str(flight))} must be a TOML file or one of {', '.join(names)}")
            path = _shipped() / f"{flight}.toml"
        return cls.of(parse_toml(read_text(path), path), path.resolve().parent)

    @classmethod
    def of(cls, given: Mapping[str, Any], folder: Path | None = None) -> FlightPlan:
        """Check a flight given as a dict of the contents of its file; raise `UserError` if it is invalid."""
        check_keys("a flight", given, _KEYS)
        folder = Path.cwd() if folder is None else folder
        scene, instrument = required("a flight", given, "scene"), given.get("instrument")
        pulses = table("pulses", required("a flight", given, "pulses"))
        check_keys("[pulses]", pulses, _OF_PULSES)
        receiver = dict(table("receiver", given.get("receiver", {})))
        check_keys("[receiver]", receiver, _OF_RECEIVER)
        if "chain" in receiver:
            receiver["chain"] = _path(receiver["chain"], folder, ".toml")
        for name, value in (("scene", scene), ("instrument", instrument or ""), ("crs", given.get("crs", ""))):
            if not isinstance(value, str):
                raise UserError(f"{name} = {shown(value)} must be a name")
        estimator = given.get("estimator", "gaussian")
        if estimator not in ESTIMATORS:
            raise UserError(f"estimator = {shown(estimator)} must be one of {', '.join(ESTIMATORS)}")
        origin = finite_array("origin", given.get("origin", (0.0, 0.0, 0.0)))
        if origin.shape != (3,):
            raise UserError(f"origin = {shown(given['origin'])} must be x, y and z in metres")
        still = given.get("still_sea", False)
        if not isinstance(still, bool):
            raise UserError(f"still_sea = {shown(still)} must be true or false")
        try:
            text = json.dumps({**given, "receiver": receiver})
        except (TypeError, ValueError):
            raise UserError("the flight must hold numbers, texts, lists and tables only") from None
        gain, density = receiver.get("gain"), receiver.get("optical_density")
        if gain == density == "auto":
            raise UserError("gain = 'auto' and optical_density = 'auto' are alternatives: give one of them")
        x, y, z = origin.tolist()
        plan = cls(
            scene=_path(scene, folder, ".xml"),
            instrument=instrument,
            parameters=table("parameters", given.get("parameters", {})),
            rate_hz=positive("rate_hz", required("[pulses]", pulses, "rate_hz")),
            most=integer("most", pulses.get("most", MOST_PULSES), 1, MOST_PULSES),
            every=integer("every", pulses.get("every", 1), 1, 10**9),
            receiver=receiver.get("chain"),
            gain=gain if gain in (None, "auto") else positive("gain", gain),
            optical_density=density if density in (None, "auto") else in_range("optical_density", density, 0, 12),
            background_power_w=non_negative("background_power_w", receiver.get("background_power_w", 0.0)),
            estimator=estimator,
            corrections=_path(given.get("corrections", "none"), folder, ".nc"),
            surface_radius=non_negative("surface_radius", given.get("surface_radius", 2.0)),
            target_error=positive("target_error", given.get("target_error", 0.1)),
            max_time=None if given.get("max_time") is None else positive("max_time", given["max_time"]),
            errors=PoseErrors.of(table("errors", given.get("errors", {}))),
            seed=integer("seed", given.get("seed", 1), 0, 2**31),
            still_sea=still,
            crs=given.get("crs"),
            origin=(x, y, z),
            folder=folder,
            text=text,
        )
        for name in POSE_PARAMETERS:
            if name in plan.parameters:
                raise UserError(
                    f"parameter {name!r} follows from the poses of the pulses: leave it out of [parameters]"
                )
        return plan

    @classmethod
    def from_json(cls, text: str) -> FlightPlan:
        """Return the flight of a `text`."""
        return cls.of(json.loads(text))

    def poses(self) -> PulsePoses:
        """Return the lines of sight of all pulses that are rendered, in the frame of the scene.

        Raises
        ------
        UserError
            For a platform, a scanner or a mounting that is invalid, a platform in other coordinates than the points,
            and too many pulses.
        """
        given = json.loads(self.text)
        platform, scanner = (table(name, required("a flight", given, name)) for name in ("platform", "scanner"))
        trajectory = Trajectory.of(platform, self.folder)
        self._check_coordinates(platform)
        times = trajectory.pulse_times(self.rate_hz)[:: self.every][: self.most]
        if times.size > MOST_PULSES:
            raise UserError(
                f"the flight has {times.size} pulses: at most {MOST_PULSES} may be; set most or every in [pulses]"
            )
        self.time_system(times)
        mounting = Mounting.of(table("mounting", given.get("mounting", {})))
        return pulse_poses(trajectory, mounting, Scanner.of(scanner), times)

    def time_system(self, times: FloatArray) -> str:
        """Return the system of the times [s] of the pulses, as of `times.time_system`."""
        return time_system(json.loads(self.text)["platform"], times)

    @property
    def stated_origin(self) -> tuple[float, float] | None:
        """Map coordinates x, y [m] of the scene's origin; None where neither crs, origin nor platform has them."""
        given = json.loads(self.text)
        if self.crs is not None or "origin" in given:
            return self.origin[:2]
        own = given["platform"].get("origin")
        return None if own is None else (float(own[0]), float(own[1]))

    @property
    def system(self) -> MapSystem | None:
        """Coordinate system of points and positions; None if none is stated."""
        code = self.crs or json.loads(self.text)["platform"].get("epsg")
        return None if code is None else map_system("crs", code)

    def _check_coordinates(self, platform: Mapping[str, Any]) -> None:
        """Raise `UserError` if the coordinates of a platform, which is valid, are not those of the points."""
        if self.crs is not None and platform["kind"] == "sbet":
            check_same_system(self.crs, platform["epsg"])
        own, wanted = platform.get("origin"), self.stated_origin
        if own is None or wanted is None:
            return
        if np.abs(np.subtract(own[:2], wanted)).max() > SAME_PLACE_M:
            raise UserError(
                f"origin = {shown(list(own))} of the platform must have the x and y of that of the flight, "
                f"{shown(list(self.origin))}: both are the place of the scene's origin on the map"
            )


def flights() -> list[str]:
    """Return the names of the shipped flights."""
    return sorted(path.stem for path in _shipped().glob("*.toml"))


def _shipped() -> Path:
    """Return the folder of the shipped flights."""
    return Path(str(importlib.resources.files("mitransient_lidar.scenes"))) / "flights"


def _path(name: Any, folder: Path, suffix: str) -> str:
    """Return a name, or where a relative path leads from the folder."""
    if not isinstance(name, str):
        raise UserError(f"{shown(name)} must be a name or a path")
    return str(folder / name) if name.endswith(suffix) else name
