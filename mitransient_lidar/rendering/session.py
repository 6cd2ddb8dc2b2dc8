"""Loaded scenes with their sensors and integrators."""

from __future__ import annotations

import logging
from collections.abc import Mapping
from dataclasses import dataclass, replace
from typing import TYPE_CHECKING, Any, Literal, overload

from mitransient_lidar.core.errors import UserError
from mitransient_lidar.core.validation import shown
from mitransient_lidar.loading import variants
from mitransient_lidar.loading.checks import check_dict
from mitransient_lidar.loading.exclusive import alone_with_scene
from mitransient_lidar.loading.scene_record import SceneRecord, plugin_values
from mitransient_lidar.loading.scenes import as_user_error, load
from mitransient_lidar.rendering.passes import PassLog

if TYPE_CHECKING:
    import mitsuba as mi

    from mitransient_lidar.physics.lidar.time_axis import TimeAxis
    from mitransient_lidar.transport.daylight.renderer import DaylightIntegrator
    from mitransient_lidar.transport.passes import LidarIntegrator

logger = logging.getLogger(__name__)

#: Share of the energy lost at the edge of the surface mesh above which a warning is given.
TOLERATED_LOSS = 1e-3


@dataclass(frozen=True)
class Session:
    """A loaded scene with its receiver, its name, and the parameters of an XML scene with their values as text.

    The record, None for a scene from loaded objects, loads the scene again.
    """

    scene: mi.Scene
    sensor: mi.Sensor
    name: str
    parameters: dict[str, str]
    record: SceneRecord | None = None

    def attributes(
        self,
        integrator: LidarIntegrator | DaylightIntegrator | None = None,
        used: Mapping[str, float] | None = None,
        **others: Any,
    ) -> dict[str, Any]:
        """Return the attributes of a result: scene, versions, integrator, others, and those of `scene_record`.

        ``record_end`` is what the last light of a record of automatic length comes from.

        `used` are the values that were chosen for automatic parameters of the integrator.
        """
        from mitransient_lidar.transport.plugin_types import GatedFilm

        recorded = {} if self.record is None else self.record.attributes()
        own = {} if integrator is None else {"integrator": integrator.plugin}
        recorded["plugin_parameters"] = plugin_values(self.scene, integrator, used)
        film = self.sensor.film()
        own |= {"record_end": film.end} if isinstance(film, GatedFilm) and film.end else {}
        return {"scene": self.name, **variants.versions(), **own, **others, **recorded}

    def share_record(self, axis: TimeAxis) -> None:
        """Use the time bins of other renders instead of automatic ones."""
        self.sensor.film().share(axis)

    def tell_record(self, axis: TimeAxis | None = None) -> None:
        """Log time bins, by default those of the film, where its start or length are automatic."""
        film = self.sensor.film()
        if film.used_values:
            axis, end = axis or film.axis, f"; it ends {film.end}" if film.end else ""
            text = f"record: {axis.start_ns:g} to {axis.end_ns:g} ns, {axis.bin_count} bins of {axis.bin_width_ns:g} ns"
            logger.info("%s%s", text, end)


@alone_with_scene
def open_scene(
    scene: Any,
    params: Mapping[str, Any] | None = None,
    variant: str | None = None,
    instrument: str | None = None,
    model: mi.Scene | None = None,
    sensor: str | None = None,
) -> Session:
    """Load a scene as `loading.scenes.load`, with a Mitsuba variant as for `loading.variants.set_variant`.

    `sensor` is the id of a receiver, by default that of a record, or the first one. A session without `params` and
    `sensor` is returned as it is.

    Raises
    ------
    UserError
        If the scene cannot be loaded, or has no receiver, or none of that id.
    """
    if isinstance(scene, Session) and not params and not sensor:
        return scene
    variants.set_variant(variant)
    from mitransient_lidar.transport.scene_parts import lidar_sensor

    loaded = load(scene, params, instrument, model)
    record = loaded.record if loaded.record is None or not sensor else replace(loaded.record, sensor=sensor)
    chosen = lidar_sensor(loaded.scene, sensor or (record.sensor if record else ""))
    return Session(loaded.scene, chosen, loaded.name, loaded.parameters, record)


@overload
def choose_integrator(scene: mi.Scene, wanted: Any, passive: Literal[False] = False) -> LidarIntegrator: ...


@overload
def choose_integrator(scene: mi.Scene, wanted: Any, passive: Literal[True]) -> DaylightIntegrator: ...


def choose_integrator(scene: mi.Scene, wanted: Any, passive: bool = False) -> LidarIntegrator | DaylightIntegrator:
    """Return an integrator from its name, a dict or itself, by default that of the scene.

    For `passive` the default is ``passive_volpath`` if that of the scene is not one for daylight.

    Raises
    ------
    UserError
        If it is not a lidar integrator, or for `passive`, not one for daylight.
    """
    import mitsuba as mi

    from mitransient_lidar.transport.passes import LidarIntegrator

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
        # The files of objects in it, which no integrator of ours has, are checked as well.
        SceneRecord.of_dict(given)
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


def check_components(scene: mi.Scene) -> None:
    """Raise `UserError` for too many solids to separate their light, before a renderer is prepared for all of them."""
    from mitransient_lidar.transport.path_classes import check_solids

    check_solids(sum(not shape.is_medium_transition() for shape in scene.shapes()))


def pass_attributes(log: PassLog, seed: int) -> dict[str, Any]:
    """Return the attributes of a result that describe its passes.

    With a requested error: the error and its quantile, the error that was reached, and an estimate of the time that was
    still needed [s], 0 if the request was met and NaN if unknown.
    """
    attributes = {"seed": int(seed), "passes": log.count, "interrupted": int(log.interrupted)}
    if log.goal.target_error is None:
        return attributes
    return attributes | {
        "target_error": log.goal.target_error,
        "target_quantile": log.goal.target_quantile,
        "error_at_quantile": log.error,
        "target_missing_s": log.needed_s,
    }


def warn_of_edge_loss(share: float) -> None:
    """Warn when a large share of the energy is lost at the edge of the surface mesh."""
    if share > TOLERATED_LOSS:
        logger.warning(
            "the surface is smaller than the spread of the light in the water: about %.2g %% of the received energy is "
            "lost at its edge; enlarge the surface's size",
            100 * share,
        )
