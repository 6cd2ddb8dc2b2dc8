"""Pilot shots, whose waveforms show which gain a receiver needs before a survey is rendered."""

from __future__ import annotations

import math
from dataclasses import replace
from typing import TYPE_CHECKING

import numpy as np
import xarray as xr

from mitransient_lidar.core.validation import FloatArray
from mitransient_lidar.physics.sea.realization import PeriodicHeights
from mitransient_lidar.physics.sea.sea_surface import SeaSurface

if TYPE_CHECKING:
    from mitransient_lidar.rendering.shots.batches import ShotBatches, ShotPoses
    from mitransient_lidar.rendering.shots.scene import ShotScene

PILOTS, _WITHIN = 128, 200.0  #: Most pilot shots, and farthest place of theirs along x and y [m].

#: Passes of pilot shots by merging and by light maps, and the relative error for which a merged pass has paths.
MERGED_PASSES, _MAP_PASSES, _ERROR = 4, 2, 0.1

#: Ratio whose multiples spread over a circle evenly, however many they are.
_GOLDEN = 0.5 + 0.5 * math.sqrt(5)


def pilot_sea(sea: SeaSurface | None, count: int) -> tuple[FloatArray, FloatArray] | None:
    """Return where pilot shots meet the sea, as `ShotPoses.other_sea`: the same in all flights and forecasts.

    Waves come from all directions: which one a survey meets is not known when a gain is chosen. None for a sea that is
    not alike everywhere.
    """
    if sea is None or not isinstance(sea.waves, PeriodicHeights) or sea.wake is not None:
        return None
    places = np.random.default_rng(0).uniform(-_WITHIN, _WITHIN, (count, 2))
    azimuth = 2 * np.pi * np.arange(count) / _GOLDEN
    return places, np.stack([np.cos(azimuth), np.sin(azimuth)], axis=-1)


def pilots_over(loaded: ShotScene, depth: FloatArray, bottom: float, first_seed: int) -> xr.Dataset:
    """Return pilot shots' light over a flat bottom.

    `loaded`: the scene, for light by maps or by merging. `depth`: bottom depths below each shot [m], at most `bottom`,
    shape (PILOTS,); without effect on merged light. `bottom`: depth of the scene's bottom [m]. `first_seed`: the first
    shot's seed.
    """
    from mitransient_lidar.rendering.shots.batches import ShotPoses, share_for_error
    from mitransient_lidar.rendering.shots.truth import sea_of

    poses = ShotPoses(np.zeros((PILOTS, 2)), other_sea=pilot_sea(sea_of(loaded.session.scene), PILOTS))
    if loaded.light == "maps":
        return rendered(
            loaded, loaded.batches(_MAP_PASSES, 1.0, None), replace(poses, raised=bottom - depth), first_seed
        )
    return rendered(loaded, loaded.batches(MERGED_PASSES, share_for_error(_ERROR), None), poses, first_seed)


def rendered(loaded: ShotScene, batches: ShotBatches, poses: ShotPoses, first_seed: int) -> xr.Dataset:
    """Return the light for any number of shots, as a series contains it."""
    from mitransient_lidar.rendering.shots.batches import ReceivedShots

    numbers = first_seed + np.arange(len(poses))
    parts = [batches.render(poses.part(part), numbers[part].tolist()) for part in batches.parts(len(poses))]
    attributes = loaded.attributes(used=batches.used_values, passes=batches.passes)
    series: xr.Dataset = loaded.dataset(ReceivedShots.joined(parts), attributes)
    return series
