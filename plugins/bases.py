"""Base classes for the plugins."""

from __future__ import annotations

from collections.abc import Callable
from typing import Any, TypeVar

import drjit as dr
import mitsuba as mi
import numpy as np

from mitransient_lidar.core.errors import UserError
from mitransient_lidar.core.parameters.fields import Plugin, Read
from mitransient_lidar.core.parameters.lidar import ANGLES
from mitransient_lidar.physics.sea.sea_mesh import SeaMesh
from mitransient_lidar.transport.opaque import aligned
from mitransient_lidar.transport.pose import KernelPose

#: Parameter of the loader: frame origin in the scene [m], x, y, z, for plugins with a location.
FRAME_ORIGIN = "_frame_origin"


class DeclaredProperties(mi.Properties):
    """Copy of a plugin's parameters that keeps each value that is read, the default where none is given.

    Parameters whose value may be an empty text are removed where it is: they count as not given. Two ways to describe
    one thing are refused, where ``false`` is none. `read` returns values as the plugin declares them.
    """

    def __init__(self, props: mi.Properties, plugin: Plugin) -> None:
        super().__init__(props)
        self._plugin = plugin
        #: Values by name: of the same types as in `mi.Properties`, None without a value or for an empty text.
        self.values: dict[str, Any] = {}
        #: Frame origin in the scene [m]: parameters are scene coordinates, loaded objects lie in the frame, in which
        #: single precision is exact.
        self.frame_origin = np.array(self.take(FRAME_ORIGIN, (0.0, 0.0, 0.0)), dtype=np.float64)
        for parameter in plugin:
            if parameter.may_be_empty and parameter.name in self and super().get(parameter.name) == "":
                del self[parameter.name]
        ways = {name for several in plugin.alternatives for way in several for name in way}
        given = {name: super(DeclaredProperties, self).get(name) for name in ways.intersection(self.keys())}
        nested = {"a nested sensor": one for _, one in self.objects(False) if isinstance(one, mi.Sensor)}  # noqa: B035
        plugin.check_ways({name: one for name, one in {**given, **nested}.items() if str(one).lower() != "false"})
        for name in given:
            self.mark_queried(name, False)

    @property
    def read(self) -> Read:
        """Reader of checked values; to keep it would make a circle that keeps the nested objects alive."""
        return self._plugin.reader(self.get)

    def get(self, name: str, default: Any = None) -> Any:
        """Return a parameter's value, or the default."""
        return self._kept(name, super().get(name, default))

    def __getitem__(self, name: str) -> Any:
        return self._kept(name, super().__getitem__(name))

    def __contains__(self, name: str) -> bool:
        given: bool = super().__contains__(name)
        if not given:
            self.values.setdefault(name, None)
        return given

    def take(self, name: str, default: Any) -> Any:
        """Remove a parameter that is not recorded, and return its value or the default."""
        value = super().get(name, default)
        if super().__contains__(name):
            del self[name]
        return value

    def _kept(self, name: str, value: Any) -> Any:
        self.values[name] = None if isinstance(value, str) and value == "" else value
        return value


_Made = TypeVar("_Made", bound=Callable[[DeclaredProperties], Any])


def register(kind: str, plugin: Plugin, described: type | None = None) -> Callable[[_Made], _Made]:
    """Return a decorator for the class of a Mitsuba plugin of a kind, or for a function that makes its objects.

    The docstring of this class, or of the class that is described, is the plugin's manual. It gets the parameter table
    and the example in XML.

    The objects get ``parameters``: the plugin's name as ``type``, each parameter's value that they have read, and
    nested objects. They also get a description that lists these.
    """

    def registered(make: _Made) -> _Made:
        manual: Any = make if described is None else described
        if manual.__doc__:
            manual.__doc__ = plugin.manual(manual.__doc__, kind)
        getattr(mi, f"register_{kind}")(plugin.name, lambda props: _made(props, plugin, make))
        return make

    return registered


def _made(props: mi.Properties, plugin: Plugin, make: Callable[[DeclaredProperties], Any]) -> Any:
    """Return a plugin's object, with its parameters."""
    own = DeclaredProperties(props, plugin)
    children = dict(props.objects(False))
    made = make(own)
    type(made).to_string = _described
    # Mitsuba refuses unread parameters of `props`: the class has read, or removed, the copy's parameters.
    given, left = list(props.keys()), set(own.keys())
    used = [name for name in given if name not in left or own.was_queried(name)]
    for name in used:
        props.mark_queried(name)
    # Mitsuba's base classes read some themselves.
    others = {name: props[name] for name in used if name in left and name not in own.values and name not in children}
    made.parameters = {"type": props.plugin_name(), **own.values, **others, **children}
    return made


def exposed(part: mi.Object) -> tuple[dict[str, Any], list[tuple[str, mi.Object]]]:
    """Return the values and the nested objects, with their names, that an object shows to ``mi.traverse``."""
    values: dict[str, Any] = {}
    objects: list[tuple[str, mi.Object]] = []

    class Callback(mi.TraversalCallback):
        def put(self, name: str, value: Any, flags: int, kind: Any = None) -> None:
            (self.put_object if isinstance(value, mi.Object) else self.put_value)(name, value, flags, kind)

        def put_value(self, name: str, value: Any, flags: int, kind: Any = None) -> None:
            values[name] = value if kind is None else mi.get_property(value, kind, part)

        def put_object(self, name: str, value: mi.Object | None, flags: int, kind: Any = None) -> None:
            if value is not None:
                objects.append((name, value))

    part.traverse(Callback())
    return values, objects


def _described(self: Any) -> str:
    """Return the class of a plugin's object and its parameters."""
    values = {**self.parameters, **getattr(self, "used_values", {})}
    given = ", ".join(f"{name}={value}" for name, value in values.items() if isinstance(value, (bool, int, float, str)))
    return f"{type(self).__name__}[{given}]"


def closed(plugin: Any) -> Any:
    """Return a class of plugins whose objects ``mi.traverse`` cannot change: changed ones are loaded again."""

    def traverse(self: Any, callback: mi.TraversalCallback) -> None:
        """Expose no parameters."""

    plugin.traverse = traverse
    return plugin


def read_pose(props: DeclaredProperties) -> KernelPose:
    """Return a lidar's pose in the frame, from ``to_world`` or from height, angle and aim."""
    if "to_world" not in props:
        pose = KernelPose.from_angles(*(props.get(each.name, each.default) for each in ANGLES))
        return pose.in_frame(props.frame_origin)
    matrix = np.array(props["to_world"].matrix, dtype=np.float64)
    return KernelPose.from_matrix(f"{props.plugin_name()}: to_world", matrix).in_frame(props.frame_origin)


def refuse_medium(props: mi.Properties) -> None:
    """Raise UserError for a medium inside a sensor or an emitter, which would have no effect."""
    if any(isinstance(child, mi.Medium) for _, child in props.objects()):
        raise UserError(
            f"{props.plugin_name()}: a medium inside it would have no effect, leave it out: below the sea surface the "
            "solid lies in the sea's water, above it in clear air"
        )


@closed
class EmitterWithoutExtent(mi.Emitter):
    """Emitter that does not extend the scene and exposes no parameters."""

    def __init__(self, props: mi.Properties) -> None:
        refuse_medium(props)
        super().__init__(props)

    def bbox(self) -> mi.ScalarBoundingBox3f:
        """Return an invalid box: the emitter does not extend the scene."""
        return mi.ScalarBoundingBox3f()

    def pdf_direction(self, it: mi.Interaction3f, ds: mi.DirectionSample3f, active: mi.Bool = True) -> mi.Float:
        """Return 0: no direction meets a point or a small disc by chance."""
        return mi.Float(0)

    def eval(self, si: mi.SurfaceInteraction3f, active: mi.Bool = True) -> mi.Spectrum:
        """Return 0: only `sample_direction` finds the emitter."""
        return mi.Spectrum(0)

    def distant_sample(self, it: mi.Interaction3f, direction: mi.Vector3f) -> mi.DirectionSample3f:
        """Return the sample of a direction to infinity, without its density."""
        ds = dr.zeros(mi.DirectionSample3f)
        ds.d, ds.n = direction, -direction
        ds.dist = dr.largest(mi.Float)
        ds.p = it.p + direction * 1e6
        ds.time = it.time
        ds.emitter = mi.EmitterPtr(self)
        return ds


FOAM = "face_foam"  #: Mesh attribute: foam share.


def fill_mesh(shape: mi.Mesh, mesh: SeaMesh) -> None:
    """Set the buffers of a new Mitsuba mesh, which has an attribute `FOAM` if there is foam."""
    buffers = mi.traverse(shape)
    buffers["vertex_positions"] = aligned(mi.Float, mesh.vertices)
    buffers["vertex_texcoords"] = aligned(mi.Float, mesh.texcoords)
    buffers["faces"] = aligned(mi.UInt32, mesh.faces)
    if mesh.foam is not None:
        buffers[FOAM] = aligned(mi.Float, mesh.foam)
    buffers.update()
    shape.initialize()
