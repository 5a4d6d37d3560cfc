"""Fits the parameters of standard shaders (base colour, F0, roughness) to the photos, at the mesh's vertices.

The radiance of observation j at vertex p, by the reference renderer (pipeline/lighting/standard.py), is

    I_j = r_p a_p S_p (1 - R_j) + F0_p A_j + B_j

Symbols
    a       albedo of the field; r its correction, so that base colour = r a
    S       irradiance over pi under the exported dome, traced on the mesh; of a light that moves, in each photo
    A, B    specular radiance of F0 = 1 without, and of the rim with Schlick's factor, for one width alpha
    R       share that the layer keeps from the base
    w       weight of an observation: robust, by the residual of the field's own prediction, and less at grazing angles
    H, G, Q sums over a vertex's views of w x^2, w x y, w y^2 with x = A, y = I - B, after r was eliminated from both
            (its best value is subtracted, colour by colour), so that no albedo enters: only what changes with the view

For each alpha of a list the error Q - 2 F0 G + F0^2 H is one parabola in F0. Over a vertex's surroundings the sums are
pooled (WIDTH), because F0 varies slowly; towards the mean of its group a prior pulls where there is little evidence.
alpha is one number a group: one still light of low order does not determine it from place to place.

The prior of skin: F0 in SKIN_RANGE, roughness about SKIN_ROUGHNESS, and USUAL_F0 where a layer does not explain
MIN_EXPLAINED of what changes with the view. Hair that is a mesh of its own is matt: F0 is keratin's at most, roughness
about HAIR_ROUGHNESS, and without evidence there is no layer. Everything else has no prior for F0, and then no layer;
nor one where F0 would be above DIELECTRIC: the light moved then, as a flash does, or the photos are clipped. An object
without any other material keeps the one that is read off NeuFace's lobe. At last r follows by linear least squares,
pooled over EDGES edges.
"""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass

import numpy as np
import numpy.typing as npt

from pipeline.lighting import standard
from pipeline.meshes import F32, F64, Mask, Mesh, areas
from stages.bake.smooth import Smoother

ALPHAS = np.array([0.09, 0.12, 0.16, 0.20, 0.25, 0.31, 0.38, 0.47, 0.6], np.float32)
WIDTH = 0.005  # metres: F0 is pooled over it
EDGES, LEAST_WIDTH = 0.7, 1.5  # mean edges of the mesh over which the albedo's correction is pooled, and F0 at least
SKIN_RANGE = (0.02, 0.045)
USUAL_F0 = 0.028  # of skin, index 1.40; microfacet.SKIN_F0 is the convention that the light's level assumes
F0_SPREAD, TRUST = 0.01, 3.0  # standard deviation of F0 inside a group; observations that count as one
SKIN_ROUGHNESS, ROUGHNESS_SPREAD = 0.45, 0.05
HAIR_RANGE, HAIR_ROUGHNESS = (0.0, 0.046), 0.7  # keratin has index 1.55; a shell of many strands has no sharp highlight
OBJECT_SPREAD = 0.15  # of roughness, about the same mean
INDEPENDENT = 30  # observations that a group's roughness counts as: errors of light and shape are common to all others
MIN_EXPLAINED = 0.05  # share of the view-dependent variance that a layer must explain to be measured
CERTAIN = 1e3  # weight of a prior that no evidence changes, in the evidence of the whole group
MIN_VERTICES, MIN_VIEWS = 50, 4
GRAZING, FACING = 0.2, 0.4  # cosines between which an observation's weight rises from 0 to 1
OUTLIER = 2.5  # robust standard deviations of the field's residual from which the weight falls
CORRECTION = (0.4, 2.5)  # limits of r
DIELECTRIC = 0.17  # F0 of diamond, the largest of a dielectric that is common
TYPICAL_F0 = 0.03  # for R while F0 is estimated: R's part with F0 is 3 % of the base


@dataclass(frozen=True, slots=True)
class Prior:
    """What is known of a group's material before the photos. f0: its range; usual: F0 where the photos say nothing;
    roughness, spread: mean and standard deviation; most: F0 above which there is no layer; top: largest F0 of a
    place."""

    f0: tuple[float, float]
    usual: float
    roughness: float
    spread: float
    most: float = np.inf
    top: float = 1.0


SKIN = Prior(SKIN_RANGE, USUAL_F0, SKIN_ROUGHNESS, ROUGHNESS_SPREAD)
HAIR = Prior(HAIR_RANGE, 0.0, HAIR_ROUGHNESS, ROUGHNESS_SPREAD, top=HAIR_RANGE[1])
REST = Prior((0.0, 1.0), 0.0, SKIN_ROUGHNESS, OBJECT_SPREAD, DIELECTRIC)


@dataclass(frozen=True, slots=True)
class Seen:
    """M observations of the mesh's vertices. vertex (M,); wo (M, 3) unit; colour (M, 3) linear, without the photo's
    colour response; predicted (M, 3) by the field."""

    vertex: npt.NDArray[np.int64]
    wo: F64
    colour: F64
    predicted: F64


@dataclass(frozen=True, slots=True)
class Lit:
    """What arrives at M observations. lobes(rows, alphas): (m, K, 2, 3) of m of them, for F0 = 1 and the rim, for K
    widths; shade (M, 3): S. received (V, 3): S at the vertices, of the still light or its stand-in."""

    lobes: Callable[[npt.NDArray[np.int64], F32], F32]
    shade: F64
    received: F64


@dataclass(frozen=True, slots=True)
class Fitted:
    """At the vertices: correction (V, 3) of the albedo, f0 (V,), roughness (V,); received (V, 3): S. figures: for the
    report. plausible: false if the only material is none that exists."""

    correction: F32
    f0: F32
    roughness: F32
    received: F32
    figures: dict[str, float]
    plausible: bool = True


@dataclass(frozen=True, slots=True)
class _Sums:
    """h, g, q (V, K); bare (V,): Q without any layer; weight (V,): sum of w."""

    h: F64
    g: F64
    q: F64
    bare: F64
    weight: F64


def fit(
    mesh: Mesh, normals: F64, at: standard.Arrivals | Lit, albedo: F64, seen: Seen, skin: Mask,
    check: Callable[[], None] = lambda: None, hair: Mask | None = None, asked: Mask | None = None,
) -> Fitted:  # fmt: skip
    """Fit everything. normals, albedo (V, 3) of the field at the vertices; at: a still light as it arrives at them, or
    what arrives at the observations; skin, hair (V,): where these priors hold. asked (V,): vertices whose
    observations decide F0 and roughness, which vary slowly; by default all. The albedo's correction is of all."""
    hair = np.zeros_like(skin) if hair is None else hair
    skin = skin & ~hair
    w = _weights(normals, seen)
    lit = at if isinstance(at, Lit) else under_dome(at, normals, seen)
    check()
    rows = np.arange(len(w)) if asked is None else np.flatnonzero(asked[seen.vertex])
    sums = _sums(normals, seen, w, lit, rows)
    often = np.bincount(seen.vertex[rows][w[rows] > 0], minlength=len(normals)) >= MIN_VIEWS
    edge = float(np.sqrt(2.3 * float(areas(mesh.vertices, mesh.faces).sum()) / max(len(mesh.faces), 1)))
    near = Smoother(mesh, max(WIDTH, LEAST_WIDTH * edge))
    h, g = (near(x * often[:, None]) for x in (sums.h, sums.g))
    f0, rough, layered = (np.zeros(len(normals)) for _ in range(3))
    figures: dict[str, float] = {}
    for name, group, prior in (("skin", skin, SKIN), ("hair", hair, HAIR), ("rest", ~skin & ~hair, REST)):
        if not group.any():
            continue
        found = _group(sums, group & often, prior)
        pulled = (g[:, found.k] + found.pull * found.f0) / (h[:, found.k] + found.pull)
        f0[group] = pulled[group].clip(0, prior.top) if found.f0 > 0 else 0.0
        rough[group], layered[group] = found.roughness, found.f0 > 0
        figures |= {f"gloss_{name}_f0": float(f0[group].mean()), f"gloss_{name}_roughness": found.roughness}
        figures[f"gloss_{name}_explained"] = found.explained
        if found.refused:
            figures[f"gloss_{name}_refused_f0"] = found.refused
    # groups meet without a step
    f0, roughness = near(np.stack([f0, rough], 1)).T
    f0 = np.where(near(layered[:, None])[:, 0] > 0.01, f0, 0.0).clip(0, 1)
    correction = _correction(mesh, normals, albedo, seen, w, lit, f0, roughness, edge)
    return Fitted(
        correction.astype(np.float32), f0.astype(np.float32), roughness.astype(np.float32),
        lit.received.astype(np.float32),
        {k: round(v, 5) for k, v in figures.items()}, bool(skin.any()) or "gloss_rest_refused_f0" not in figures,
    )  # fmt: skip


def under_dome(at: standard.Arrivals, normals: F64, seen: Seen) -> Lit:
    """What arrives at the observations under a still light."""
    received = np.asarray(at.irradiance / np.pi, np.float64)

    def lobes(rows: npt.NDArray[np.int64], alphas: F32) -> F32:
        vertex = seen.vertex[rows]
        return standard.lobes(at, vertex, normals[vertex], seen.wo[rows], alphas)

    return Lit(lobes, received[seen.vertex], received)


def _weights(normals: F64, seen: Seen) -> F64:
    """w (M,)."""
    cosine = (normals[seen.vertex] * seen.wo).sum(1)
    off = np.abs(seen.colour - seen.predicted).mean(1)
    usual = max(1.4826 * float(np.median(off)), 1e-6) if len(off) else 1.0
    robust = np.minimum(1, OUTLIER * usual / np.maximum(off, 1e-9))
    return np.asarray(robust * ((cosine - GRAZING) / (FACING - GRAZING)).clip(0, 1))


def _sums(normals: F64, seen: Seen, weights: F64, lit: Lit, rows: npt.NDArray[np.int64]) -> _Sums:
    """Of the observations `rows` (m,)."""
    v, w, colour, count = seen.vertex[rows], weights[rows], seen.colour[rows], len(normals)
    cosine = (normals[v] * seen.wo[rows]).sum(1)
    h, g, q = (np.zeros((count, len(ALPHAS))) for _ in range(3))

    def total(values: F64) -> F64:
        return np.stack([np.bincount(v, values[:, i], count) for i in range(values.shape[1])], 1)

    def without_base(z: F64, t: F64) -> F64:
        """z (m, 3) less its best multiple of t (m, 3) at each vertex."""
        norm = np.maximum(total(w[:, None] * t * t), 1e-12)
        return np.asarray(z - (total(w[:, None] * z * t) / norm)[v] * t)

    lobes, shade = lit.lobes(rows, ALPHAS), lit.shade[rows]
    shade = np.maximum(shade / max(float(shade.mean()), 1e-12), 1e-6) if len(v) else shade
    for k, alpha in enumerate(ALPHAS):
        kept = 1 - standard.layer(cosine, np.full(len(v), TYPICAL_F0), np.full(len(v), alpha))
        t = kept[:, None] * shade
        x, y = (without_base(z, t) for z in (lobes[:, k, 0].astype(np.float64), colour - lobes[:, k, 1]))
        for out, product in ((h, x * x), (g, x * y), (q, y * y)):
            out[:, k] = np.bincount(v, w * product.sum(1), count)
    y = without_base(colour, shade)
    bare, weight = (np.asarray(np.bincount(v, z, count), np.float64) for z in (w * (y * y).sum(1), w))
    return _Sums(h, g, q, bare, weight)


@dataclass(frozen=True, slots=True)
class _Group:
    """A group's mean F0 (0: no layer), index of its alpha, roughness, weight of the prior in H's unit, and the share
    of the view-dependent variance that its layer explains. refused: F0 above DIELECTRIC that was found, else 0."""

    f0: float
    k: int
    roughness: float
    pull: float
    explained: float
    refused: float = 0.0


def _group(sums: _Sums, own: Mask, prior: Prior) -> _Group:
    """The material of a group by the evidence of its vertices `own` (V,)."""
    if own.sum() < MIN_VERTICES:
        return _Group(prior.usual, 0, prior.roughness, 1.0, 0.0)
    h, g, q = (np.maximum(x[own].sum(0), 1e-30) if x is not sums.g else x[own].sum(0) for x in (sums.h, sums.g, sums.q))
    mean = (g / h).clip(*prior.f0)
    error = np.maximum(q - 2 * mean * g + mean**2 * h, 1e-30)
    cost = 0.5 * INDEPENDENT * np.log(error / error.min())
    cost += 0.5 * ((np.sqrt(ALPHAS) - prior.roughness) / prior.spread) ** 2
    k = int(cost.argmin())
    explained = 1 - float(error[k]) / max(float(sums.bare[own].sum()), 1e-30)
    variance = float(error[k]) / max(3 * float(sums.weight[own].sum()), 1e-30)
    if explained < MIN_EXPLAINED:  # the photos say nothing: skin is as usual, everything else has no layer
        return _Group(prior.usual, k, prior.roughness, CERTAIN * float(h.max()), explained)
    if mean[k] > prior.most:
        return _Group(0.0, k, prior.roughness, CERTAIN * float(h.max()), explained, float(mean[k]))
    rough = _lowest(np.sqrt(ALPHAS).astype(np.float64), cost)
    return _Group(float(mean[k]), k, rough, max(TRUST * variance / F0_SPREAD**2, 1e-12), explained)


def _lowest(x: F64, cost: F64) -> float:
    """Place of the least cost (K,) over x (K,), between the samples by a parabola."""
    k = int(cost.argmin())
    if k in (0, len(x) - 1):
        return float(x[k])
    a, b, _ = np.polyfit(x[k - 1 : k + 2], cost[k - 1 : k + 2], 2)
    return float(np.clip(-b / (2 * a), x[k - 1], x[k + 1]))


def _correction(
    mesh: Mesh, normals: F64, albedo: F64, seen: Seen, w: F64, lit: Lit, f0: F64, roughness: F64, edge: float,
) -> F64:  # fmt: skip
    """r (V, 3) = pooled sum of w m (I - specular) over that of w m^2, m = a S (1 - R); 1 where nothing is seen."""
    v = seen.vertex
    alpha = roughness**2
    cosine = (normals[v] * seen.wo).sum(1)
    k = np.abs(ALPHAS[None] - alpha[:, None]).argmin(1)[v]
    specular = np.zeros((len(v), 3))
    for one in np.unique(k):
        rows = np.flatnonzero((k == one) & (f0[v] > 0))
        lobes = lit.lobes(rows, ALPHAS[one : one + 1])[:, 0]
        specular[rows] = f0[v[rows], None] * lobes[:, 0] + lobes[:, 1]
    kept = 1 - standard.layer(cosine, f0[v], alpha[v])
    m = albedo[v] * lit.shade * kept[:, None]
    above, below = (
        np.stack([np.bincount(v, w * z[:, i], len(normals)) for i in range(3)], 1).astype(np.float64)
        for z in (m * (seen.colour - specular), m * m)
    )
    smooth = Smoother(mesh, EDGES * edge)
    dark = albedo**2 + 1e-12  # so that the pull to 1 does not depend on how dark the surface is
    typical = 1e-3 * dark * (below / dark)[below > 0].mean() if (below > 0).any() else np.ones(1)
    return np.asarray(((smooth(above) + typical) / (smooth(below) + typical)).clip(*CORRECTION))
