"""Integrator plugin ``passive_volpath``: images by daylight."""

from __future__ import annotations

import dataclasses

import drjit as dr
import mitsuba as mi

from mitransient_lidar.core.validation import in_range
from mitransient_lidar.plugins.bases import recorded
from mitransient_lidar.plugins.lidar_volpath import VolpathIntegrator
from mitransient_lidar.transport.daylight.renderer import DaylightRecord, DaylightRenderer
from mitransient_lidar.transport.daylight.scene import DaylightScene


class PassiveVolpath(VolpathIntegrator):
    r"""Volumetric path tracer for images by daylight (``passive_volpath``).

    =========================  =======  ================================================================================
    Parameter                  Type     Meaning
    =========================  =======  ================================================================================
    paths_per_pass             integer  Paths of one pass, 1024 to 2^28, unless the sample count per pixel (``spp``) is
                                        given to ``mi.render``. Default: 262144
    guiding_probability        float    Probability, at scattering events, that the direction is drawn from a lobe
                                        towards the sun, 0 to 0.99. Large values give a few paths very large weights.
                                        Without a sun there is no lobe. Default: 0.15
    solid_guiding_probability  float    The same at hits of rough solids under water, with a narrower lobe, times the
                                        share of the sunlight that is scattered above the solid, 0 to 0.99. Default: 0.9
    roulette_threshold         float    Expected contribution below which Russian roulette begins, 0 to 1: throughput
                                        times radiance under water, relative to its mean over all directions, which is
                                        assumed to be largest about the refracted sun. Default: 0.1
    max_scatterings            integer  As for ``lidar_volpath``
    =========================  =======  ================================================================================

    Renders the radiance of each pixel [W m^-2 sr^-1 nm^-1]. Paths start uniformly over the field of view and are traced
    as in ``lidar_volpath``, where the sun replaces the laser: each path is connected to one point of the sun's disc.
    Paths that leave the scene meet the sky; the sky that the sea reflects is sampled by a separate ray, as few paths
    are reflected.

    The sea must be rough, as every ``ocean_surface`` is: through a smooth ``dielectric`` paths meet the sun's disc only
    by chance, and the image is noisy. Distances to scattering events are drawn from the scattering coefficient, and
    absorption is a weight.

    Light from outside the surface mesh is lost. The air is clear; the receiver's optics do not affect the radiance.
    There are no derivatives.

    .. code-block:: xml

        <integrator type="passive_volpath">
            <integer name="paths_per_pass" value="262144"/>
        </integrator>

    .. code-block:: python

        {'type': 'passive_volpath', 'paths_per_pass': 262144}
    """

    plugin = "passive_volpath"
    passive = True
    roulette_threshold = 0.1

    def __init__(self, props: mi.Properties) -> None:
        super().__init__(props, 0.15)
        on_solids = props.get("solid_guiding_probability", 0.9)
        self.options = dataclasses.replace(
            self.options,
            solid_guiding_probability=in_range("solid_guiding_probability", on_solids, 0.0, 0.99),
            expects_emitter=True,
            weights_absorption=True,
        )

    def prepare(self, scene: mi.Scene, sensor: mi.Sensor) -> DaylightRenderer:
        """Return the renderer of passes of a scene; raise UserError when a part is missing or not supported."""
        return DaylightRenderer(DaylightScene.from_scene(scene, sensor), self.options, self.paths_per_pass)

    def develop(self, record: DaylightRecord, sensor: mi.Sensor) -> mi.TensorXf:
        """Return the radiance [W m^-2 sr^-1 nm^-1] of a pass, 0 where no path started."""
        pixels = sensor.receiver.pixels
        radiance = dr.select(record.sampled > 0, record.found / record.sampled, 0)
        return mi.TensorXf(mi.Float(radiance), shape=pixels.grid or (pixels.count,))


mi.register_integrator("passive_volpath", recorded(PassiveVolpath))
