"""Base classes for the plugins."""

from __future__ import annotations

from abc import abstractmethod
from collections.abc import Callable
from dataclasses import fields
from typing import Any

import drjit as dr
import mitsuba as mi
import numpy as np

from mitransient_lidar.core.errors import UserError
from mitransient_lidar.core.parameters.fields import Plugin, Read
from mitransient_lidar.core.parameters.lidar import ANGLES
from mitransient_lidar.core.validation import integer
from mitransient_lidar.physics.lidar.time_axis import TimeAxis
from mitransient_lidar.physics.sea.sea_mesh import SeaMesh
from mitransient_lidar.transport.opaque import aligned
from mitransient_lidar.transport.paths.passes import PassRenderer
from mitransient_lidar.transport.paths.path_classes import PathClasses
from mitransient_lidar.transport.pose import KernelPose
from mitransient_lidar.transport.scene import LidarScene
from mitransient_lidar.transport.scene_parts import find_lidar_scene
from mitransient_lidar.transport.sensor.image_sampling import read_image
from mitransient_lidar.transport.sensor.pixels import PixelArray
from mitransient_lidar.transport.sensor.receiver import (
    GaussianPointSpread,
    MeasuredPointSpread,
    PointSpread,
    Receiver,
    ReceiverOptics,
)

#: Parameter of the loader: frame origin in the scene [m], x, y, z, for plugins with a location.
FRAME_ORIGIN = "_frame_origin"

#: Optical parameters of a receiver, in the order of `ReceiverOptics`.
_OPTICS = tuple(each.name for each in fields(ReceiverOptics))


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


def register(
    kind: str, plugin: Plugin, make: Callable[[DeclaredProperties], Any], described: type | None = None
) -> None:
    """Register a Mitsuba plugin of a kind, made by its class or by a function of the class that describes it.

    The class docstring, the plugin's manual, gets the parameter table and the example in XML.

    The objects get ``parameters``: the plugin's name as ``type``, each parameter's value that they have read, and
    nested objects; and a description that lists these.
    """
    manual: Any = make if described is None else described
    if manual.__doc__:
        manual.__doc__ = plugin.manual(manual.__doc__, kind)

    def construct(props: mi.Properties) -> Any:
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
        others = [name for name in used if name in left and name not in own.values and name not in children]
        made.parameters = {
            "type": props.plugin_name(),
            **own.values,
            **{name: props[name] for name in others},
            **children,
        }
        return made

    getattr(mi, f"register_{kind}")(plugin.name, construct)


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


@closed
class SampledBSDF(mi.BSDF):
    """BSDF that is evaluated with its density, and draws directions from one or two components."""

    def __init__(self, props: DeclaredProperties, *components: int) -> None:
        super().__init__(props)
        self.m_components, self.m_flags = list(components), components[0] | components[-1]

    @abstractmethod
    def draw(
        self, ctx: mi.BSDFContext, si: mi.SurfaceInteraction3f, sample1: mi.Float, sample2: mi.Point2f
    ) -> tuple[mi.Vector3f, mi.UInt32]:
        """Draw directions with the density of `eval_pdf`; return them and the numbers of their components."""

    @abstractmethod
    def eval_pdf(
        self, ctx: mi.BSDFContext, si: mi.SurfaceInteraction3f, wo: mi.Vector3f, active: mi.Bool = True
    ) -> tuple[mi.Color1f, mi.Float]:
        """Return BSDF times cosine, and density [1/sr]."""

    def sample(
        self,
        ctx: mi.BSDFContext,
        si: mi.SurfaceInteraction3f,
        sample1: mi.Float,
        sample2: mi.Point2f,
        active: mi.Bool = True,
    ) -> tuple[mi.BSDFSample3f, mi.Color1f]:
        """Sample a direction; return it and BSDF times cosine over its density."""
        bs = dr.zeros(mi.BSDFSample3f)
        bs.wo, bs.sampled_component = self.draw(ctx, si, sample1, sample2)
        bs.eta = 1.0
        first, last = mi.UInt32(self.m_components[0]), mi.UInt32(self.m_components[-1])
        bs.sampled_type = dr.select(bs.sampled_component == 0, first, last)
        value, bs.pdf = self.eval_pdf(ctx, si, bs.wo, active)
        return bs, dr.select(bs.pdf > 0, value / bs.pdf, 0)

    def eval(
        self, ctx: mi.BSDFContext, si: mi.SurfaceInteraction3f, wo: mi.Vector3f, active: mi.Bool = True
    ) -> mi.Color1f:
        """Return BSDF times cosine [1/sr]."""
        return self.eval_pdf(ctx, si, wo, active)[0]

    def pdf(
        self, ctx: mi.BSDFContext, si: mi.SurfaceInteraction3f, wo: mi.Vector3f, active: mi.Bool = True
    ) -> mi.Float:
        """Return the density with which `sample` draws a direction [1/sr]."""
        return self.eval_pdf(ctx, si, wo, active)[1]


class PassIntegrator(mi.CppADIntegrator):
    """Integrator that prepares a scene and renders one pass of it.

    It keeps no scene state: every ``mi.render`` call prepares the scene again, with changes by ``mi.traverse``.
    ``mitransient_lidar.render`` prepares a scene once for all passes.
    """

    #: Integrator name in results.
    plugin: str

    #: Whether it renders daylight instead of lidar echoes.
    passive = False

    @abstractmethod
    def prepare(self, scene: mi.Scene, sensor: mi.Sensor) -> Any:
        """Return the pass renderer for a scene (`PassRenderer` or `DaylightRenderer`).

        Raises UserError when the scene lacks a part or has one that the integrator does not support.
        """

    def develop(self, received: Any, sensor: mi.Sensor) -> mi.TensorXf:
        """Return the energy [J] of a pass, and store it in the sensor's film."""
        sensor.film().store(received.histogram)
        return sensor.film().develop()

    def render(
        self,
        scene: mi.Scene,
        sensor: mi.Sensor | int = 0,
        seed: mi.UInt32 = 0,
        spp: int = 0,
        develop: bool = True,
        evaluate: bool = True,
    ) -> mi.TensorXf:
        """Render one pass; passes with different seeds are independent.

        `spp` is the number of paths per pixel; 0 selects the integrator's total number of paths. Without `develop` the
        result is empty; `evaluate` is not used.

        Returns
        -------
        TensorXf
            Received energy [J], shape (pixel, time) or (row, column, time); by daylight radiance [W m^-2 sr^-1 nm^-1],
            shape (pixel,) or (row, column), 0 where no path started.

        Raises
        ------
        UserError
            When `prepare` raises it, or `seed` is not within 0 to 2^64 - 1, or `spp` not within 0 to 2^28.
        """
        seed, spp = integer("seed", int(np.array(seed).item()), 0, 2**64 - 1), integer("spp", spp, 0, 2**28)
        if isinstance(sensor, int):
            sensor = scene.sensors()[sensor]
        renderer = self.prepare(scene, sensor)
        paths = spp * renderer.scene.receiver.pixels.count if spp > 0 else None
        result = self.develop(renderer.render_pass(seed, paths=paths), sensor)
        return result if develop else mi.TensorXf()

    def render_forward(self, *args: Any, **kwargs: Any) -> mi.TensorXf:
        """Raise UserError: Mitsuba's gradients do not pass through scattering."""
        raise UserError(
            f"{self.plugin} passes no gradients of Mitsuba: render without parameters that track them, and with "
            "mitransient_lidar.render(..., derivatives=[...]) for derivatives"
        )

    render_backward = render_forward


class LidarPassIntegrator(PassIntegrator):
    """Integrator of lidar echoes."""

    @abstractmethod
    def renderer(
        self, lidar: LidarScene, classes: PathClasses, layout_of: PassRenderer | None, connections: bool
    ) -> PassRenderer:
        """Return the pass renderer for the parts of a scene; other arguments as for `prepare`."""

    def prepare(
        self,
        scene: mi.Scene,
        sensor: mi.Sensor,
        *,
        classes: PathClasses | None = None,
        receiver: Receiver | None = None,
        layout_of: PassRenderer | None = None,
        connections: bool = True,
        axis: TimeAxis | None = None,
    ) -> PassRenderer:
        """Return the pass renderer for a scene, by default with one light class and the sensor's own receiver.

        `axis` gives the start or number of time bins that the film leaves to the scene; without it they contain all
        light (`find_lidar_scene`).

        `layout_of` is another scene's renderer, whose time bins, points and cells are used. Scenes that differ by a
        target, or slightly in a parameter, then make the same paths from the same seeds. Without `connections`, paths
        that miss the target return the same light with and without it, except for light in full cells; errors with
        narrow beams are larger.

        Raises UserError when the scene lacks a part or has one that is not supported.
        """
        axis = axis if layout_of is None else layout_of.scene.axis
        lidar = find_lidar_scene(scene, sensor, receiver, axis=axis)
        return self.renderer(lidar, classes or PathClasses(), layout_of, connections)


@closed
class ReceiverSensor(mi.Sensor):
    """Sensor of some pixels, with pose, optics and blur from its parameters."""

    def __init__(self, props: DeclaredProperties, pixels: PixelArray) -> None:
        refuse_medium(props)
        super().__init__(props)
        self.receiver = Receiver(read_pose(props), ReceiverOptics(*map(props.read, _OPTICS)), pixels, _blur(props))
        self.m_needs_sample_2 = True
        self.m_needs_sample_3 = self.receiver.blur is not None

    def sample_ray(
        self, time: mi.Float, sample1: mi.Float, sample2: mi.Point2f, sample3: mi.Point2f, active: mi.Bool = True
    ) -> tuple[mi.Ray3f, mi.Spectrum]:
        """Sample a ray uniformly over the field of view, for Mitsuba's own integrators."""
        return self.receiver.sensor_ray(time, sample2, sample3, active)

    def bbox(self) -> mi.ScalarBoundingBox3f:
        """Return an invalid box: the sensor does not extend the scene."""
        return mi.ScalarBoundingBox3f()


def read_pose(props: DeclaredProperties) -> KernelPose:
    """Return a lidar's pose in the frame, from ``to_world`` or from height, angle and aim."""
    if "to_world" not in props:
        pose = KernelPose.from_angles(*(props.get(each.name, each.default) for each in ANGLES))
        return pose.in_frame(props.frame_origin)
    matrix = np.array(props["to_world"].matrix, dtype=np.float64)
    return KernelPose.from_matrix(f"{props.plugin_name()}: to_world", matrix).in_frame(props.frame_origin)


def _blur(props: DeclaredProperties) -> PointSpread | None:
    """Return a receiver's point-spread function; None for sharp optics."""
    if "blur_file" not in props:
        if "blur_file_mrad" in props:
            raise UserError("blur_file_mrad is the size of blur_file, which is missing")
        width = props.read("blur_mrad")
        return GaussianPointSpread(1e-3 * width) if width > 0 else None
    if "blur_file_mrad" not in props:
        raise UserError("blur_file_mrad is missing: the angle [mrad] over which the image blur_file reaches")
    path = str(props["blur_file"])
    values = read_image("blur_file", path)
    if values.min() < 0 or values.max() <= 0:
        raise UserError(f"blur_file = {path!r} must hold values that are not negative and not all 0")
    return MeasuredPointSpread(values, 1e-3 * props.read("blur_file_mrad"))


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


#: Mesh attribute: foam share.
FOAM = "face_foam"


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
