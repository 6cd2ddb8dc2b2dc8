"""Shape plugin ``canopy``: plants on a bottom, leaf by leaf."""

from __future__ import annotations

import math

import mitsuba as mi
import numpy as np

from mitransient_lidar.core.errors import UserError
from mitransient_lidar.core.parameters.bottom import CANOPY
from mitransient_lidar.core.validation import FloatArray
from mitransient_lidar.physics.plants import Canopy, leaf_triangles
from mitransient_lidar.physics.sea.sea_mesh import SeaMesh
from mitransient_lidar.plugins.bases import DeclaredProperties, fill_mesh, register
from mitransient_lidar.transport.medium.nested_objects import create_object


@register("shape", CANOPY)
class CanopyShape(mi.Mesh):
    r"""Plants on a bottom (``canopy``).

    .. parameters::

    Each leaf is a flat rectangle of two triangles. ``blades`` stand on the bottom, as seagrass does, lean by
    ``bending_deg`` and face any way. ``leaves`` are squares that look in all directions alike, everywhere in the layer:
    a turbid layer with leaves of any size. Light passes plants unhindered at the angle :math:`\theta` from the vertical
    with the probability

    .. math:: P = e^{-G\,L / \cos\theta}, \quad G = \tfrac{1}{2} \text{ for leaves}, \quad
              G = \tfrac{2}{\pi} \overline{\sin\gamma} \text{ for blades at the angle } \gamma \text{ to the light},

    with the leaf area index *L* (Nilson 1971, doi:10.1016/0002-1571(71)90092-6). Laser and receiver look through the
    same gaps. The direct bottom echo is thus weakened by :math:`P`, not :math:`P^2`, unless sea ripples part the paths
    of light and view by a gap's width.

    So that gaps stay open for both, ``lidar_merging`` connects the solids in a scene with plants to the laser, instead
    of merging light on them (its parameter ``solids``).

    Plants stand in a square, on the level ``depth``, or on a ``seabed`` to which a reference is nested, as
    ``<ref id="bottom"/>`` in the scene ``seagrass``.

    .. example::

        {'type': 'canopy', 'depth': 5.0, 'leaf_area_index': 1.5, 'height': 0.8}
    """

    #: Solids of a scene with it are not merged (`WaterScene.has_shared_gaps`).
    shares_gaps = True

    def __init__(self, props: DeclaredProperties) -> None:
        read = props.read
        form = read("form")
        leaning, azimuth = read("bending_deg"), read("bending_azimuth_deg")
        if form == "leaves":
            for name in ("bending_deg", "bending_azimuth_deg", "shoot_density"):
                if name in props:
                    raise UserError(f"{name} = {props[name]:g} needs blades: form = 'leaves' has none")
        #: The plants.
        self.canopy = Canopy(
            read("leaf_area_index"),
            read("height"),
            read("leaf_width"),
            math.radians(leaning) if form == "blades" else None,
            None if azimuth is None else math.radians(azimuth),
            read("shoot_density"),
        )
        grounds = [child for _, child in props.objects() if isinstance(child, mi.Shape)]
        feet, width, length = self.canopy.leaves(read("size"), read("seed"))
        feet[:, :2] += read("centre_x"), read("centre_y")
        feet[:, 2] += _ground(props, grounds, feet)
        if (highest := float((feet[:, 2] + np.maximum(length[:, 2], 0)).max())) > 0:
            raise UserError(
                f"height = {self.canopy.height:g} of plants lets them rise to z = {highest:.3g} m: they must end below "
                "the mean sea level"
            )
        if not any(isinstance(child, mi.BSDF) for _, child in props.objects()):
            props["leaf"] = create_object("leaf", reflectance=read("reflectance"), transmittance=read("transmittance"))
        props["face_normals"] = True
        vertices, faces = leaf_triangles(feet - props.frame_origin, width, length)
        super().__init__("canopy", len(vertices), len(faces), props, has_vertex_texcoords=True)
        fill_mesh(self, SeaMesh(vertices, faces.astype(np.uint32), np.zeros((len(vertices), 2))))


def _ground(props: DeclaredProperties, grounds: list[mi.Shape], feet: FloatArray) -> FloatArray:
    """Return the heights of the bottom below places [m], shape (n,)."""
    if not grounds:
        return np.full(len(feet), -props.read("depth"))
    bottom = getattr(grounds[0], "bottom", None)
    if len(grounds) > 1 or bottom is None:
        names = ", ".join(repr(shape.id()) for shape in grounds)
        raise UserError(f"canopy: the nested shape must be one seabed, not {names}")
    from scipy.interpolate import RegularGridInterpolator

    x, y = bottom.lines()
    return np.asarray(RegularGridInterpolator((y, x), bottom.heights(x, y))(feet[:, 1::-1]))
