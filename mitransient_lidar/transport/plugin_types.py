"""Protocols that the transport needs from plugins, which lie in a layer above it."""

from __future__ import annotations

from collections.abc import Sequence
from typing import Any, Protocol, runtime_checkable

import mitsuba as mi

from mitransient_lidar.core.validation import BoolArray, FloatArray
from mitransient_lidar.physics.lidar.gate_train import GatePlan
from mitransient_lidar.physics.lidar.pulse import Pulse
from mitransient_lidar.physics.lidar.time_axis import TimeAxis
from mitransient_lidar.physics.sea import sea_surface
from mitransient_lidar.physics.sea.height_maps import HeightMap
from mitransient_lidar.physics.sea.resolution import Footprint
from mitransient_lidar.physics.sea.shoaling import BottomDepths
from mitransient_lidar.transport.laser import BeamProfile
from mitransient_lidar.transport.medium.water import Water
from mitransient_lidar.transport.pose import KernelPose
from mitransient_lidar.transport.sensor.receiver import Receiver


@runtime_checkable
class OwnPlugin(Protocol):
    """Any plugin in this package, with its name as ``type`` and its parameter values."""

    parameters: dict[str, Any]


@runtime_checkable
class Transmitter(Protocol):
    """The emitter ``lidar_transmitter``: energies [J], rms angles of the beam [rad]."""

    pose: KernelPose
    parameters: dict[str, Any]
    wavelength_nm: float
    pulse_energy: float
    optical_efficiency: float
    energy: float
    pulse: Pulse
    beam_profile: str
    profile: BeamProfile
    divergence: float
    angular_spread: float
    widest_angular_spread: float

    def intensity_at(self, angle_x: mi.Float, angle_y: mi.Float, cos_axis: mi.Float) -> mi.Float:
        """Return the radiant intensity [J/sr] at a tangent-plane point whose direction has a cosine with the axis."""

    def tangent_density(self, angle_x: mi.Float, angle_y: mi.Float) -> mi.Float:
        """Return the share of the energy per tangent-plane area [1/rad^2]."""

    def sample_tangent(self, u: mi.Point2f) -> tuple[mi.Float, mi.Float]:
        """Map uniform numbers in the unit square to tangent-plane points distributed as the beam's energy."""


@runtime_checkable
class Daylight(Protocol):
    """The emitters ``sun`` and ``sky``."""

    daylight: str


class SunEmitter(Daylight, Protocol):
    """The emitter ``sun``: unit direction to it, irradiance on a plane normal to its rays [W m^-2 nm^-1]."""

    zenith_deg: float
    direction: FloatArray
    irradiance: float
    sampled_irradiance: float

    def radiance(self, direction: mi.Vector3f) -> mi.Float:
        """Return the radiance in a direction [W m^-2 sr^-1 nm^-1]."""

    def sample(self, u: mi.Point2f) -> mi.Vector3f:
        """Map uniform numbers to directions within the disc."""


class SkyEmitter(Daylight, Protocol):
    """The emitter ``sky``: unit direction to the sun of a clear one, irradiance [W m^-2 nm^-1]."""

    distribution: str
    sun: FloatArray
    irradiance: float

    def radiance(self, direction: mi.Vector3f) -> mi.Float:
        """Return the radiance in a direction [W m^-2 sr^-1 nm^-1]."""


@runtime_checkable
class LidarSensor(Protocol):
    """The sensors ``multipixel_receiver`` and ``pixel_fov``."""

    receiver: Receiver


@runtime_checkable
class WaterMedium(Protocol):
    """The medium ``layered_water``."""

    water: Water


@runtime_checkable
class SeaShape(Protocol):
    """The shape ``ocean_surface``."""

    sea: sea_surface.SeaSurface
    has_ripples: bool
    footprints: Sequence[Footprint] | None

    @property
    def time_s(self) -> float:
        """Wave time [s]."""

    @property
    def footprint_size(self) -> float:
        """Side of the fine patch [m], without an automatic margin for scattered light."""

    def fit(self, footprints: Sequence[Footprint], depths: BottomDepths | None = None) -> bool:
        """Choose the automatic values for footprints of lasers and receivers; return whether the mesh has changed.

        Waves may follow bottom depths.
        """

    def rippled(self, refractive_index: float) -> mi.BSDF:
        """Return the BSDF of a level sea, all of whose slopes are ripples."""

    def scaled_ripples(self, refractive_index: float, factor: float) -> mi.BSDF:
        """Return the ripple BSDF with the sea's ripple slope variances times a factor."""


@runtime_checkable
class SeabedShape(Protocol):
    """The shape ``seabed``."""

    @property
    def uniform_reflectance(self) -> float | None:
        """Reflectance of bottom and patches, None where they differ."""

    @property
    def height_map(self) -> HeightMap | None:
        """Bottom height map; None without one."""

    def is_beyond_map(self, x: FloatArray, y: FloatArray) -> BoolArray:
        """Return whether places [m] lie beyond the height map; nowhere without one."""


@runtime_checkable
class OpenShape(Protocol):
    """The shape ``canopy``, whose gaps beam and view share."""

    shares_gaps: bool


@runtime_checkable
class GatedFilm(Protocol):
    """The film ``time_gated_film``; its time bins are None where start or number are chosen for the scene."""

    bin_width_ns: float
    time_start_ns: float | None
    bin_count: int | None
    axis: TimeAxis | None
    gates: GatePlan | None
