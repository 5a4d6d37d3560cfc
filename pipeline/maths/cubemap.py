"""A cube map as a function on the sphere: directions of its texels, and a seamless lookup.

Symbols: R texels along a face's edge, T = 6 R^2 texels in all, face by face (+x -x +y -y +z -z), rows before columns;
(u, v) in [-1, 1] on a face. Directions are (N, 3), of any length but 0.
"""

from __future__ import annotations

from functools import lru_cache

import torch
from torch import Tensor

from pipeline.maths.precision import full_precision

# axis that a face looks along, and the axes along which u and v grow
FACES = torch.tensor(
    [
        [[1, 0, 0], [0, 0, -1], [0, -1, 0]],
        [[-1, 0, 0], [0, 0, 1], [0, -1, 0]],
        [[0, 1, 0], [1, 0, 0], [0, 0, 1]],
        [[0, -1, 0], [1, 0, 0], [0, 0, -1]],
        [[0, 0, 1], [1, 0, 0], [0, -1, 0]],
        [[0, 0, -1], [-1, 0, 0], [0, -1, 0]],
    ],
    dtype=torch.float64,
)


@lru_cache(maxsize=8)
def texel_directions(size: int) -> Tensor:
    """Unit directions of texel centres: (T, 3) float64."""
    return torch.nn.functional.normalize(_on_faces(size, 0).reshape(-1, 3), dim=-1)


@lru_cache(maxsize=8)
def solid_angles(size: int) -> Tensor:
    """Exact solid angle of every texel: (T,) float64, summing to 4 pi.

    The integral of (1 + u^2 + v^2)^(-3/2) over a rectangle: atan2(u v, sqrt(u^2 + v^2 + 1)) at its corners.
    """
    edge = torch.linspace(-1, 1, size + 1, dtype=torch.float64)
    u, v = torch.meshgrid(edge, edge, indexing="ij")
    corner = torch.atan2(u * v, torch.sqrt(u * u + v * v + 1))
    one = corner[1:, 1:] - corner[1:, :-1] - corner[:-1, 1:] + corner[:-1, :-1]
    return one.reshape(-1).repeat(6)


def _on_faces(size: int, pad: int) -> Tensor:
    """Points of the planes of all faces at texel centres, `pad` texels beyond the edges: (6, n, n, 3)."""
    t = (torch.arange(-pad, size + pad, dtype=torch.float64) + 0.5) * 2 / size - 1
    v, u = torch.meshgrid(t, t, indexing="ij")
    axis, right, down = (FACES[:, i, None, None] for i in range(3))
    return axis + u[None, ..., None] * right + v[None, ..., None] * down


@lru_cache(maxsize=8)
def padded(size: int) -> Tensor:
    """Index of the texel at every position of the faces, with a border of one texel of the neighbouring faces:
    (6, R + 2, R + 2)."""
    face, u, v = project(_on_faces(size, 1).reshape(-1, 3))
    column, row = (((t + 1) * size / 2).floor().long().clamp(0, size - 1) for t in (u, v))
    return ((face * size + row) * size + column).reshape(6, size + 2, size + 2)


def project(d: Tensor) -> tuple[Tensor, Tensor, Tensor]:
    """Face (N,) int64 and u, v (N,) in [-1, 1] of directions; differentiable in d but for the choice of the face."""
    axis = d.detach().abs().argmax(-1)
    along = d.gather(-1, axis[:, None]).squeeze(-1)
    face = 2 * axis + (along.detach() < 0)
    frame = FACES.to(d)[face]
    reach = along.abs().clamp(min=torch.finfo(d.dtype).tiny)
    return face, (frame[:, 1] * d).sum(-1) / reach, (frame[:, 2] * d).sum(-1) / reach


def corners(d: Tensor, size: int) -> tuple[Tensor, Tensor]:
    """The four texels around each direction and their bilinear weights: (N, 4) int64, (N, 4)."""
    face, u, v = project(d)
    x, y = ((t + 1) * size / 2 + 0.5 for t in (u, v))  # in padded texels
    column, row = (t.detach().floor().long().clamp(0, size) for t in (x, y))
    fx, fy = (x - column).clamp(0, 1), (y - row).clamp(0, 1)
    table = padded(size).to(d.device)
    at = torch.stack([table[face, row + j, column + i] for j in (0, 1) for i in (0, 1)], -1)
    return at, torch.stack([(1 - fx) * (1 - fy), fx * (1 - fy), (1 - fx) * fy, fx * fy], -1)


@full_precision
def lookup(levels: Tensor, d: Tensor, level: Tensor) -> Tensor:
    """Radiance (N, 3) towards d (N, 3) at fractional `level` (N,) of a stack of blurred maps (K, T, 3)."""
    count, texels = levels.shape[:2]
    at, w = corners(d, round((texels / 6) ** 0.5))
    lower = level.detach().floor().long().clamp(0, max(count - 2, 0))
    share = (level - lower).clamp(0, 1)[:, None]
    flat = levels.reshape(-1, 3)
    below = (flat[lower[:, None] * texels + at] * w[..., None]).sum(1)
    if count == 1:
        return below
    above = (flat[(lower[:, None] + 1) * texels + at] * w[..., None]).sum(1)
    return below * (1 - share) + above * share


def blur(size: int, kernel: Tensor) -> Tensor:
    """(T, T) matrix that blurs a map with a zonal kernel, given at every pair of texels (T, T): kernel times solid
    angle, normalised to rows that sum to 1, so that a uniform light does not change."""
    w = kernel * solid_angles(size).to(kernel)
    return w / w.sum(-1, keepdim=True)
