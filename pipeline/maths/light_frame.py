"""The frame in which the captured light stands still: the subject's, or the camera's.

A lamp on the camera, or a subject that turns in front of a fixed camera, moves the light relative to the subject: it
stands still relative to the camera. Normals and directions are then turned into that frame before the light's spherical
harmonics are evaluated; nothing else of the rendering equation changes.

    world    the subject's own coordinates: a still subject in a still light
    camera   the camera's axes: a subject on a turntable. All points of a photo have the same frame
    flash    a lamp beside the lens: the frame's z axis is the ray from the camera to the point, x is the camera's x
             axis made perpendicular to it. So the lamp has the same direction at every point, also close to the camera,
             and its light falls off with the squared distance from the camera

Symbols: d_0 the distance at which the light has the strength of its coefficients; d the point's distance.

Source: co-located light as in IRON [Zhang et al. 2022] and Nam et al. [2018], here for any light of low order.
"""

from __future__ import annotations

from dataclasses import dataclass
from typing import Literal

import torch
from torch import Tensor

from pipeline.maths.sdf import unit

Frame = Literal["world", "camera", "flash"]
WORLD: Frame = "world"
CAMERA: Frame = "camera"
FLASH: Frame = "flash"
NEAREST = 0.05  # of d_0: smallest distance, against the pole of the falloff


@dataclass(frozen=True, slots=True)
class Stations:
    """The cameras of N points: eye (N, 3) centres; axes (N, 3, 3), their columns the camera's x, y and z axis (right,
    down, forward) in asset coordinates."""

    eye: Tensor
    axes: Tensor

    def __getitem__(self, rows: Tensor) -> Stations:
        """Those of the points `rows`."""
        return Stations(self.eye[rows], self.axes[rows])


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
    if frame == CAMERA:
        return Turn(stations.axes, torch.ones_like(x[:, :1]))
    away = (x - stations.eye).norm(dim=-1, keepdim=True).clamp(min=NEAREST * distance)
    return Turn(lamp_axes(stations.axes, wo), (distance / away) ** 2)


def lamp_axes(axes: Tensor, wo: Tensor) -> Tensor:
    """(N, 3, 3) frames of `flash`: columns x, y, z with z = -wo. axes (N, 3, 3), wo (N, 3) unit.

    A point at 90 degrees to the optical axis, along x, has no such frame; x and y are then zero; no lens has such
    points in its picture.
    """
    z = -wo
    x = axes[..., 0] - (axes[..., 0] * z).sum(-1, keepdim=True) * z
    x = unit(x)
    return torch.stack([x, torch.linalg.cross(z, x), z], -1)
