"""Coordinates relative to the lidar's aim: single precision is exact in scenes far from their origin.

Mitsuba stores a parsed scene in double precision. Its objects, which compute in single precision, are then made in a
frame whose origin is near the aim. This package's plugins with locations take the frame's origin, and keep their
parameters as scene coordinates. Other objects are displaced by their ``to_world``.
"""

from __future__ import annotations

import math
from collections.abc import Iterator
from typing import Any

import drjit.scalar as ds
import mitsuba as mi
import numpy as np

from mitransient_lidar.core.validation import FloatArray
from mitransient_lidar.physics.lidar.pose import Pose
from mitransient_lidar.transport.plugin_types import LidarSensor, Transmitter

_NEAR = 250.0  #: Distance from the scene's origin to the aim up to which the scene's own frame is used [m].

#: This package's plugins with locations, the first ones by their aim.
_LIDAR = ("lidar_transmitter", "multipixel_receiver", "pixel_fov")
_MESHES = ("ocean_surface", "seabed")
_OWN = (*_LIDAR, *_MESHES, "layered_water")

#: Mitsuba plugins that ``to_world`` places, and the points that place some of them before it.
_PLACED = (
    *("bsplinecurve", "cube", "cylinder", "disk", "gridvolume", "instance"),
    *("linearcurve", "obj", "orthographic", "perspective", "ply", "projector", "radiancemeter", "rectangle"),
    *("sdfgrid", "serialized", "sphere", "spot", "thinlens"),
)
_POINTS = {"sphere": ("center",), "cylinder": ("p0", "p1")}

_BY_COORDINATES = ("bitmap", "checkerboard")  #: Mitsuba textures that use texture coordinates.

#: Mitsuba plugins without a location of their own, in kinds that have one.
_WITHOUT_PLACE = (
    *("area", "batch", "constant", "constvolume", "directional", "directionalarea", "envmap", "heterogeneous"),
    *("flat_sensor", "homogeneous", "irradiancemeter", "merge", "shapegroup", "sky", "sun", "sunsky", "timed_sunsky"),
)


def move_to_aim(parsed: Any) -> None:
    """Place a parsed scene's objects in a frame about its lidar's aim, if that is far from the scene's origin.

    A scene stays unmoved if it has loaded objects, plugins whose locations are unknown, or a texture on an
    ``ocean_surface``, or on a seabed and another shape.
    """
    from mitransient_lidar.plugins.bases import FRAME_ORIGIN

    nodes = list(parsed.nodes)
    aim = _aim(nodes)
    if aim is None or not _NEAR < math.hypot(*aim) < math.inf or not all(map(_is_movable, nodes)):
        return
    on_seabeds = {index for node in nodes if _name(node) == "seabed" for index in _textures(nodes, node)}
    others = (node for node in nodes if node.type == mi.ObjectType.Shape and _name(node) != "seabed")
    if any(
        _name(node) == "ocean_surface" or index in on_seabeds for node in others for index in _textures(nodes, node)
    ):
        return
    origin = round(aim[0]), round(aim[1]), 0
    to_scene = mi.ScalarAffineTransform4d().translate(list(origin))
    # The members of a group lie about their instances.
    grouped = {index for node in nodes if _name(node) == "shapegroup" for index in _children(node)}
    for number, node in enumerate(nodes):
        if _name(node) in _OWN:
            node.props[FRAME_ORIGIN] = origin
        elif _name(node) in _PLACED and number not in grouped:
            node.props["to_world"] = to_scene.inverse() @ _placement(node)
        elif number in on_seabeds:
            # Texture coordinates of a seabed are its x and y.
            node.props["to_uv"] = _wrapped(_transform(node, "to_uv") @ to_scene, node)


def frame_origin(scene: Any) -> FloatArray:
    """Return the place of the frame's origin in a loaded scene [m], shape (3,)."""
    poses = [emitter.pose for emitter in scene.emitters() if isinstance(emitter, Transmitter)]
    poses += [sensor.receiver.pose for sensor in scene.sensors() if isinstance(sensor, LidarSensor)]
    return poses[0].frame_origin if poses else np.zeros(3)


def _name(node: Any) -> str:
    return str(node.props.plugin_name())


def _aim(nodes: list[Any]) -> tuple[float, float] | None:
    """Return the point (x, y) [m] at which the laser aims, or without a laser the receiver; None without both."""
    lidars = sorted((node for node in nodes if _name(node) in _LIDAR), key=lambda node: _LIDAR.index(_name(node)))
    if not lidars:
        return None
    props = lidars[0].props
    if "to_world" in props:
        matrix = np.array(props["to_world"].matrix, dtype=np.float64)
        point = Pose.from_matrix(f"{_name(lidars[0])}: to_world", matrix).nearby_point()
        return float(point[0]), float(point[1])
    aim = [props.get(name, 0.0) for name in ("aim_x", "aim_y")]
    # The plugin refuses others.
    return (float(aim[0]), float(aim[1])) if all(isinstance(one, (int, float)) for one in aim) else None


def _is_movable(node: Any) -> bool:
    """Return whether a node's location is known."""
    kinds = mi.ObjectType.Shape, mi.ObjectType.Sensor, mi.ObjectType.Emitter, mi.ObjectType.Medium, mi.ObjectType.Volume
    if node.type in kinds and _name(node) not in (*_OWN, *_PLACED, *_WITHOUT_PLACE):
        return False
    props, given = node.props, mi.Properties.Type
    loaded = (mi.Shape, mi.Sensor, mi.Emitter, mi.Medium, mi.Volume, mi.BSDF, mi.Texture)
    if any(isinstance(one, loaded) for _, one in props.objects(False)):
        return False
    if _name(node) == "radiancemeter" and "origin" in props:
        return False
    return all(name not in props or props.type(name) == given.Transform for name in ("to_world", "to_uv"))


def _placement(node: Any) -> Any:
    """Return the transform of a Mitsuba node to the scene, whose points are then relative to the first of them."""
    props, placement = node.props, _transform(node, "to_world")
    points = _POINTS.get(_name(node), ())
    if not points or any(name not in props or props.type(name) != mi.Properties.Type.Vector for name in points):
        return placement
    first = np.array(props[points[0]], dtype=np.float64)
    for name in points:
        props[name] = ds.Array3f64(np.array(props[name], dtype=np.float64) - first)
    return placement @ mi.ScalarAffineTransform4d().translate(first.tolist())


def _transform(node: Any, name: str) -> Any:
    """Return a transform of a node, by default the identity."""
    return node.props[name] if name in node.props else mi.ScalarAffineTransform4d()


def _wrapped(to_uv: Any, node: Any) -> Any:
    """Return a texture coordinate transform, shifted by less than 2, the period of textures that repeat or mirror."""
    if _name(node) == "bitmap" and node.props.get("wrap_mode", "repeat") == "clamp":
        return to_uv
    matrix = np.array(to_uv.matrix, dtype=np.float64)
    matrix[:2, 3] %= 2
    return type(to_uv)(matrix)


def _textures(nodes: list[Any], node: Any) -> set[int]:
    """Return the numbers of the textures by texture coordinates in a node."""
    found: set[int] = set()
    waiting = set(_children(node))
    while waiting:
        number = waiting.pop()
        if _name(nodes[number]) in _BY_COORDINATES:
            found.add(number)
        waiting |= set(_children(nodes[number]))
    return found


def _children(node: Any) -> Iterator[int]:
    """Return the numbers of the nodes that a node refers to."""
    props = node.props
    for name in props:
        if props.type(name) == mi.Properties.Type.ResolvedReference:
            yield props[name].index()
