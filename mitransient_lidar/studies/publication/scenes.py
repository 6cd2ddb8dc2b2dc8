"""Scenes of the publication's figures, and their geometry."""

from __future__ import annotations

import math
from dataclasses import dataclass

import numpy as np
import xarray as xr

from mitransient_lidar.core.validation import FloatArray
from mitransient_lidar.loading.catalogue import scene_parameters
from mitransient_lidar.physics.lidar.level_sea import LidarGeometry
from mitransient_lidar.rendering.shots.truth import Shot
from mitransient_lidar.studies.publication.renders import Renders
from mitransient_lidar.transport.sensor.outlines import pixel_outlines

#: One pixel and four over a flat bottom, a sphere, and a target below a mast.
SINGLE, FOUR, MINE, MAST = "fig09_1x1", "fig09_2x2", "fig02_mine", "fig04_mast"

#: A square target in 2x2 and in 1x4 pixels, and four pixels and one over water in two layers.
SQUARE, STRIPS, LAYERED_FOUR, LAYERED_SINGLE = "fig13_2x2", "fig14_1x4", "fig15_2x2", "fig15_1x1"

#: Scenes of the pixel layouts that figure 8 shows, and of the three shots on waves, whose bins are narrower [ns].
LAYOUTS = (SINGLE, FOUR, STRIPS)
SHOTS, _BIN_WIDTH_NS = ("fig11_shot1", "fig11_shot2", "fig11_shot3"), 0.25

#: Depth of the water's change [m].
_LAYER_DEPTH = 3.0


@dataclass(frozen=True, kw_only=True)
class System(LidarGeometry):
    """Lidar in a scene: divergence and field of view [rad], and bottom depth [m]."""

    divergence: float
    field_of_view: float
    bottom_depth: float

    @classmethod
    def of(cls, scene: str) -> System:
        """Read a scene's parameters."""
        values = scene_parameters(scene)
        return cls(
            float(values["altitude"]),
            math.radians(float(values["off_nadir_deg"])),
            *(float(values[name]) for name in ("refractive_index", "group_index")),
            divergence=1e-3 * float(values["divergence_mrad"]),
            field_of_view=1e-3 * float(values["field_of_view_mrad"]),
            bottom_depth=float(values["bottom_depth"]),
        )


def outlines(renders: Renders, scene: str) -> list[list[FloatArray]]:
    """Return the outlines (angle_x, angle_y) [rad] of each pixel in a scene."""
    return [list(lines) for lines in pixel_outlines(renders.session(scene).sensor.receiver.pixels)]


def shot_places(renders: Renders) -> list[Shot]:
    """Return locations and mean slopes over the beam's footprint for the three shots, which share one sea."""
    sea, found = renders.sea(SHOTS[0]), []
    for number, scene in enumerate(SHOTS, start=1):
        values = scene_parameters(scene)
        x, y = float(values["aim_x"]), float(values["aim_y"])
        found.append(Shot(f"shot {number}", x, y, *sea.slope_at(x, y)))
    return found


def shot_slopes(renders: Renders) -> list[tuple[float, float]]:
    """Return the mean slopes (along, across) [1] of the three shots."""
    return [(shot.along, shot.across) for shot in shot_places(renders)]


def three_shots(renders: Renders) -> list[xr.Dataset]:
    """Return the renders of the three shots, which figures 10 and 11 share."""
    return [renders.shot(scene, bin_width_ns=_BIN_WIDTH_NS) for scene in SHOTS]


def layer_times(result: xr.Dataset) -> FloatArray:
    """Return when light from the change of the water is expected in each pixel [ns]."""
    return np.asarray(result["surface_time"].values + _LAYER_DEPTH / result["depth_per_ns"].values)
