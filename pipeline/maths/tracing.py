"""Sphere tracing, in plain torch. The reference for pipeline.fields.kernels.

Symbols: rays x = o + t d with |d| = 1, searched in [t_near, t_far]. A hit is the first sign change from outside to
inside; a ray without one reports its closest approach.
"""

from __future__ import annotations

from collections.abc import Callable

import torch
from torch import Tensor

MAX_STEPS, REFINE_STEPS = 200, 6


def box_interval(o: Tensor, d: Tensor, lo: Tensor, hi: Tensor) -> tuple[Tensor, Tensor]:
    """t at which rays enter and leave a box: (N,), (N,); t_far <= t_near where they miss it. Starts at t >= 0.

    d = 0 on an axis: the quotient is +-inf, which min and max handle; 0 / 0 (origin on the face) is kept out by a
    floor of 1e-12 on |d|.
    """
    safe = torch.where(d.abs() < 1e-12, torch.full_like(d, 1e-12), d)
    a, b = (lo - o) / safe, (hi - o) / safe
    near = torch.minimum(a, b).amax(-1).clamp(min=0)
    return near, torch.maximum(a, b).amin(-1)


def sphere_trace(
    sdf: Callable[[Tensor], Tensor],
    o: Tensor,
    d: Tensor,
    t_near: Tensor,
    t_far: Tensor,
    *,
    min_step: float,
    factor: float = 1.0,
) -> tuple[Tensor, Tensor, Tensor]:
    """t of the hit or of the closest approach, whether it is a hit, and the SDF there: (N,) each.

    The step is factor * sdf [NeuFace section 4.4: 1.2], but at least `min_step`, so that grazing rays advance. The sign
    change is refined by the secant method. Rays that start inside are not hits (the paper's 'unhit').
    """
    t = t_near.clone()
    s = sdf(o + t[:, None] * d)
    best_t, best_s = t.clone(), s.clone()
    hit = torch.zeros_like(s, dtype=torch.bool)
    live = torch.nonzero((t_far > t_near) & (s > 0)).squeeze(-1)
    for _ in range(MAX_STEPS):
        if not len(live):
            break
        t0, s0 = t[live], s[live]
        t1 = torch.minimum(t0 + (factor * s0).clamp(min=min_step), t_far[live])
        s1 = sdf(o[live] + t1[:, None] * d[live])
        t[live], s[live] = t1, s1
        closer = s1 < best_s[live]
        best_t[live] = torch.where(closer, t1, best_t[live])
        best_s[live] = torch.where(closer, s1, best_s[live])
        crossed = s1 <= 0
        if crossed.any():
            c = live[crossed]
            best_t[c], best_s[c] = _secant(sdf, o[c], d[c], t0[crossed], s0[crossed], t1[crossed], s1[crossed])
            hit[c] = True
        live = live[~crossed & (t1 < t_far[live])]
    return best_t, hit, best_s


def _secant(
    sdf: Callable[[Tensor], Tensor], o: Tensor, d: Tensor, t0: Tensor, s0: Tensor, t1: Tensor, s1: Tensor
) -> tuple[Tensor, Tensor]:
    """Root between t0 (outside) and t1 (inside) by the Illinois method: regula falsi that halves the value at an end
    that is kept twice in a row, so that it does not converge slowly from one side."""
    t, s = t1, s1
    last = torch.zeros_like(s)
    for _ in range(REFINE_STEPS):
        t = t0 + (t1 - t0) * (s0 / (s0 - s1).clamp(min=1e-12))
        s = sdf(o + t[:, None] * d)
        outside = s > 0
        again = torch.sign(s) == last
        last = torch.sign(s)
        t0, s0 = torch.where(outside, t, t0), torch.where(outside, s, torch.where(again, 0.5 * s0, s0))
        t1, s1 = torch.where(outside, t1, t), torch.where(outside, torch.where(again, 0.5 * s1, s1), s)
    return t, s


def sphere_interval(o: Tensor, d: Tensor, centre: Tensor, radius: float) -> tuple[Tensor, Tensor]:
    """t at which rays enter and leave a sphere, from t = 0 on: (N,), (N,); t_far <= t_near where they miss it."""
    to = o - centre
    b = (to * d).sum(-1)
    across = (to - b[:, None] * d).square().sum(-1)  # not |to|^2 - b^2, which loses precision for a distant camera
    half = torch.sqrt((radius * radius - across).clamp(min=0))
    miss = across >= radius * radius
    near, far = (-b - half).clamp(min=0), -b + half
    return near, torch.where(miss, near, torch.maximum(far, near))


def aggressive_trace(
    sdf: Callable[[Tensor], Tensor],
    o: Tensor,
    d: Tensor,
    t_near: Tensor,
    t_far: Tensor,
    *,
    threshold: float,
    truncation: float,
    factor: float = 1.2,
    steps: int = 64,
) -> tuple[Tensor, Tensor, Tensor]:
    """t, hit and SDF there, (N,) each, by over-relaxed sphere tracing. [NeuFace section 4.4, B]

        t <- t + factor * clamp(SDF, -truncation, truncation)   until |SDF| < threshold

    Steps may be negative: a step with factor 1.2 that passed the surface returns. Unhit: rays that enter where the SDF
    is negative (behind the prior's surface), that leave the interval, or that have not converged after `steps`; for
    these the closest approach is returned. The clamp prevents a first step over a thin head.
    """
    t = t_near.clone()
    s = sdf(o + t[:, None] * d)
    best_t, best_s = t.clone(), s.clone()
    hit = torch.zeros_like(s, dtype=torch.bool)
    live = torch.nonzero((t_far > t_near) & (s > 0)).squeeze(-1)
    for _ in range(steps):
        near = s[live].abs() < threshold
        hit[live[near]] = True
        live = live[~near]
        if not len(live):
            break
        t1 = t[live] + factor * s[live].clamp(-truncation, truncation)
        stays = (t1 < t_far[live]) & (t1 >= t_near[live])
        live, t1 = live[stays], t1[stays]
        t[live] = t1
        s[live] = s1 = sdf(o[live] + t1[:, None] * d[live])
        closer = s1.abs() < best_s[live].abs()
        best_t[live] = torch.where(closer, t1, best_t[live])
        best_s[live] = torch.where(closer, s1, best_s[live])
    return torch.where(hit, t, best_t), hit, torch.where(hit, s, best_s)
