"""Scene loading, with error messages of one sentence."""

from __future__ import annotations

import contextlib
import logging
import os
import re
from collections.abc import Callable, Iterator, Mapping
from dataclasses import dataclass, replace
from functools import cached_property
from pathlib import Path
from typing import Any, Literal, overload

import mitsuba as mi

from mitransient_lidar.core.errors import UserError, is_interruption, raise_if_out_of_memory
from mitransient_lidar.core.validation import shown
from mitransient_lidar.loading import variants
from mitransient_lidar.loading.catalogue import mount, scene_path
from mitransient_lidar.loading.checks import check, check_dict
from mitransient_lidar.loading.document import DOLLAR, SceneDocument, read_document
from mitransient_lidar.loading.frame import move_to_aim
from mitransient_lidar.loading.parameters import check_params, fill, unknown_parameters, values_of
from mitransient_lidar.loading.scene_source import SceneSource, plugin_values
from mitransient_lidar.loading.variants import alone_with_scene
from mitransient_lidar.physics.lidar.time_axis import TimeAxis
from mitransient_lidar.physics.sea.height_maps import IN_MAP_COORDINATES
from mitransient_lidar.transport.daylight.renderer import DaylightIntegrator
from mitransient_lidar.transport.paths.passes import LidarIntegrator
from mitransient_lidar.transport.scene import LidarScene
from mitransient_lidar.transport.scene_parts import fit_seas, lidar_sensor

logger = logging.getLogger(__name__)


@dataclass(frozen=True)
class LoadedScene:
    """A loaded scene, its name, all XML parameters with their values as text, and the source that loads it again.

    The source is None for a scene from loaded objects. `sensor_id` is the receiver's id, empty for the first one.
    """

    scene: mi.Scene
    name: str
    parameters: dict[str, str]
    source: SceneSource | None = None
    sensor_id: str = ""

    @cached_property
    def sensor(self) -> mi.Sensor:
        """The receiver; raise UserError if the scene has none, or none of that id."""
        return lidar_sensor(self.scene, self.sensor_id or (self.source.sensor if self.source else ""))

    def attributes(
        self,
        lidar: LidarScene | None = None,
        integrator: LidarIntegrator | DaylightIntegrator | None = None,
        used: Mapping[str, float] | None = None,
        **others: Any,
    ) -> dict[str, Any]:
        """Return a result's attributes: scene, versions, integrator, others, and the attributes from `scene_source`.

        ``record_end`` is the source of the last light on a time axis with automatic length. `used` are the values that
        were chosen for automatic integrator parameters.
        """
        again = {} if self.source is None else self.source.attributes()
        own = {} if integrator is None else {"integrator": integrator.plugin}
        chosen: list[Any] = [(integrator or self.scene.integrator(), used or {})]
        if lidar is not None:
            film = self.sensor.film()
            bins = {"time_start_ns": lidar.axis.start_ns, "bin_count": lidar.axis.bin_count}
            chosen.append((film, {name: value for name, value in bins.items() if getattr(film, name) is None}))
            own |= {"record_end": lidar.record_end} if lidar.record_end else {}
        again["plugin_parameters"] = plugin_values(self.scene, integrator, chosen)
        return {"scene": self.name, **variants.versions(), **own, **others, **again}

    def tell_axis(self, axis: TimeAxis, end: str) -> None:
        """Log time bins, and the reason for their end, where the film leaves their start or number to the scene."""
        if self.sensor.film().axis is None:
            text = f"{axis.start_ns:g} to {axis.end_ns:g} ns, {axis.bin_count} bins of {axis.bin_width_ns:g} ns"
            logger.info("time axis: %s%s", text, f"; it ends {end}" if end else "")


@alone_with_scene
def open_scene(
    scene: Any,
    params: Mapping[str, Any] | None = None,
    instrument: str | None = None,
    *,
    variant: str | None = None,
    model: mi.Scene | None = None,
    sensor: str | None = None,
) -> LoadedScene:
    """Load a scene.

    Parameters
    ----------
    scene
        Name of a shipped scene, path of an XML file, dict for ``mitsuba.load_dict``, a loaded scene, or a scene source.
        A `LoadedScene` is returned unchanged, without `params` and `sensor`.
    params
        Values for the parameters of an XML scene, its own (``<default>``) and its plugins', as in
        `loading.parameters.fill`, and of the instrument.
    instrument
        Name of the instrument whose laser and receiver replace an XML scene's; see `catalogue.mount`.
    variant
        Mitsuba variant, as for `variants.set_variant`.
    model
        Loaded scene whose lasers and receivers choose the automatic values of the sea, by default the scene itself.
    sensor
        Id of a receiver, by default the source's, or the first one.

    Raises
    ------
    UserError
        If there is no such scene, instrument or receiver; a parameter is unknown, not used or empty; a value is
        invalid; a part is missing; or a source file is missing or has changed.
    """
    if isinstance(scene, LoadedScene) and not params and not sensor:
        return scene
    variants.set_variant(variant)
    import xarray as xr

    check_params(params)
    is_dict = isinstance(scene, Mapping) and not isinstance(scene, xr.Dataset)
    if isinstance(scene, mi.Scene):
        _no_parameters(params, instrument, "a loaded scene")
        loaded = LoadedScene(scene, scene.id() or "scene", {})
    elif is_dict or (isinstance(scene, SceneSource) and not scene.is_xml):
        _no_parameters(params, instrument, "a dict")
        loaded = _load_dict(scene)
    elif isinstance(scene, (SceneSource, str, os.PathLike)):
        loaded = _load_xml(scene, params, instrument)
    else:
        raise UserError(f"scene = {shown(scene)} must be a shipped name, a path, a dict or a loaded scene")
    fit_seas(loaded.scene, model)
    if sensor:
        source = loaded.source and replace(loaded.source, sensor=sensor)
        loaded = replace(loaded, source=source, sensor_id=lidar_sensor(loaded.scene, sensor).id())
    return loaded


@overload
def choose_integrator(scene: mi.Scene, wanted: Any, passive: Literal[False] = False) -> LidarIntegrator: ...


@overload
def choose_integrator(scene: mi.Scene, wanted: Any, passive: Literal[True]) -> DaylightIntegrator: ...


def choose_integrator(scene: mi.Scene, wanted: Any, passive: bool = False) -> LidarIntegrator | DaylightIntegrator:
    """Return an integrator from its name, a dict or itself, by default the scene's.

    For `passive` the default is ``passive_volpath`` if the scene's integrator does not render daylight.

    Raises UserError if it is not a lidar integrator, or for `passive`, not one for daylight.
    """
    own = scene.integrator()
    if wanted is None and passive and not (isinstance(own, LidarIntegrator) and own.passive):
        wanted = "passive_volpath"
    if wanted is None:
        chosen = own
    elif isinstance(wanted, mi.Integrator):
        chosen = wanted
    else:
        if not isinstance(wanted, (str, Mapping)):
            raise UserError(f"integrator = {shown(wanted)} must be the name or the dict of an integrator plugin")
        given = {"type": wanted} if isinstance(wanted, str) else dict(wanted)
        check_dict(given)
        # Files of objects in it, which no integrator of this package has, are checked as well.
        SceneSource.of_dict(given)
        with as_user_error():
            chosen = mi.load_dict(given, parallel=False)
    if not isinstance(chosen, LidarIntegrator) and isinstance(wanted, str):
        raise UserError(f"integrator = {wanted!r} is not a lidar integrator: use lidar_merging or lidar_volpath")
    if not isinstance(chosen, LidarIntegrator):
        # Integrators in Python have the class names of their bases.
        kind = chosen and (type(chosen).__name__ if not hasattr(mi, type(chosen).__name__) else chosen.class_name())
        found = f"{kind} of the scene is not a lidar integrator" if kind else "the scene has no lidar integrator"
        raise UserError(f"integrator: {found}; add <integrator type='lidar_merging'/>")
    if passive and not chosen.passive:
        raise UserError(f"integrator = {chosen.plugin!r} renders no images by daylight: use 'passive_volpath'")
    if chosen.passive and not passive:
        raise UserError(f"integrator: {chosen.plugin} has no laser; use a lidar integrator, or render_passive")
    return chosen


_WITH_MAPS = ("seabed", "ocean_surface")  #: Plugins with maps that may be in map coordinates.


def read_source(
    scene: str | os.PathLike[str],
    params: Mapping[str, Any] | None,
    instrument: str | None,
    origin: tuple[float, float] | None = None,
) -> SceneSource:
    """Return the source of an XML scene with an instrument, and its files with given parameters, without loading it.

    Its parameters have the values of the scene and the instrument. Where the scene has an origin in map coordinates
    [m], height maps in such coordinates lie about it, unless their seabeds have an ``origin_x``. Other arguments and
    errors as in `open_scene`, except errors that only loading finds.
    """
    check_params(params)
    document = _document(scene, instrument)
    filled = _filled(document, params)
    source = SceneSource.of_document(filled if origin is None else _with_maps_about(filled, origin))
    return replace(source, parameters=dict(document.parameters))


def _with_maps_about(document: SceneDocument, origin: tuple[float, float]) -> SceneDocument:
    """Return a scene whose seabeds and seas with a map in map coordinates have an ``origin_x`` and ``origin_y`` [m]."""
    changed, placed = document.copied(), False
    shapes = {id(one.element) for one in changed.settings if one.attribute == "type" and one.value in _WITH_MAPS}
    for setting in changed.settings:
        shape: Any = setting.element.parentNode
        if setting.owner not in ("filename", "foam_map") or id(shape) not in shapes:
            continue
        if Path(setting.value).suffix.lower() not in IN_MAP_COORDINATES:
            continue
        names = [child.getAttribute("name") for child in shape.getElementsByTagName("float")]
        if "origin_x" in names or "origin_y" in names:
            continue
        placed = True
        for name, value in zip(("origin_x", "origin_y"), origin, strict=True):
            number = shape.ownerDocument.createElement("float")
            number.setAttribute("name", name)
            number.setAttribute("value", repr(value))
            shape.appendChild(number)
    # The copy has the settings before its change.
    return replace(changed) if placed else document


def _document(scene: SceneSource | str | os.PathLike[str], instrument: str | None) -> SceneDocument:
    """Return an XML scene's document, with an instrument's laser and receiver."""
    document = scene.document() if isinstance(scene, SceneSource) else read_document(scene_path(scene))
    return document if instrument is None else mount(instrument, document)


def _filled(document: SceneDocument, params: Mapping[str, Any] | None) -> SceneDocument:
    """Return a document with values of its parameters, after all checks that need no loading."""
    filled = fill(document, params)
    check(filled)
    return filled


def _load_dict(scene: Mapping[str, Any] | SceneSource) -> LoadedScene:
    """Load a scene given as a dict, or its source."""
    given = scene.scene_dict() if isinstance(scene, SceneSource) else scene
    check_dict(given)
    # A source's files are the files in the scene, too, not the files in its list.
    found = SceneSource.of_dict(given)
    source = scene if isinstance(scene, SceneSource) else found
    with as_user_error(), _own_file_resolver():
        described = {"type": "scene", **_with_own_tensors(given)}
        loaded = _instantiate(lambda config: mi.parser.parse_dict(config, described))
    return LoadedScene(loaded, "scene", {}, source)


def _with_own_tensors(part: Mapping[str, Any]) -> dict[str, Any]:
    """Return a dict with copies of its tensors: Mitsuba empties tensors that become textures."""

    def own(value: Any) -> Any:
        if isinstance(value, Mapping):
            return _with_own_tensors(value)
        return mi.TensorXf(value) if isinstance(value, mi.TensorXf) else value

    return {name: own(value) for name, value in part.items()}


def _load_xml(
    scene: SceneSource | str | os.PathLike[str], params: Mapping[str, Any] | None, instrument: str | None
) -> LoadedScene:
    """Load an XML scene by the steps in `loading.document`."""
    document = _filled(_document(scene, instrument), params)
    source = SceneSource.of_document(document, scene if isinstance(scene, SceneSource) else None)
    text = source.place_files(document)
    with as_user_error(document), _own_file_resolver(document.folder):
        loaded = _instantiate(lambda config: mi.parser.parse_string(config, text))
    return LoadedScene(loaded, document.name, values_of(document), source)


def _instantiate(parse: Callable[[Any], Any]) -> Any:
    """Return the object of a scene that a function parses, with seas whose meshes wait for `fit_seas`."""
    from mitransient_lidar.plugins.ocean_surface import WAITS

    config = mi.parser.ParserConfig(mi.variant())
    # Merging would turn a bottom and a target with one material into a shape without a name. Several threads save no
    # time.
    config.merge_equivalent = config.merge_meshes = config.parallel = False
    parsed = parse(config)
    for node in parsed.nodes:
        props = node.props
        for name in list(props.keys()):
            value = props[name]
            if isinstance(value, str) and DOLLAR in value:
                props[name] = value.replace(DOLLAR, "$")
        if props.plugin_name() == "ocean_surface":
            props[WAITS] = True
    mi.parser.transform_all(config, parsed)
    move_to_aim(parsed)
    # Mitsuba refuses parameters that no plugin has read.
    for node in parsed.nodes:
        for name in list(node.props.keys()):
            node.props.mark_queried(name, False)
    with variants.several_threads():
        return mi.parser.instantiate(config, parsed)


@contextlib.contextmanager
def _own_file_resolver(folder: Path | None = None) -> Iterator[None]:
    """Add a folder to Mitsuba's search path for files; remove it, and the ``<path>`` folders, afterwards."""
    resolver = mi.file_resolver()
    former = [str(path) for path in resolver]
    if folder is not None:
        resolver.prepend(str(folder.resolve()))
    try:
        yield
    finally:
        resolver.clear()
        for path in former:
            resolver.append(path)


@contextlib.contextmanager
def as_user_error(document: SceneDocument | None = None) -> Iterator[None]:
    """Convert a ``RuntimeError`` from Mitsuba's parser to a `UserError` with one sentence.

    Mitsuba wraps an exception from a Python plugin, with its traceback, in a ``RuntimeError``. A wrapped ``UserError``
    or Ctrl-C is unwrapped; any other wrapped exception is a bug and keeps its traceback. A message that quotes file
    bytes outside UTF-8 arrives as a ``UnicodeDecodeError``. A message may name a plugin parameter that a given document
    parameter sets under another name; that name is then added.
    """
    try:
        yield
    except (RuntimeError, UnicodeDecodeError) as error:
        if is_interruption(error):
            raise KeyboardInterrupt from error
        raise_if_out_of_memory(error)
        text = error.object.decode("utf-8", "replace") if isinstance(error, UnicodeDecodeError) else str(error)
        text = text.replace(DOLLAR, "$")
        if wrapped := re.findall(r"UserError: (.*)", text):
            message = " ".join(wrapped[-1].split())
            raise UserError(message + _set_by(message, document)) from error
        if empty := re.search(r'failed to instantiate shape plugin of type "(\w+)": jit_var', text):
            raise UserError(f"a shape of type {empty[1]} has no faces: its mesh must have at least one") from error
        if wrong := re.search(r'The property "(\w+)" has the wrong type \(expected ([\w ]+), got ([\w ]+)\)', text):
            raise UserError(f"{wrong[1]} is of type {wrong[3]}: it must be of type {wrong[2]}") from error
        if "Traceback (most recent call last)" in text:
            raise
        text = re.sub(r"\[\w+(\.cpp:\d+)?\] ", "", text)
        raise UserError(unknown_parameters(text) or " ".join(text.split())) from error


def _set_by(message: str, document: SceneDocument | None) -> str:
    """Return the addition to a message about a plugin's parameter that a parameter of another name sets."""
    named = re.match(r"(\w+)\b", message)
    if document is None or named is None or named[1] in document.given:
        return ""
    for setting in document.settings:
        reference = re.fullmatch(r"-?\$(\w+)", setting.template)
        if reference and setting.owner == named[1] and reference[1] in document.given:
            return f" ({named[1]} is set by {reference[1]} = {document.given[reference[1]]})"
    return ""


def _no_parameters(params: Mapping[str, Any] | None, instrument: str | None, what: str) -> None:
    if instrument is not None:
        raise UserError(f"instrument = {shown(instrument)} needs an XML scene, not {what}")
    if params:
        raise UserError(f"params = {sorted(params)} need an XML scene; {what} has its values in it")
