"""Receivers from TOML files: a chain for each channel, with its gain and filter, or a camera."""

from __future__ import annotations

import importlib.resources
import inspect
import logging
import os
from collections.abc import Callable, Mapping
from dataclasses import dataclass, field, is_dataclass, replace
from pathlib import Path
from types import MappingProxyType
from typing import Annotated, Any, Literal

from mitransient_lidar.core.errors import UserError
from mitransient_lidar.core.files import read_text
from mitransient_lidar.core.formats.documents import check_keys, parse_toml, required
from mitransient_lidar.core.options import Option, Plan, one_of, positive_option
from mitransient_lidar.core.parameters.fields import is_green
from mitransient_lidar.core.tables.headings import Column
from mitransient_lidar.core.tables.text_tables import read_time_samples
from mitransient_lidar.core.validation import shown
from mitransient_lidar.physics.receiver.camera import Camera
from mitransient_lidar.physics.receiver.chain import ReceiverChain
from mitransient_lidar.physics.receiver.detectors import LinearDetector, SiliconPhotomultiplier, SinglePhotonDetector
from mitransient_lidar.physics.receiver.electronics import Amplifier, Digitiser, LogAmplifier
from mitransient_lidar.physics.receiver.shot_jitter import ShotJitter

_LOG = logging.getLogger(__name__)

Setting = float | Literal["auto"]

#: Detectors by their names in files.
_DETECTORS: dict[str, Callable[..., Any]] = {
    "photodiode": LinearDetector,
    "avalanche_photodiode": LinearDetector.avalanche,
    "photomultiplier": LinearDetector.photomultiplier,
    "silicon_photomultiplier": SiliconPhotomultiplier,
    "photon_counter": SinglePhotonDetector,
}
_STAGES: dict[str, Callable[..., Any]] = {
    "amplifier": Amplifier,
    "logarithm": LogAmplifier,
    "digitiser": Digitiser,
    "jitter": ShotJitter,
}
#: Names for impulse response samples.
_RESPONSE = Column(
    "impulse_response", ("response", "signal", "amplitude", "power", "v", "mv", "volt", "voltage", "counts")
)


@dataclass(frozen=True, kw_only=True)
class ChannelTable(Plan):
    """Tables and numbers for a channel in a file; table keys are the stages' parameters."""

    detector: Annotated[Mapping[str, Any], Option(f"Detector, with type: {', '.join(_DETECTORS)}")] = field(
        default_factory=dict
    )
    amplifier: Annotated[Mapping[str, Any], Option("Amplifier; its impulse_response may name a file")] = field(
        default_factory=dict
    )
    logarithm: Annotated[Mapping[str, Any], Option("Logarithmic compression")] = field(default_factory=dict)
    digitiser: Annotated[Mapping[str, Any], Option("Converter")] = field(default_factory=dict)
    gain: Annotated[Setting | None, Option("Factor of the gain")] = None
    optical_density: Annotated[Setting | None, Option("Optical density of a filter")] = None


@dataclass(frozen=True, kw_only=True)
class ReceiverFile(ChannelTable):
    """A receiver file; `channels` contain the differences of single channels, by pixel name."""

    preset: Annotated[str | None, Option("Receiver whose stages count where the file has no others")] = None
    jitter: Annotated[Mapping[str, Any], Option("Shot energy and time")] = field(default_factory=dict)
    wavelength_nm: Annotated[float | None, positive_option("Vacuum wavelength of the light", "nm")] = None
    pulse_repetition_khz: Annotated[float | None, positive_option("Pulse repetition rate", "kHz")] = None
    source: Annotated[str | None, Option("Source of the numbers", form="a text")] = None
    channels: Annotated[Mapping[str, Any], Option("Channels with own detectors, electronics or settings")] = field(
        default_factory=dict
    )


@dataclass(frozen=True, kw_only=True)
class CameraFile(Plan):
    """A camera file, with the `Camera` parameters in its table."""

    camera: Annotated[Mapping[str, Any], Option("Camera")] = field(default_factory=dict)
    preset: Annotated[str | None, Option("Camera whose parameters count where the file has no others")] = None
    wavelength_nm: Annotated[float | None, positive_option("Vacuum wavelength of the light", "nm")] = None
    source: Annotated[str | None, Option("Source of the numbers", form="a text")] = None


@dataclass(frozen=True)
class Channel:
    """One channel's receiver: its chain, gain factor, and filter optical density; see `ReceiverChain`."""

    chain: ReceiverChain
    gain: Setting = 1.0
    optical_density: Setting = 0.0


@dataclass(frozen=True)
class ReceiverChannels:
    """Receivers for all channels.

    Raises UserError if the channels differ in the amplifier response, the logarithm, the converter or the jitter, which
    the record has in common.
    """

    default: Channel  #: Channel for pixels that `channels` does not name.
    channels: Mapping[str, Channel] = field(default_factory=dict)  #: Channels by pixel name.
    pulse_repetition_khz: float | None = None  #: Pulse repetition rate [kHz], or None.
    name: str = "custom"  #: Name of the preset, instrument, or file.

    def __post_init__(self) -> None:
        for name, channel in self.channels.items():
            for stage in ("logarithm", "digitiser", "jitter", "wavelength_nm"):
                if getattr(channel.chain, stage) != getattr(self.default.chain, stage):
                    raise UserError(f"{stage} of channel {name!r} must be that of all channels")
            if _shape(channel.chain.amplifier) != _shape(self.default.chain.amplifier):
                raise UserError(f"amplifier of channel {name!r} must have the response of all channels")

    def with_settings(self, gain: Setting | None, optical_density: Setting | None) -> ReceiverChannels:
        """Return the receiver with another gain or filter in all channels; None keeps them."""
        changed = {"gain": gain, "optical_density": optical_density}
        given: dict[str, Any] = {key: value for key, value in changed.items() if value is not None}
        # A gain that is chosen goes with a filter that is given, and the reverse.
        for setting, other, usual in (("gain", "optical_density", 0.0), ("optical_density", "gain", 1.0)):
            if given.get(setting) == "auto" and other not in given:
                automatic = [one for one in (self.default, *self.channels.values()) if getattr(one, other) == "auto"]
                given |= {other: usual} if automatic else {}
        channels = {name: replace(one, **given) for name, one in self.channels.items()}
        return replace(self, default=replace(self.default, **given), channels=channels)

    def for_light(self, wavelength_nm: float) -> ReceiverChannels:
        """Return the receiver for light at a wavelength [nm]; one for green light counts other photons, too.

        A warning reports that its quantum efficiency is kept.
        """
        if is_green(wavelength_nm) or not is_green(self.default.chain.wavelength_nm):
            return self
        _LOG.warning(
            "the quantum efficiency of receiver %s is that at %g nm, and the light has wavelength_nm = %g: give a "
            "receiver file with both",
            *(self.name, self.default.chain.wavelength_nm, wavelength_nm),
        )
        changed = [replace(one, chain=replace(one.chain, wavelength_nm=wavelength_nm)) for one in self.all_channels]
        return replace(self, default=changed[0], channels=dict(zip(self.channels, changed[1:], strict=True)))

    def with_channel_settings(self, settings: Mapping[int, tuple[Setting, Setting]]) -> ReceiverChannels:
        """Return the receiver with other gains and filters, by the number of the channel in `all_channels`."""
        changed = self.all_channels
        for number, (gain, density) in settings.items():
            changed[number] = replace(changed[number], gain=gain, optical_density=density)
        return replace(self, default=changed[0], channels=dict(zip(self.channels, changed[1:], strict=True)))

    @property
    def all_channels(self) -> list[Channel]:
        """The default channel, and the others in the order of `channels`."""
        return [self.default, *self.channels.values()]

    def of(self, pixel: str) -> Channel:
        """Return a pixel's channel."""
        return self.all_channels[self.number_of(pixel)]

    def number_of(self, pixel: str) -> int:
        """Return the number of a pixel's channel in `all_channels`."""
        return 1 + list(self.channels).index(pixel) if pixel in self.channels else 0


def _shape(amplifier: Amplifier | None) -> tuple[Any, ...] | None:
    """Return the parameters that determine an amplifier's response."""
    if amplifier is None:
        return None
    return amplifier.bandwidth_mhz, amplifier.response, amplifier.impulse_response


def receiver(name: str | os.PathLike[str] | ReceiverChain | ReceiverChannels | Camera) -> ReceiverChannels | Camera:
    """Return a receiver: a preset, a camera or an instrument's receiver by name, or one from a TOML file.

    Raises `UserError` if none has that name, or the file is invalid.
    """
    if isinstance(name, (ReceiverChannels, Camera)):
        return name
    if isinstance(name, ReceiverChain):
        return ReceiverChannels(Channel(name))
    if isinstance(name, str) and name in RECEIVERS:
        return ReceiverChannels(Channel(RECEIVERS[name]), name=name)
    if isinstance(name, str) and name in CAMERAS:
        return CAMERAS[name]
    if isinstance(name, str) and (own := instrument_receiver(name)) is not None:
        return own
    path = Path(name)
    if path.suffix != ".toml":
        known = ", ".join((*RECEIVERS, *CAMERAS))
        raise UserError(f"receiver = {shown(str(name))} must be one of {known}, an instrument, or a .toml file")
    return _parsed(read_text(path), str(path), path.parent)


def waveform_receiver(name: str | os.PathLike[str] | ReceiverChain | ReceiverChannels | Camera) -> ReceiverChannels:
    """Return a receiver of waveforms; raise `UserError` as `receiver` does, and for a camera."""
    if isinstance(found := receiver(name), Camera):
        raise UserError(
            f"receiver = {shown(found.name)} is a camera, which records gates: waveforms need one of "
            f"{', '.join(RECEIVERS)}, an instrument, or a .toml file"
        )
    return found


def camera(name: str | os.PathLike[str] | ReceiverChain | ReceiverChannels | Camera) -> Camera:
    """Return a camera; raise `UserError` as `receiver` does, and for a receiver of waveforms."""
    if not isinstance(found := receiver(name), Camera):
        raise UserError(
            f"receiver = {shown(found.name)} is one of waveforms, but gates need a camera: {', '.join(CAMERAS)}, or a "
            ".toml file with a table [camera]"
        )
    return found


def instrument_receiver(instrument: str) -> ReceiverChannels | None:
    """Return an instrument's receiver by its name; None for an unknown one."""
    folder = Path(str(importlib.resources.files("mitransient_lidar.scenes"))) / "instruments"
    path = folder / f"{instrument}.toml"
    if Path(instrument).name != instrument or not path.is_file():
        return None
    return replace(parse_receiver(read_text(path), path.name, folder), name=instrument)


def parse_receiver(text: str, name: str, folder: Path) -> ReceiverChannels:
    """Return the receiver that a TOML text describes, with the keys of `ReceiverFile`.

    Files that it names are in `folder`.

    Raises UserError if a key is unknown, a parameter is out of range, or the stages do not fit together.
    """
    return waveform_receiver(_parsed(text, name, folder))


def _parsed(text: str, name: str, folder: Path) -> ReceiverChannels | Camera:
    """Return the receiver or the camera that the text of a TOML file describes."""
    given = parse_toml(text, name)
    if "camera" not in given and given.get("preset") not in CAMERAS:
        return _receiver(given, name, folder, RECEIVERS)
    values = CameraFile.of(given, name, f"{name}: ")
    parameters: dict[str, Any] = {}
    if values.preset is not None:
        preset = CAMERAS[one_of(f"{name}: preset", values.preset, CAMERAS)]
        parameters = {key: getattr(preset, key) for key in tuple(Camera.keys())}
    parameters |= {key: value for key in ("wavelength_nm", "source") if (value := getattr(values, key)) is not None}
    found: Camera = _tried(name, lambda: Camera.of(parameters | dict(values.camera), "[camera]", name=name))
    return found


def _receiver(
    given: Mapping[str, Any], name: str, folder: Path, presets: Mapping[str, ReceiverChain]
) -> ReceiverChannels:
    """Return the receiver that a file's tables describe."""
    values = ReceiverFile.of(given, name, f"{name}: ")
    base = None
    if values.preset is not None:
        base = Channel(presets[one_of(f"{name}: preset", values.preset, presets)])
    others: dict[str, Any] = {
        key: value for key in ("wavelength_nm", "source") if (value := getattr(values, key)) is not None
    }
    default = _channel(name, values, base, folder, others)
    channels = {}
    for channel, given in values.channels.items():
        label = f"{name}: channels.{channel}"
        own = ChannelTable.of(given, label, f"{label}: ")
        channels[channel] = _channel(label, own, default, folder, {})
    return ReceiverChannels(default, channels, values.pulse_repetition_khz, name)


def _channel(name: str, values: ChannelTable, base: Channel | None, folder: Path, others: Mapping[str, Any]) -> Channel:
    """Return a channel from a file's tables; `base` supplies the missing stages."""
    stages: dict[str, Any] = dict(others)
    if own := dict(values.detector):
        kind, label = own.pop("type", None), f"{name}: detector"
        if kind is None and base is not None:
            stages["detector"] = _with_dynodes(label, _stage(label, own, base.chain.detector), own)
        else:
            stages["detector"] = _stage(label, own, _DETECTORS[one_of(f"{label}.type", kind, _DETECTORS)])
    elif base is None:
        raise UserError(f"{name} has neither a preset nor a detector")
    for stage, build in _STAGES.items():
        if not (own := dict(getattr(values, stage, {}))):
            continue
        if "impulse_response" in own:
            own["impulse_response"] = _impulse_response(folder, own["impulse_response"])
            own.setdefault("bandwidth_mhz", None)
        former = None if base is None else getattr(base.chain, stage)
        stages[stage] = _stage(f"{name}: {stage}", own, build if former is None else former)
    chain = _tried(name, lambda: ReceiverChain(**stages) if base is None else replace(base.chain, **stages))
    settings = {key: value for key in ("gain", "optical_density") if (value := getattr(values, key)) is not None}
    return Channel(chain, **settings) if base is None else replace(base, chain=chain, **settings)


def _impulse_response(folder: Path, given: Any) -> tuple[tuple[float, ...], tuple[float, ...]]:
    """Return times [ns] and values of a measured response from a file."""
    if not isinstance(given, str):
        raise UserError(f"impulse_response = {shown(given)} must be the name of a file")
    times, values = read_time_samples(folder / given, _RESPONSE)
    return tuple(times.tolist()), tuple(values.tolist())


def _stage(name: str, values: Mapping[str, Any], base: Any) -> Any:
    """Return a stage that a function or class makes from its parameters, or another stage with some of them changed."""
    is_stage = is_dataclass(base) and not isinstance(base, type)
    parameters = inspect.signature(type(base) if is_stage else base).parameters
    check_keys(name, values, parameters)
    for key, one in parameters.items():
        if one.default is one.empty and not is_stage:
            required(name, values, key)
    for key, value in values.items():
        if isinstance(value, dict):
            raise UserError(f"{name}.{key} must be a value, not a table")
    given = {key: tuple(value) if isinstance(value, list) else value for key, value in values.items()}
    return _tried(name, lambda: replace(base, **given) if is_stage else base(**given))


def _with_dynodes(name: str, detector: Any, values: Mapping[str, Any]) -> Any:
    """Return a detector with changed parameters, of which dynodes give a photomultiplier its gain and excess noise."""
    if not getattr(detector, "dynode_gains", ()):
        return detector
    if derived := [key for key in ("gain", "excess_noise") if key in values]:
        raise UserError(f"{name}: {derived[0]} = {shown(values[derived[0]])} follows from dynode_gains: give these")
    return _tried(name, lambda: detector.with_dynodes(detector.dynode_gains))


def _tried(name: str, build: Callable[[], Any]) -> Any:
    """Return a function's result; add the position in the file to an error message."""
    try:
        return build()
    except UserError as error:
        raise UserError(f"{name}: {error}") from None
    except (TypeError, ValueError):
        raise UserError(f"{name} has a parameter of another type than its number or text") from None


def _presets() -> Mapping[str, ReceiverChain]:
    """Return the typical chains for 532 nm."""
    path = Path(__file__).with_name("presets.toml")
    found: dict[str, ReceiverChain] = {}
    for name, given in parse_toml(path.read_text("utf-8"), path).items():
        found[name] = _receiver(given, f"{path.name}: {name}", path.parent, found).default.chain
    return MappingProxyType(found)


def _cameras() -> Mapping[str, Camera]:
    """Return the typical cameras for 532 nm."""
    path = Path(__file__).with_name("cameras.toml")
    tables = parse_toml(path.read_text("utf-8"), path).items()
    return MappingProxyType({name: Camera.of(given, f"{path.name}: {name}", name=name) for name, given in tables})


RECEIVERS = _presets()  #: Typical chains for 532 nm, with their sources.
CAMERAS = _cameras()  #: Typical gated cameras for 532 nm, with their sources.
