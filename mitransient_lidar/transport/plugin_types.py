"""Protocols that the transport needs from plugins, which lie in a layer above it."""

from __future__ import annotations

from collections.abc import Callable, Sequence
from typing import Any, Protocol, runtime_checkable

import mitsuba as mi

from mitransient_lidar.core.validation import BoolArray, FloatArray
from mitransient_lidar.physics.lidar.gate_train import GatePlan
from mitransient_lidar.physics.lidar.pulse import Pulse
from mitransient_lidar.physics.lidar.time_axis import TimeAxis
from mitransient_lidar.physics.sea import sea_surface
from mitransient_lidar.physics.sea.height_maps import HeightMap
from mitransient_lidar.physics.sea.sea_mesh import Footprint
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

    #: Radiant intensity [J/sr] at a tangent-plane point, by the cosine of its direction with the axis.
    intensity_at: Callable[[mi.Float, mi.Float, mi.Float], mi.Float]
    #: Share of the energy per tangent-plane area [1/rad^2] at a point of the tangent plane.
    tangent_density: Callable[[mi.Float, mi.Float], mi.Float]
    #: Map of uniform numbers in the unit square to tangent-plane points distributed as the beam's energy.
    sample_tangent: Callable[[mi.Point2f], tuple[mi.Float, mi.Float]]


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
    #: Radiance in a direction [W m^-2 sr^-1 nm^-1], and map of uniform numbers to directions within the disc.
    radiance: Callable[[mi.Vector3f], mi.Float]
    sample: Callable[[mi.Point2f], mi.Vector3f]


class SkyEmitter(Daylight, Protocol):
    """The emitter ``sky``: unit direction to the sun of a clear one, irradiance [W m^-2 nm^-1]."""

    distribution: str
    sun: FloatArray
    irradiance: float
    radiance: Callable[[mi.Vector3f], mi.Float]  #: Radiance in a direction [W m^-2 sr^-1 nm^-1].


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
    #: Wave time [s], and side of the patch in which rays of beam and view meet the waves [m].
    time_s: float
    met_size: float
    #: As `OceanSurface` documents them.
    fit: Callable[..., bool]
    rippled: Callable[[float], mi.BSDF]
    scaled_ripples: Callable[[float, float], mi.BSDF]


@runtime_checkable
class SeabedShape(Protocol):
    """The shape ``seabed``: reflectance, None where it is not even; height map, or None; places beyond it [m]."""

    uniform_reflectance: float | None
    height_map: HeightMap | None
    is_beyond_map: Callable[[FloatArray, FloatArray], BoolArray]


@runtime_checkable
class GatedFilm(Protocol):
    """The film ``time_gated_film``; its time bins are None where start or number are chosen for the scene."""

    bin_width_ns: float
    time_start_ns: float | None
    bin_count: int | None
    axis: TimeAxis | None
    gates: GatePlan | None
