"""The frame in which the captured light stands still: the subject's, or the camera's.

A lamp on the camera, or a subject that turns in front of a fixed camera, moves the light relative to the subject: it
stands still relative to the camera. Normals and directions are then turned into that frame before the light's spherical
harmonics are evaluated; nothing else of the rendering equation changes.

    world    the subject's own coordinates: a still subject in a still light
    turntable  a subject that turns about +Y while camera and room stand still: the camera's axes without its tilt, so
             that the camera may be raised between rounds. z is level and points forward, y points down
    camera   the camera's axes: lamps that are far away and fixed to the camera
    flash    a lamp beside the lens: the frame's z axis is the ray from the camera to the point, x is the camera's x
             axis made perpendicular to it. So the lamp has the same direction at every point, also close to the camera,
             and its light falls off with the squared distance from the camera

Symbols: d_0 the distance at which the light has the strength of its coefficients; d the point's distance.

Source: co-located light as in IRON [Zhang et al. 2022] and Nam et al. [2018], here for any light of low order.
"""

from __future__ import annotations

from dataclasses import dataclass

import torch
from torch import Tensor

from pipeline.maths.sdf import unit

WORLD, TURNTABLE, CAMERA, FLASH = "world", "turntable", "camera", "flash"
MOVING = (TURNTABLE, CAMERA, FLASH)
NEARLY_LEVEL = 1e-3  # share of the picture's upward direction in that of a camera that looks straight down
NEAREST = 0.05  # of d_0: smallest distance, against the pole of the falloff


@dataclass(frozen=True, slots=True)
class Stations:
    """The cameras of N points: eye (N, 3) centres; axes (N, 3, 3), their columns the camera's x, y and z axis (right,
    down, forward) in asset coordinates. second (N,): whether the photo is of the second capture, which has another
    light; None: none is."""

    eye: Tensor
    axes: Tensor
    second: Tensor | None = None

    def __getitem__(self, rows: Tensor) -> Stations:
        """Those of the points `rows`."""
        return Stations(self.eye[rows], self.axes[rows], None if self.second is None else self.second[rows])


@dataclass(frozen=True, slots=True)
class Turn:
    """Into the light's frame, at N points: axes (N, 3, 3) with the frame's axes as columns; strength (N, 1) of the
    light there."""

    axes: Tensor
    strength: Tensor

    def __call__(self, directions: Tensor) -> Tensor:
        """Directions (N, 3) of the asset in the light's frame."""
        return torch.einsum("nij,ni->nj", self.axes, directions)


def turn_of(frame: str, stations: Stations, x: Tensor, wo: Tensor, distance: float) -> Turn:
    """The frame of a moving light at points x with unit wo, (N, 3) each. distance: d_0 > 0, for `flash`."""
    if frame != FLASH:
        axes = stations.axes if frame == CAMERA else level_axes(stations.axes)
        return Turn(axes, torch.ones_like(x[:, :1]))
    away = (x - stations.eye).norm(dim=-1, keepdim=True).clamp(min=NEAREST * distance)
    return Turn(lamp_axes(stations.axes, wo), (distance / away) ** 2)


def level_axes(axes: Tensor) -> Tensor:
    """(N, 3, 3) frames of `turntable`: columns x = y cross z, y = (0, -1, 0), z level. axes (N, 3, 3) of the cameras.

    z is the level part of the forward axis; straight down, where it has none, that of the picture's upward direction.
    """
    z = axes[..., 2] + NEARLY_LEVEL * axes[..., 1:2, 2] * axes[..., 1]
    z = unit(z * z.new_tensor([1.0, 0.0, 1.0]))
    y = z.new_tensor([0.0, -1.0, 0.0]).expand_as(z)
    return torch.stack([torch.linalg.cross(y, z), y, z], -1)


def lamp_axes(axes: Tensor, wo: Tensor) -> Tensor:
    """(N, 3, 3) frames of `flash`: columns x, y, z with z = -wo. axes (N, 3, 3), wo (N, 3) unit.

    A point at 90 degrees to the optical axis, along x, has no such frame; x and y are then zero; no lens has such
    points in its picture.
    """
    z = -wo
    x = axes[..., 0] - (axes[..., 0] * z).sum(-1, keepdim=True) * z
    x = unit(x)
    return torch.stack([x, torch.linalg.cross(z, x), z], -1)
