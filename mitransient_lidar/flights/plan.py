"""Flight plan: platform, scanner, pulses, instrument, scene, and products of the records."""

from __future__ import annotations

import importlib.resources
import json
import os
from collections.abc import Mapping
from dataclasses import dataclass, field, replace
from functools import cached_property
from pathlib import Path
from typing import Annotated, Any

import numpy as np

from mitransient_lidar.analysis.waveforms.echo_table import ESTIMATORS
from mitransient_lidar.core.errors import UserError
from mitransient_lidar.core.files import read_text
from mitransient_lidar.core.formats.documents import parse_toml
from mitransient_lidar.core.maps import MapSystem, map_system
from mitransient_lidar.core.options import Option, Plan, positive_option
from mitransient_lidar.core.validation import FloatArray, shown
from mitransient_lidar.flights.las_header import check_same_system
from mitransient_lidar.flights.poses.mounting import Mounting, PulsePoses, pulse_poses
from mitransient_lidar.flights.poses.platforms import XYZ, Platform, SbetFile, TrajectoryFile, platform_of
from mitransient_lidar.flights.poses.scanner import Scanner
from mitransient_lidar.flights.refracted_paths import PoseErrors
from mitransient_lidar.loading.catalogue import with_infrared
from mitransient_lidar.physics.receiver.receiver_files import Setting
from mitransient_lidar.rendering.passes import LightOption
from mitransient_lidar.results.attributes import PointClass

#: Parameters of the scene that the poses of the pulses replace.
POSE_PARAMETERS = ("aim_x", "aim_y", "altitude", "off_nadir_deg")

MOST_PULSES = 1_000_000  #: Most pulses of a flight.

#: Classes of echoes between surface and bottom: objects, vegetation of the draft of the second bathymetric profile of
#: LAS (46), and vegetation as NOAA marked it before (64).
OBJECT_CLASSES = (int(PointClass.OBJECT), 46, 64)

SAME_PLACE_M = 1e-3  #: Largest difference of coordinates of one place [m], that of the rounding in files.


@dataclass(frozen=True)
class Pulses(Plan):
    """Pulses of a flight."""

    rate_hz: Annotated[float, positive_option("Pulse repetition rate", "Hz")]
    most: Annotated[int, Option("Number of pulses after which the flight ends", 1, MOST_PULSES)] = MOST_PULSES
    every: Annotated[int, Option("Number of the pulses of which one is rendered", 1, 10**9)] = 1


@dataclass(frozen=True)
class InfraredLines(Plan):
    """Pulses of an infrared channel with its own scanner."""

    scanner: Annotated[Mapping[str, Any], Option("Scanner, as of poses.scanner")]
    pulses: Annotated[Pulses, Option("Pulses")]


@dataclass(frozen=True)
class FlightReceiver(Plan):
    """Flight receiver, as for `analysis.receiver.detect_waveforms`; None for the instrument's."""

    chain: Annotated[str | None, Option("Name of a receiver, or a TOML file", form="a name or a path")] = None
    gain: Annotated[Setting | None, Option("Factor of the gain; auto is chosen once for the flight", 0, above=True)] = (
        None
    )
    optical_density: Annotated[
        Setting | None, Option("That of a filter; auto is chosen once for the flight", 0, 12)
    ] = None
    background_power_w: Annotated[float, Option("Power of the daylight on each pixel", 0, unit="W")] = 0.0

    def __post_init__(self) -> None:
        super().__post_init__()
        if self.gain == self.optical_density == "auto":
            raise UserError("gain = 'auto' and optical_density = 'auto' are alternatives: give one of them")


@dataclass(frozen=True, kw_only=True)
class FlightPlan(Plan):
    """A flight, as its file describes it; `folder` is that from which its relative paths count.

    `text` is the plan as JSON, from which `from_json` returns it.
    """

    scene: Annotated[str, Option("Scene, whose lidar takes the poses of the pulses")]
    instrument: Annotated[str | None, Option("Instrument instead of the scene's lidar")] = None
    infrared: Annotated[
        bool, Option("Whether the infrared channel of the instrument sends a pulse with each green one")
    ] = False
    infrared_lines: Annotated[
        InfraredLines | None, Option("Scanner and pulses of the infrared channel, if it has lines of its own")
    ] = None
    parameters: Annotated[Mapping[str, Any], Option("Parameters of the scene, but those of the pose")] = field(
        default_factory=dict
    )
    platform: Annotated[Mapping[str, Any], Option("Platform, as of poses.platforms")]
    scanner: Annotated[Mapping[str, Any], Option("Scanner, as of poses.scanner")]
    mounting: Annotated[Mounting, Option("Place of the scanner on the platform")] = field(default_factory=Mounting)
    pulses: Annotated[Pulses, Option("Pulses")]
    receiver: Annotated[FlightReceiver, Option("Receiver")] = field(default_factory=FlightReceiver)
    errors: Annotated[PoseErrors, Option("Standard deviations of poses")] = field(default_factory=PoseErrors)
    estimator: Annotated[str, Option("Estimator of echo_table.extract", form="|".join(ESTIMATORS))] = "gaussian"
    corrections: Annotated[
        str, Option("none, auto or a file, as of depth_correction.corrections_for", form="a name or a path")
    ] = "none"
    surface_radius: Annotated[
        float, Option("Radius of planes through surface points, 0 for a level sea", 0, unit="m")
    ] = 2.0
    target_error: Annotated[
        float, positive_option("Relative standard error of the median bin of the shots of a batch")
    ] = 0.1
    light: LightOption = "merging"
    max_time: Annotated[
        float | None,
        positive_option("Longest time for the passes of a batch; shots that it ends have other bits elsewhere", "s"),
    ] = None
    object_class: Annotated[
        int,
        Option("LAS class of echoes between surface and bottom: 43 objects, 46 or 64 submerged vegetation", 0, 255),
    ] = PointClass.OBJECT
    seed: Annotated[int, Option("Seed of renders and of the receiver's noise", 0, 2**31)] = 1
    still_sea: Annotated[bool, Option("Whether the waves do not move")] = False
    crs: Annotated[str | None, Option("Coordinate system of the points, such as EPSG:32633")] = None
    origin: Annotated[
        tuple[float, float, float], Option("Its coordinates of the scene's origin", unit="m", form=XYZ)
    ] = (0.0, 0.0, 0.0)
    folder: Path = Path()
    text: str = ""

    def __post_init__(self) -> None:
        super().__post_init__()
        if self.object_class not in OBJECT_CLASSES:
            allowed = ", ".join(map(str, OBJECT_CLASSES))
            raise UserError(f"object_class = {self.object_class} must be one of {allowed}")
        if self.infrared and self.infrared_lines is not None:
            raise UserError("infrared = true and [infrared_lines] are alternatives: give one of them")
        if self.infrared_lines is not None:
            with_infrared(self.instrument, None)
        for name in POSE_PARAMETERS:
            if name in self.parameters:
                raise UserError(
                    f"parameter {name!r} follows from the poses of the pulses: leave it out of [parameters]"
                )

    def of_infrared(self) -> FlightPlan:
        """Return the flight of the infrared channel; raise `UserError` if the instrument has none."""
        _, (channel, parameters) = with_infrared(self.instrument, self.parameters)
        if self.infrared_lines is None:
            return replace(self, instrument=channel, parameters=parameters, receiver=FlightReceiver(), infrared=False)
        given = json.loads(self.text)
        lines = given.pop("infrared_lines")
        own = {key: value for key, value in given.items() if key not in ("receiver", "corrections")}
        own |= {"instrument": channel, "parameters": parameters, **lines}
        return FlightPlan.of_file(own, self.folder)

    @classmethod
    def read(cls, flight: str | os.PathLike[str]) -> FlightPlan:
        """Read a TOML file, or a shipped flight by name; raise `UserError` if it is no flight."""
        path = Path(flight)
        if path.suffix != ".toml" and path.name == str(flight):
            names = flights()
            if str(flight) not in names:
                raise UserError(f"flight {shown(str(flight))} must be a TOML file or one of {', '.join(names)}")
            path = _shipped() / f"{flight}.toml"
        return cls.of_file(parse_toml(read_text(path), path), path.resolve().parent)

    @classmethod
    def of_file(cls, given: Mapping[str, Any], folder: Path | None = None) -> FlightPlan:
        """Check a flight, a dict with its file's contents; raise `UserError` if it is invalid."""
        folder = Path.cwd() if folder is None else folder
        receiver = given.get("receiver", {})
        if isinstance(receiver, Mapping) and "chain" in receiver:
            receiver = {**receiver, "chain": _path(receiver["chain"], folder, ".toml")}
        try:
            text = json.dumps({**given, "receiver": receiver})
        except (TypeError, ValueError):
            raise UserError("the flight must hold numbers, texts, lists and tables only") from None
        paths = {
            name: _path(given[name], folder, suffix)
            for name, suffix in (("scene", ".xml"), ("corrections", ".nc"))
            if name in given
        }
        values = {**given, **paths} | ({"receiver": receiver} if "receiver" in given else {})
        return cls.of(values, "a flight", folder=folder, text=text)

    def lit_by(self, light: str | None) -> FlightPlan:
        """Return the flight with another `light`; itself if None."""
        return self if light is None else FlightPlan.of_file({**json.loads(self.text), "light": light}, self.folder)

    @classmethod
    def from_json(cls, text: str) -> FlightPlan:
        """Return the flight of a `text`."""
        return cls.of_file(json.loads(text))

    def poses(self) -> PulsePoses:
        """Return the lines of sight of all rendered pulses, in the scene frame.

        Raises `UserError` for a platform, a scanner or a mounting that is invalid, a platform in other coordinates than
        the points, and too many pulses.
        """
        platform = self._platform
        trajectory = platform.trajectory(self.folder)
        self._check_coordinates()
        times = trajectory.pulse_times(self.pulses.rate_hz)[:: self.pulses.every][: self.pulses.most]
        if times.size > MOST_PULSES:
            raise UserError(
                f"the flight has {times.size} pulses: at most {MOST_PULSES} may be; set most or every in [pulses]"
            )
        platform.time_system(times)
        return pulse_poses(trajectory, self.mounting, Scanner.of_table(self.scanner), times)

    def time_system(self, times: FloatArray) -> str:
        """Return the time system of the pulses, as from `records.time_system`."""
        return self._platform.time_system(times)

    @cached_property
    def _platform(self) -> Platform:
        """The platform."""
        return platform_of(self.platform)

    @property
    def stated_origin(self) -> tuple[float, float] | None:
        """Map coordinates x, y [m] of the scene's origin; None where neither crs, origin nor platform has them."""
        if self.crs is not None or "origin" in json.loads(self.text):
            return self.origin[:2]
        own = getattr(self._platform, "origin", None)
        return None if own is None else own[:2]

    @property
    def system(self) -> MapSystem | None:
        """Coordinate system of points and positions; None if none is stated."""
        code = self.crs or getattr(self._platform, "epsg", None)
        return None if code is None else map_system("crs", code)

    def _check_coordinates(self) -> None:
        """Raise `UserError` if platform and points have different coordinates."""
        platform, wanted = self._platform, self.stated_origin
        if self.crs is not None and isinstance(platform, SbetFile):
            check_same_system(self.crs, platform.epsg)
        if not isinstance(platform, TrajectoryFile) or platform.origin is None or wanted is None:
            return
        if np.abs(np.subtract(platform.origin[:2], wanted)).max() > SAME_PLACE_M:
            raise UserError(
                f"origin = {shown(list(platform.origin))} of the platform must have the x and y of that of the flight, "
                f"{shown(list(self.origin))}: both are the place of the scene's origin on the map"
            )


def flights() -> list[str]:
    """Return the names of the shipped flights."""
    return sorted(path.stem for path in _shipped().glob("*.toml"))


def _shipped() -> Path:
    """Return the folder of the shipped flights."""
    return Path(str(importlib.resources.files("mitransient_lidar.scenes"))) / "flights"


def _path(name: Any, folder: Path, suffix: str) -> Any:
    """Return a name, or where a relative path leads from the folder."""
    return str(folder / name) if isinstance(name, str) and name.endswith(suffix) else name
