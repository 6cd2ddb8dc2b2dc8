"""Places and poses of shots in the frame of one lidar, in which they are rendered together."""

from __future__ import annotations

from dataclasses import dataclass, replace

import drjit as dr
import mitsuba as mi
import numpy as np
import numpy.typing as npt

from mitransient_lidar.core.validation import FloatArray, IntArray
from mitransient_lidar.physics.lidar.pose import Pose
from mitransient_lidar.transport.medium.bubble_plume import BubblePlume
from mitransient_lidar.transport.medium.water import Water
from mitransient_lidar.transport.opaque import aligned
from mitransient_lidar.transport.pose import KernelPose
from mitransient_lidar.transport.scene import LidarScene, ScenePart


@dataclass(frozen=True)
class ShotPoses:
    """Places of shots, and poses that differ from that of the lidar.

    The frame of a shot is turned about the vertical, so that its receiver differs least from that of the lidar, and
    displaced, so that the receiver's axis meets the mean sea level where the lidar's does.

    Attributes
    ----------
    places
        Points (x, y) in the scene where the receiver's axes meet the mean sea level [m], shape (shots, 2).
    turns
        Cosine and sine of the rotations about the vertical, shape (shots, 2); None without any difference.
    receiver, transmitter
        Poses in the frame of each shot; None where all are those of the lidar.
    in_scene
        Poses of the receiver in the scene; None where they follow from the places.
    """

    places: FloatArray
    turns: FloatArray | None = None
    receiver: KernelPose | None = None
    transmitter: KernelPose | None = None
    in_scene: Pose | None = None

    @classmethod
    def of_receiver(cls, lidar: LidarScene, receiver: Pose) -> ShotPoses:
        """Return the poses of shots of a lidar whose receiver has given ones in the scene, arrays of shape (shots, 3).

        The transmitter is fixed to the receiver. All axes must go down.
        """
        own = lidar.receiver.pose
        places = receiver.ground_point()
        # The rotation from the lidar to each shot, and that about the vertical which is nearest to it.
        whole = np.swapaxes(receiver.frame, 1, 2) @ own.frame
        azimuth = whole[:, 0, 0] + whole[:, 1, 1] + 1j * (whole[:, 1, 0] - whole[:, 0, 1])
        turns = azimuth / np.abs(azimuth)
        to_frame = _rotations(np.conj(turns))
        centre = own.ground_point()
        origin = np.squeeze(to_frame @ (receiver.origin - places)[..., None], -1) + centre
        rotation = to_frame @ whole
        shift = origin - rotation @ own.origin
        own_receiver, own_transmitter = (pose.moved(rotation, shift) for pose in (own, lidar.transmitter.pose))
        cos_sin = np.stack([turns.real, turns.imag], axis=-1)
        return cls(places[:, :2], cos_sin, own_receiver, own_transmitter, receiver)

    def __len__(self) -> int:
        return len(self.places)

    def part(self, rows: slice | IntArray) -> ShotPoses:
        """Return some of the shots."""
        turns = None if self.turns is None else self.turns[rows]
        receiver = None if self.receiver is None else self.receiver.part(rows)
        transmitter = None if self.transmitter is None else self.transmitter.part(rows)
        in_scene = None if self.in_scene is None else self.in_scene.part(rows)
        return ShotPoses(self.places[rows], turns, receiver, transmitter, in_scene)

    def repeated(self, copies: int) -> ShotPoses:
        """Return each shot several times in turn."""
        return self.part(np.repeat(np.arange(len(self)), copies))

    def delayed(self, lengths: FloatArray) -> ShotPoses:
        """Return the shots with a length added to their optical paths [m], shape (shots,)."""
        return replace(self, receiver=None if self.receiver is None else replace(self.receiver, delay=lengths))

    def scene_part(self, shapes: mi.Scene, positions: FloatArray | None, aim: FloatArray) -> ScenePart:
        """Return shapes as the shots meet them.

        Parameters
        ----------
        shapes
            The shapes.
        positions
            Points (x, y) among them of the shots' places [m], shape (shots, 2); None for shapes that go with the lidar.
        aim
            Place (x, y) of the lidar in its frame [m], shape (2,).
        """
        if positions is None:
            positions = np.broadcast_to(aim, (len(self), 2))
        if self.turns is None:
            return ScenePart(shapes, _vectors(positions - aim))
        turned = (self.turns[:, 0] + 1j * self.turns[:, 1]) * complex(*aim)
        by = positions - np.stack([turned.real, turned.imag], axis=-1)
        cos, sin = (aligned(mi.Float, column.astype(np.float32)) for column in self.turns.T)
        return ScenePart(shapes, _vectors(by), mi.Vector2f(cos, sin))

    def water(self, water: Water | None, place: FloatArray, aim: FloatArray) -> Water | None:
        """Return the water of a lidar at `aim` as a shot at a place meets it, both x, y in the lidar's frame [m]."""
        if water is None or not isinstance(water.plume, BubblePlume):
            return water
        turn = 1 + 0j if self.turns is None else complex(*self.turns[0])
        return replace(water, plume=water.plume.displaced(place, aim, turn))

    def extra_range(self, lidar: LidarScene) -> FloatArray:
        """Return the length from laser to receiver by the shared reference point beyond the lidar's own [m], (shots,).

        Times of arrival are relative to it: those of each shot begin later by this length over the speed of light.
        """
        if self.receiver is None or self.transmitter is None:
            return np.zeros(len(self))
        reference = lidar.receiver.pose.nearby_point()
        ranges = [np.linalg.norm(pose.origin - reference, axis=1) for pose in (self.receiver, self.transmitter)]
        return np.asarray(ranges[0] + ranges[1] - lidar.reference_length)


def _rotations(turns: npt.NDArray[np.complex128]) -> FloatArray:
    """Return rotations about the vertical by azimuths, shape (shots, 3, 3)."""
    found = np.zeros((len(turns), 3, 3))
    found[:, 0, 0] = found[:, 1, 1] = turns.real
    found[:, 1, 0], found[:, 0, 1] = turns.imag, -turns.imag
    found[:, 2, 2] = 1.0
    return found


def _vectors(horizontal: FloatArray) -> mi.Vector3f:
    """Return horizontal vectors, shape (n, 2)."""
    x, y = (aligned(mi.Float, column.astype(np.float32)) for column in horizontal.T)
    return mi.Vector3f(x, y, dr.zeros(mi.Float, len(horizontal)))
