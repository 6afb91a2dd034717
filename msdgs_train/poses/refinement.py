"""Corrections of the poses of training cameras.

A motion of the camera is the inverse motion of all Gaussians: its gradient is a sum over theirs, and the rasterizer
needs none in the camera. Spherical harmonics keep their axes, so that they are seen from a direction that is off by the
rotation, some thousandths of a radian.
"""

from collections.abc import Sequence

import torch
from torch import nn

from msdgs_serve.scene import Camera
from msdgs_train.datasets import Frame
from msdgs_train.gaussians.model import PosedGaussians
from msdgs_train.layers.arrays import to_device
from msdgs_train.layers.parameters import LearningRate, ParamGroup
from msdgs_train.layers.quaternions import multiply, rotate, unit
from msdgs_train.poses.config import PoseConfig

DISTANCE = 4.0
"""Unit of translations, in scene units: cameras are about as far from the scene, so that a step of a translation moves
an image as much as one of a rotation."""


class PoseRefinement(nn.Module):
    """A rotation vector around each camera's center, and a translation, in the scene's axes. Their means over the
    cameras are 0: the scene stays where the given poses have it. Images of a camera that stands still share them."""

    def __init__(self, config: PoseConfig, frames: Sequence[Frame]) -> None:
        super().__init__()
        self._lr = LearningRate(config.pose_opt_lr_init, config.pose_opt_lr_final, holds=True)
        self._rows = {pose: row for row, pose in enumerate(dict.fromkeys(_key(frame.camera) for frame in frames))}
        self.twists = nn.Parameter(torch.zeros(len(self._rows), 6))

    def seen(self, posed: PosedGaussians, camera: Camera) -> PosedGaussians:
        """The Gaussians as the refined camera sees them, in the axes of the given one."""
        rotation, translation = self.twists[self._rows[_key(camera)]].split(3)
        back = unit(torch.cat([rotation.new_ones(1), -rotation / 2])[None])  # off by angle³ / 12
        turned_axes = rotate(back, torch.eye(3, dtype=back.dtype, device=back.device))
        turned_units = multiply(back.expand(4, 4), torch.eye(4, dtype=back.dtype, device=back.device))
        center = to_device(torch.tensor(camera.position).to(posed.means.dtype), posed.means.device)
        means = torch.addmm(center, posed.means - (center + DISTANCE * translation), turned_axes)
        return posed._replace(means=means, quats=posed.quats @ turned_units)

    def parameter_group(self) -> ParamGroup:
        """All corrections, with their learning rate."""
        return ParamGroup("poses", [self.twists], self._lr)

    @torch.no_grad()
    def center(self) -> None:
        """Subtract the mean over the cameras."""
        self.twists.sub_(self.twists.mean(dim=0))


def _key(camera: Camera) -> bytes:
    return camera.camera_to_world.tobytes()
