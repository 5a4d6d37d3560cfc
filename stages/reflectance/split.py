"""Splits the samples of each texel: albedo, three global lobes, normal, what of each light arrives, and a smooth rest.

    y = V (a n.l / pi + sum_j s_j lobe_j n.l) + sum_k r_k Y_k(l)

Symbols
    a, s_j, n    albedo (3), weights of the lobes (they are F0s), normal
    V            share of the light that arrives: traced, corrected where the pictures say otherwise
    Y_k, r_k     spherical harmonics of the light's direction in asset coordinates, and their coefficients (K, 3): light
                 that came by way of other skin, which is smooth
The steps, twice: a, s, n with the lights that arrive; V from the pictures; the rest r.
"""

from __future__ import annotations

from dataclasses import dataclass
from functools import cached_property

import numpy as np
import numpy.typing as npt

from pipeline.images import F32
from pipeline.transforms import F64
from stages.reflectance.layer import WIDTHS as LAYER_WIDTHS
from stages.reflectance.layer import Layers
from stages.reflectance.rig import Rig
from stages.reflectance.samples import F16, Step, part
from stages.reflectance.texels import U8, Pairs, Points

RUN = 8192  # texels at once
START_ALBEDO, START_LOBES = 0.4, 0.01
FIRST_STEPS, STEPS = 6, 5
SPREAD = 0.5  # errors above half of the value are outliers
LEAST = 0.1  # n.l from which the pictures say what arrives
LIT = 0.85  # share from which a light counts as arriving
FEW_LIGHTS, QUANTILE = 12, 0.8  # texels with fewer lit samples start from this quantile of y pi / n.l
MOST_REST, REST_SCALE, REST_ROUNDS = 0.15, 0.005, 4
LIT_COUNTS = (
    0.02,
    1.0,
)  # weight of lit samples in the rest: small where the next fit subtracts it, else it takes shading
SUBSET, SEED = 1500, 7
WIDTHS = ((0.35, 0.25, 0.18), (0.15, 0.12, 0.09), (0.05, 0.03, 0.02))  # GGX alphas that are tried


@dataclass(frozen=True, slots=True)
class Fitted:
    """albedo, lobes, normal (T, 3); rest (T, K, 3); shadow, trust (T, L): V less what is traced, and how far it is
    known; error (T,): weighted RMS of y; layers: the same samples as one layer over a base."""

    albedo: F32
    lobes: F32
    normal: F32
    rest: F32
    shadow: F16
    trust: F16
    error: F32
    layers: Layers


def harmonics(towards: F64, order: int) -> F64:
    """(N, (order + 1)^2) real spherical harmonics of unit directions (N, 3)."""
    import torch

    from pipeline.maths.sh import sh_basis

    return np.asarray(sh_basis(torch.from_numpy(np.ascontiguousarray(towards)), order).numpy(), np.float64)


def penalties(order: int) -> F64:
    """((order + 1)^2,) weight of each harmonic's square: by the squared Laplacian, so that the rest is smooth."""
    degree = np.concatenate([np.full(2 * n + 1, n) for n in range(order + 1)])
    return np.asarray(1e-3 + 0.5 * (degree * (degree + 1.0)) ** 2 / 36, np.float64)


def chosen_widths(
    points: Points, pairs: Pairs, table: F16, rig: Rig, arrives: U8, prior: float, step: Step
) -> tuple[float, float, float]:
    """The three widths that fit a subset of the texels best, one after the other."""
    many = np.flatnonzero(np.diff(pairs.first) >= min(3, len(rig.cameras)))
    few = np.sort(np.random.default_rng(SEED).permutation(many)[:SUBSET])
    best = [w[1] for w in WIDTHS]
    if not len(few):
        return best[0], best[1], best[2]
    work = TexelFit(points, pairs, table, rig, arrives, few)
    for j, tried in enumerate(WIDTHS):
        step(j, len(WIDTHS), "widths of the lobes")
        errors = []
        for width in tried:
            work.begin()
            errors.append(float(np.mean(work.fit(np.array([*best[:j], width, *best[j + 1 :]]), 4, prior) ** 2)))
        best[j] = tried[int(np.argmin(errors))]
    return best[0], best[1], best[2]


def split(
    points: Points,
    pairs: Pairs,
    table: F16,
    rig: Rig,
    arrives: U8,
    alphas: tuple[float, ...],
    prior: float,
    order: int,
    step: Step,
) -> Fitted:
    """All texels, in runs. Texels that no camera sees stay 0 with the geometry's normal."""
    count, lights, terms = len(points.texel), len(rig.index), (order + 1) ** 2
    out = Fitted(
        albedo=np.zeros((count, 3), np.float32),
        lobes=np.zeros((count, 3), np.float32),
        normal=points.normal.astype(np.float32),
        rest=np.zeros((count, terms, 3), np.float32),
        shadow=np.zeros((count, lights), np.float16),
        trust=np.zeros((count, lights), np.float16),
        error=np.zeros(count, np.float32),
        layers=Layers.empty(count),
    )
    seen = np.flatnonzero(pairs.seen)
    basis, penalty = harmonics(rig.towards, order), penalties(order)
    for begin in range(0, len(seen), RUN):
        step(begin, len(seen), "splitting")
        texels = seen[begin : begin + RUN]
        work = TexelFit(points, pairs, table, rig, arrives, texels)
        work.begin()
        work.fit(np.array(alphas), FIRST_STEPS, prior)
        work.start_again_from_brightest(np.array(alphas))
        for again in range(2):
            work.see(np.array(alphas))
            error = work.fit(np.array(alphas), STEPS, prior)
            rest = work.smooth_rest(np.array(alphas), basis, penalty, LIT_COUNTS[again])
        work.see(np.array(alphas))
        out.albedo[texels], out.lobes[texels], out.normal[texels] = work.albedo, work.lobes, work.normals
        out.rest[texels], out.error[texels] = rest, error
        work.fit_layers(np.array(alphas), out.layers, texels)
        out.shadow[texels], out.trust[texels] = (work.share - work.traced) * (work.trust > 0), work.trust
    return out


class TexelFit:
    """The samples of some texels in memory, and the state of their fit."""

    def __init__(
        self, points: Points, pairs: Pairs, table: F16, rig: Rig, arrives: U8, texels: npt.NDArray[np.int64]
    ) -> None:
        self.samples, self.first, self.weight, self.camera = part(table, pairs, texels)
        self.points, self.start = points.position[texels], points.normal[texels]
        self.lamps, self.axes = rig.lamps()
        self.eyes = rig.eyes()
        self.traced: F32 = arrives[texels].astype(np.float32) / np.float32(255)
        self.share, self.trust = np.zeros_like(self.traced), np.zeros_like(self.traced)
        self.begin()

    def begin(self) -> None:
        """The state before the first fit."""
        count = len(self.points)
        self.albedo: F64 = np.full((count, 3), START_ALBEDO)
        self.lobes: F64 = np.full((count, 3), START_LOBES)
        self.normals: F64 = self.start.copy()
        self.arrives: F32 = self.traced.copy()
        self.rest: F32 = np.zeros((*self.traced.shape, 3), np.float32)

    def fit(self, alphas: F64, steps: int, prior: float) -> F64:
        """Albedo, lobes and normals; (t,) the error."""
        from stages.reflectance.fit_kernels import fit

        return np.asarray(fit(self.points, self.start, self.first, self.camera, self.weight, self.samples, self.arrives,
                              self.rest, self.lamps, self.axes, self.eyes, alphas, steps, prior, SPREAD, self.albedo,
                              self.lobes, self.normals))  # fmt: skip

    def start_again_from_brightest(self, alphas: F64) -> None:
        """Texels that hardly any light reaches by the trace: the trace may be wrong. They start from their bright
        samples, as if all lights arrived."""
        cosine = self.cosine
        few = np.flatnonzero(((self.traced > 0.99) & (cosine > 0.2)).sum(1) < FEW_LIGHTS)
        if not len(few):
            return
        seen = self._left_over(alphas, np.zeros(self.arrives.shape, np.float32), 1e3)[few]
        with np.errstate(invalid="ignore"):
            level = np.where(cosine[few, :, None] > 0.3, seen * np.pi / np.maximum(cosine[few, :, None], 0.3), np.nan)
        known = np.isfinite(level).any((1, 2))
        few, level = few[known], level[known]
        self.albedo[few] = np.clip(np.nanquantile(level, QUANTILE, axis=1), 0.02, 0.95)
        self.lobes[few], self.normals[few] = START_LOBES, self.start[few]

    @cached_property
    def cosine(self) -> F64:
        """(t, L) n.l of the geometry's normal."""
        towards = self.lamps[None] - self.points[:, None]
        towards /= np.linalg.norm(towards, axis=2, keepdims=True)
        return np.asarray(np.einsum("tld,td->tl", towards, self.start), np.float64)

    def see(self, alphas: F64) -> None:
        """What arrives, from the pictures where they say it."""
        from stages.reflectance.fit_kernels import observe

        observe(self.points, self.normals, self.first, self.camera, self.weight, self.samples, self.lamps, self.axes,
                self.eyes, alphas, self.albedo, self.lobes, LEAST, self.share, self.trust)  # fmt: skip
        self.arrives = np.where(self.trust > 0, self.share, self.traced).astype(np.float32)
        self.arrives[self.arrives > LIT] = 1

    def smooth_rest(self, alphas: F64, basis: F64, penalty: F64, lit: float) -> F32:
        """(t, K, 3) coefficients of what is left over, which the next fit then subtracts. lit: weight of lights that
        arrive: in them the albedo's error is left over as well."""
        from stages.reflectance.fit_kernels import smooth_terms

        out = np.zeros((len(self.points), basis.shape[1], 3))
        counts = np.where(self.arrives * self.cosine > 0.02, lit, 1.0)
        smooth_terms(
            self._left_over(alphas, self.arrives, MOST_REST), counts, basis, penalty, REST_SCALE, REST_ROUNDS, out
        )
        self.rest = np.einsum("tkc,lk->tlc", out, basis).astype(np.float32)
        return out.astype(np.float32)

    def fit_layers(self, alphas: F64, out: Layers, texels: npt.NDArray[np.int64]) -> None:
        """Writes the fits with one layer of these texels into those of all."""
        from stages.reflectance.layer_kernels import layers

        own = Layers.empty(len(texels))
        layers(self.points, self.normals, self.first, self.camera, self.weight, self.samples, self.arrives, self.rest,
               self.lamps, self.axes, self.eyes, alphas, self.albedo, self.lobes, SPREAD, LAYER_WIDTHS, own.base,
               own.f0, own.error, own.facing)  # fmt: skip
        out.base[texels], out.f0[texels], out.error[texels] = own.base, own.f0, own.error
        out.facing[texels] = own.facing

    def _left_over(self, alphas: F64, arrives: F32, most: float) -> F32:
        from stages.reflectance.fit_kernels import left_over

        out = np.zeros((*arrives.shape, 3), np.float32)
        left_over(self.points, self.normals, self.first, self.camera, self.weight, self.samples, arrives, self.lamps,
                  self.axes, self.eyes, alphas, self.albedo, self.lobes, most, out)  # fmt: skip
        return out
