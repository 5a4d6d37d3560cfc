"""Shadows and interreflections: share of the unoccluded irradiance that arrives at a point of the surface.

    E(x) = integral over the hemisphere of n:  V L(w) cos + (1 - V) L_o(y) cos,     s(x) = E(x) / E_open(n)

Symbols: V 1 where the ray x + t w leaves the volume, else it hits y; L the SH light, not below 0; L_o = a E / pi the
diffuse radiance that leaves y; E_open the same integral with V = 1. s is stored per colour on a coarse grid around the
surface; the diffuse term is a / pi s(x) E_open(n), with E_open from the closed form and the fine normal.

Differs: [NeuFace eq. 16] has s = 1, so that its albedo contains the shadows under chin, brow and nose. s needs no
gradient: it is recomputed a few times during the fit from the present surface, skin and light, and converges with them.

Source: the rendering equation (Kajiya 1986) with a fixed set of directions; bounces as in radiosity, one pass per
bounce.
"""

from __future__ import annotations

import math
from dataclasses import dataclass

import numpy as np
import numpy.typing as npt
import torch
from torch import Tensor, nn
from torch.nn import functional

from pipeline.fields.parts import Geometry
from pipeline.maths import sh
from pipeline.maths.sdf import unit
from pipeline.maths.tracing import box_interval
from pipeline.nearest import filled

CELLS = 64  # of the grid along the longest side
NEAR_CELLS = 1.8  # nodes within this distance of the surface are solved: all corners of cells that it crosses
LIFT_CELLS = 1.0  # cells of the SDF: rays start this far above the surface, so that its noise casts no shadow
RANGE = (0.02, 2.0)  # of s
RAYS = 1 << 18  # at a time

F64 = npt.NDArray[np.float64]


class Shadowing(nn.Module):
    """s(x) on a grid of nodes at lo + i cell. 1 everywhere until it is solved."""

    ratio: Tensor
    lo: Tensor
    solved: Tensor

    def __init__(self, lo: tuple[float, float, float], hi: tuple[float, float, float], cells: int = CELLS) -> None:
        super().__init__()
        extent = [b - a for a, b in zip(lo, hi, strict=True)]
        self.cell = max(extent) / cells
        shape = [math.ceil(e / self.cell) + 1 for e in extent]
        self.register_buffer("ratio", torch.ones(3, *shape))
        self.register_buffer("lo", torch.tensor(lo))
        self.register_buffer("solved", torch.tensor(False))

    def forward(self, x: Tensor) -> Tensor:
        """s (N, 3) at x (N, 3), trilinear; no gradient."""
        return trilinear(self.ratio, self.lo, self.cell, x.detach())

    def nodes(self) -> Tensor:
        """(X Y Z, 3) positions of the nodes."""
        axes = [torch.arange(n, device=self.lo.device) for n in self.ratio.shape[1:]]
        return self.lo + self.cell * torch.stack(torch.meshgrid(*axes, indexing="ij"), -1).reshape(-1, 3)


def trilinear(grid: Tensor, lo: Tensor, cell: float, x: Tensor) -> Tensor:
    """(N, C) values at x (N, 3) of a grid (C, X, Y, Z) with nodes at lo + i cell, constant outside it."""
    top = torch.tensor(grid.shape[1:], device=x.device) - 1
    at = 2 * (x - lo) / (cell * top) - 1
    found = functional.grid_sample(
        grid[None], at.flip(-1)[None, :, None, None], mode="bilinear", padding_mode="border", align_corners=True
    )
    return found[0, :, :, 0, 0].T


@dataclass(frozen=True, slots=True)
class Surface:
    """The nodes that are solved: flat index (M,), their nearest surface point (M, 3), its normal, its albedo."""

    index: Tensor
    x: Tensor
    n: Tensor
    albedo: Tensor


@dataclass(frozen=True, slots=True)
class Arrivals:
    """Light that reaches M points. open, sky (M, 3): irradiance without and with occlusion by the surface. Blocked
    rays: index of the point (R,), hit position (R, 3), weight (R,) = cos dw."""

    open: F64
    sky: F64
    point: npt.NDArray[np.int64]
    end: Tensor
    weight: F64


def solve(
    shadowing: Shadowing, geometry: Geometry, surface: Surface, light: Tensor, directions: int = 256, bounces: int = 2
) -> None:
    """Fill the grid from the present surface, albedo and light ((L + 1)^2, 3), in place."""
    with torch.no_grad():
        if not len(surface.index):
            return
        got = arrivals(geometry, surface, light, directions)
        floor = 1e-3 * float(got.open.mean()) + 1e-12
        ratio = _ratio(got.sky, got.open, floor)
        for _ in range(bounces):
            leaving = surface.albedo.double().cpu().numpy() / math.pi * ratio * got.open
            grid = _spread(shadowing, surface.index, leaving)
            bounced = trilinear(grid, shadowing.lo, shadowing.cell, got.end).double().cpu().numpy()
            indirect = np.stack(
                [np.bincount(got.point, bounced[:, k] * got.weight, minlength=len(ratio)) for k in range(3)], 1
            )
            ratio = _ratio(got.sky + indirect, got.open, floor)
        shadowing.ratio.copy_(_spread(shadowing, surface.index, ratio))
        shadowing.solved.fill_(True)


def near_surface(shadowing: Shadowing, geometry: Geometry) -> tuple[Tensor, Tensor, Tensor]:
    """Flat index (M,) of the nodes beside the surface, the surface point of each (M, 3) and its normal (M, 3)."""
    with torch.no_grad():
        nodes = shadowing.nodes()
        s, _ = geometry(nodes)
        index = torch.nonzero(s.abs() < NEAR_CELLS * shadowing.cell).squeeze(-1)
        x = nodes[index]
        for _ in range(3):  # Newton steps, because the far field is a coarse distance
            s, g = geometry(x)
            x = x - (s / (g * g).sum(-1).clamp(min=0.25)).clamp(-shadowing.cell, shadowing.cell)[:, None] * g
        s, g = geometry(x)
        good = s.abs() < geometry.cell
        return index[good], x[good], unit(g[good])


def arrivals(geometry: Geometry, surface: Surface, light: Tensor, directions: int) -> Arrivals:
    """Trace every direction of each point's hemisphere."""
    d = fibonacci(directions).to(surface.x)
    radiance = sh.radiance(light.detach(), d).clamp(min=0)
    solid = 4 * math.pi / directions
    parts: list[tuple[F64, F64, npt.NDArray[np.int64], Tensor, F64]] = []
    size = max(RAYS // directions, 1)
    for first in range(0, len(surface.x), size):
        x, n = surface.x[first : first + size], surface.n[first : first + size]
        weight = (n @ d.T).clamp(min=0) * solid
        point, way = torch.nonzero(weight > 0, as_tuple=True)
        o = x[point] + LIFT_CELLS * geometry.cell * n[point]
        near, far = box_interval(o, d[way], *geometry.box())
        t, hit, s = geometry.trace(o, d[way], near, far)
        hit = hit | (s <= 0)  # in a crease the lifted start may be inside the opposite wall
        free = weight.clone()
        free[point[hit], way[hit]] = 0
        end = (o + t[:, None] * d[way])[hit]
        parts.append(
            (
                (weight @ radiance).double().cpu().numpy(),
                (free @ radiance).double().cpu().numpy(),
                (point[hit] + first).cpu().numpy(),
                end,
                weight[point[hit], way[hit]].double().cpu().numpy(),
            )
        )
    opened, sky, point_of, ends, weights = zip(*parts, strict=True)
    return Arrivals(
        np.concatenate(opened), np.concatenate(sky), np.concatenate(point_of), torch.cat(ends), np.concatenate(weights)
    )


def fibonacci(count: int) -> Tensor:
    """(count, 3) unit directions, evenly distributed on the sphere."""
    i = torch.arange(count, dtype=torch.float64) + 0.5
    z = 1 - 2 * i / count
    angle = math.pi * (3 - math.sqrt(5)) * i
    r = torch.sqrt(1 - z * z)
    return torch.stack([r * torch.cos(angle), r * torch.sin(angle), z], -1).float()


def _ratio(arriving: F64, opened: F64, floor: float) -> F64:
    """Their quotient; 1 where there is no light."""
    return np.asarray(((arriving + floor) / (opened + floor)).clip(*RANGE), np.float64)


def _spread(shadowing: Shadowing, index: Tensor, values: F64) -> Tensor:
    """A grid (3, X, Y, Z) with values (M, 3) at the solved nodes; other nodes take the value of the nearest one."""
    shape = tuple(shadowing.ratio.shape[1:])
    flat = index.cpu().numpy()
    known = np.zeros(math.prod(shape), bool)
    known[flat] = True
    grid = np.zeros((len(known), 3), np.float32)
    grid[flat] = values
    every = filled(grid.reshape(*shape, 3), known.reshape(shape))
    return torch.from_numpy(np.ascontiguousarray(np.moveaxis(every, -1, 0))).to(shadowing.ratio)
