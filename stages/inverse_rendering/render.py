"""Rendering of a batch of rays: sphere tracing, samples in a thin shell, weights, shading. [NeuFace section 4.4]

Symbols: t_0 hit or closest approach; samples at t_0 +- w, w wide enough that the shell crosses the soft surface at any
angle; tau optical depth; x_s, n the point and normal averaged by the weights of [NeuFace eq. 18].

How the samples become opacity and radiance is a part of the model (pipeline.fields.parts.RayRendering).
"""

from __future__ import annotations

from dataclasses import dataclass

import torch
from torch import Tensor

from pipeline.fields.face import FaceModel
from pipeline.fields.parts import RayPoints, Shaded
from pipeline.maths.density import OPAQUE
from pipeline.maths.sdf import unit
from pipeline.maths.tracing import box_interval
from stages.inverse_rendering.ray_sampling import Rays

SHELL_CELLS, SHELL_BETAS = 1.5, 4.0
MIN_COSINE = 0.25
LAYERS = 3
REACH_BETAS = 12.0  # a ray with a larger closest approach has an opacity below e^-12


@dataclass(frozen=True, slots=True)
class Shell:
    """Samples of M kept rays of a batch of N: kept (M,) indices, tau (M,), x (M, 3), n (M, 3), hit (M,), end (M,) the t
    behind the last sample, the raw gradient at every sample (M * S, 3) for the eikonal term, and all samples' t and
    shares of the ray's weight (M, S)."""

    kept: Tensor
    tau: Tensor
    end: Tensor
    x: Tensor
    n: Tensor
    hit: Tensor
    gradient: Tensor
    t: Tensor
    share: Tensor


def sample_shell(
    model: FaceModel, rays: Rays, samples: int, jitter: Tensor | None, keep: Tensor | None, start: Tensor | None = None
) -> Shell:
    """Trace the rays and weight samples around the surface. `jitter` (N, S) in [0, 1), default the centre of each
    interval. `keep`: (N,) rays that are kept even if they pass far from the surface. `start`: (N,) first t."""
    geometry = model.geometry
    near, far = box_interval(rays.o, rays.d, *geometry.box())
    near = near if start is None else torch.maximum(near, start)
    t0, hit, s0 = geometry.trace(rays.o, rays.d, near, far)
    wanted = (far > near) & (hit | (s0 < REACH_BETAS * float(model.beta)))
    if keep is not None:
        wanted |= (far > near) & keep
    kept = torch.nonzero(wanted).squeeze(-1)
    o, d, t0, hit = rays.o[kept], rays.d[kept], t0[kept], hit[kept]
    w = _half_width(model, o + t0[:, None] * d, d)
    u = (torch.arange(samples, device=o.device) + (0.5 if jitter is None else jitter[kept])) / samples
    t = t0[:, None] + w[:, None] * (2 * u - 1)
    x = o[:, None] + t[..., None] * d[:, None]
    s, g = geometry(x.reshape(-1, 3))
    weights, tau = model.rendering.weights(s.reshape(t.shape), w, hit, model.beta)
    share = weights / weights.sum(-1, keepdim=True).clamp(min=1e-8)
    x_s = o + (share * t).sum(-1, keepdim=True) * d
    n = unit((share[..., None] * g.reshape(*t.shape, 3)).sum(1))
    return Shell(kept, tau, t0 + w, x_s, n, hit, g, t, share)


def _half_width(model: FaceModel, x: Tensor, d: Tensor) -> Tensor:
    """w (M,): wide enough that the SDF covers +-(SHELL_CELLS cells, SHELL_BETAS beta) at this angle."""
    with torch.no_grad():
        cosine = (unit(model.geometry(x)[1]) * d).sum(-1).abs().clamp(min=MIN_COSINE)
    return max(SHELL_CELLS * model.geometry.cell, SHELL_BETAS * float(model.beta)) / cosine


def shade_shell(model: FaceModel, shell: Shell, rays: Rays, pick: Tensor) -> Shaded:
    """Radiance (K, 3) of the rays `pick` (K,), indices into the shell."""
    seen = rays[shell.kept[pick]]
    wo = -seen.d

    def samples() -> tuple[Tensor, Tensor, Tensor]:
        t, share = shell.t[pick], shell.share[pick]
        x = seen.o[:, None] - t[..., None] * wo[:, None]
        return x, unit(shell.gradient.reshape(-1, share.shape[1], 3)[pick]), share

    def shade(x: Tensor, n: Tensor, wo: Tensor) -> Shaded:
        return model.shade(x, n, wo, seen.stations)

    return model.rendering.shade(shade, RayPoints(shell.x[pick], shell.n[pick], wo, samples))


def solid_behind(model: FaceModel, shell: Shell, rays: Rays) -> Tensor:
    """(M,) OPAQUE for rays that graze an edge and then hit the surface behind it (an ear in front of the head), else 0.

    The mask of such a ray does not constrain the edge; without this, every inner contour would move outwards.
    """
    out = torch.zeros_like(shell.tau)
    thin = torch.nonzero(shell.hit & (shell.tau.detach() < OPAQUE)).squeeze(-1)
    if len(thin):
        i = shell.kept[thin]
        o, d = rays.o[i], rays.d[i]
        _, far = box_interval(o, d, *model.geometry.box())
        out[thin[_covered(model, o, d, shell.end[thin].detach(), far)]] = OPAQUE
    return out


def _covered(model: FaceModel, o: Tensor, d: Tensor, near: Tensor, far: Tensor) -> Tensor:
    """Whether rays hit something from `near` on, or are inside it there."""
    _, hit, _ = model.geometry.trace(o, d, near, far)
    with torch.no_grad():
        inside: Tensor = model.geometry(o + near[:, None] * d)[0] <= 0
    return hit | (inside & (near < far))


def render_rays(model: FaceModel, rays: Rays, samples: int, chunk: int = 65_536) -> tuple[Tensor, Tensor]:
    """Premultiplied linear colour (N, 3) and opacity (N,) of any number of rays, without gradients."""
    parts = [_render_chunk(model, rays[i : i + chunk], samples) for i in range(0, len(rays.d), chunk)]
    return torch.cat([p[0] for p in parts]), torch.cat([p[1] for p in parts])


def _render_chunk(model: FaceModel, rays: Rays, samples: int) -> tuple[Tensor, Tensor]:
    """Composite layers front to back, so that the surface behind a thin edge is visible through it."""
    colour, opacity = torch.zeros_like(rays.d), torch.zeros_like(rays.d[:, 0])
    index, start = torch.arange(len(rays.d), device=rays.d.device), None
    with torch.no_grad():
        for _ in range(LAYERS):
            part = rays[index]
            shell = sample_shell(model, part, samples, None, None, start)
            if not len(shell.kept):
                break
            at = index[shell.kept]
            total = shade_shell(model, shell, part, torch.arange(len(at), device=at.device)).total
            a = -torch.expm1(-shell.tau) * (1 - opacity[at])
            colour[at] += total * a[:, None]
            opacity[at] += a
            thin = shell.hit & (shell.tau < OPAQUE)
            index, start = at[thin], shell.end[thin]
    return colour, opacity
