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

Polarised pairs (pipeline/polarised.py) show the two parts apart: y = S - B with S the mirror reflection itself, and
nothing is eliminated. F0 and roughness are then those of the whole reflection and not only of what changes with the
view, and r is that of the cross-polarised photos, which show r a S (1 - R) alone.

For each alpha of a list the error Q - 2 F0 G + F0^2 H of a group's sums is one parabola in F0. How F0 and roughness
vary about the group's follows in gloss_field.py.

The prior of skin: F0 in SKIN_RANGE, roughness about SKIN_ROUGHNESS, and USUAL_F0 where a layer does not explain
MIN_EXPLAINED of what changes with the view. Errors of light and shape in A and B make the F0 of a regression too small
(attenuation by errors in the regressor): .0196 for .0222 of a rendered head, .025 for .029 of the demo. So the mean of
skin is drawn to USUAL_F0, the more the less the layer explains (`drawn`). Hair that is a mesh of its own is matt: F0 is
keratin's at most, roughness about HAIR_ROUGHNESS, and without evidence there is no layer. Everything else has no prior
for F0, and then no layer, except that an object without a person has ASSUMED_F0 at the largest roughness if that costs
nothing in the photos (FREE): no dielectric has F0 0. Where a layer is explained by its rim alone, F0 comes out at 0 by
the same attenuation: such a group has LEAST_F0, or less if that cost more than FREE of the error that is left
(`at_least`). There is no layer where F0 would be above DIELECTRIC: the light moved then, as a flash does, or the photos
are clipped. An object without any other material keeps the one that is read off NeuFace's lobe. At last r follows by
linear least squares, pooled over EDGES edges, on skin drawn to 1 with the weight FIELD: the exported light is up to 5 %
of the irradiance off the fitted one.
"""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass, field, replace

import numpy as np
import numpy.typing as npt

from pipeline.lighting import standard
from pipeline.meshes import F32, F64, Mask, Mesh, areas
from pipeline.smoothing import Smoother
from stages.bake.base_colour import correction, layers, room_for_layer
from stages.bake.gloss_field import Slopes, Spread, departures
from stages.bake.standard_seen import ALPHAS, Lit, Seen, under_dome

EDGES = 0.7  # mean edges of the mesh over which the albedo's correction is pooled, and groups meet
SKIN_RANGE = (0.02, 0.045)
USUAL_F0 = 0.028  # of skin, index 1.40; microfacet.SKIN_F0 is the convention that the light's level assumes
SKIN_SPREAD = Spread(0.008, 0.05, -0.8)  # inside skin, of F0, roughness and their correlation
PLAIN_SPREAD = 0.3, 0.05  # inside everything else: of F0 as a share of its mean, and of roughness
DELTA = 0.05  # step of the derivative by roughness
ROUGHNESS_RANGE = (0.2, 0.85)
DOUBT = 0.3  # share that a layer explains at which half of what it says about places is errors of light and shape
HALF = 0.5  # of e / (1 - e), e the share that a layer explains: where evidence of skin's mean F0 counts as the prior
SKIN_ROUGHNESS, ROUGHNESS_SPREAD = 0.45, 0.05
HAIR_RANGE, HAIR_ROUGHNESS = (0.0, 0.046), 0.7  # keratin has index 1.55; a shell of many strands has no sharp highlight
OBJECT_SPREAD = 0.15  # of roughness, about the same mean
INDEPENDENT = 30  # observations that a group's roughness counts as: errors of light and shape are common to all others
MIN_EXPLAINED = 0.05  # share of the view-dependent variance that a layer must explain to be measured
MIN_VERTICES, MIN_VIEWS = 50, 4
GRAZING, FACING = 0.2, 0.4  # cosines between which an observation's weight rises from 0 to 1
OUTLIER = 2.5  # robust standard deviations of the field's residual from which the weight falls
LEAST_F0 = 0.02  # of a dielectric: water, index 1.33
ASSUMED_F0 = 0.04  # of bone, stone, paint: index 1.5
FREE = 0.02  # largest share of the view-dependent variance that an F0 which photos do not tell may cost
FIELD = 1 / 3  # weight of the fit's own albedo of skin, r = 1, beside that of the photos under the exported light
DIELECTRIC = 0.17  # F0 of diamond, the largest of a dielectric that is common
TYPICAL_F0 = 0.03  # for R while F0 is estimated: R's part with F0 is 3 % of the base


@dataclass(frozen=True, slots=True)
class Prior:
    """What is known of a group's material before the photos. f0: its range; usual: F0 where the photos say nothing;
    roughness, spread: mean and standard deviation; most: F0 above which there is no layer; top: largest F0 of a
    place; varies: whether it may vary inside the group; inside: how much, None for PLAIN_SPREAD; assumed: F0 where a
    rough layer costs nothing in the photos."""

    f0: tuple[float, float]
    usual: float
    roughness: float
    spread: float
    most: float = np.inf
    top: float = 1.0
    varies: bool = True
    inside: Spread | None = None
    assumed: float = 0.0

    def spread_of(self, f0: float) -> Spread:
        """Of a group with this mean F0."""
        return self.inside or Spread(max(PLAIN_SPREAD[0] * f0, 1e-4), PLAIN_SPREAD[1], 0.0)


SKIN = Prior(SKIN_RANGE, USUAL_F0, SKIN_ROUGHNESS, ROUGHNESS_SPREAD, inside=SKIN_SPREAD)
HAIR = Prior(HAIR_RANGE, 0.0, HAIR_ROUGHNESS, ROUGHNESS_SPREAD, top=HAIR_RANGE[1], varies=False)
REST = Prior((0.0, 1.0), 0.0, SKIN_ROUGHNESS, OBJECT_SPREAD, DIELECTRIC)
OBJECT = replace(REST, assumed=ASSUMED_F0)  # a capture without a person


@dataclass(frozen=True, slots=True)
class Fitted:
    """At the vertices: correction (V, 3) of the albedo, f0 (V,), roughness (V,); received (V, 3): S. figures: for the
    report. plausible: false if the only material is none that exists. measured (V, 2): share of the photos in F0 and in
    roughness (sources.py). apart (V,): how far the photos are apart (odd_colours.py), NaN where it is not known."""

    correction: F32
    f0: F32
    roughness: F32
    received: F32
    figures: dict[str, float]
    plausible: bool = True
    measured: F32 = field(default_factory=lambda: np.zeros((0, 2), np.float32))
    apart: F64 | None = None


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
    if seen.mirror is not None:
        rows = rows[np.isfinite(seen.mirror[rows]).all(1)]
    sums = _sums(normals, seen, w, lit, rows)
    often = _in_enough(seen.vertex[rows], w[rows], len(normals))
    shown = _in_enough(seen.vertex, w, len(normals))
    edge = float(np.sqrt(2.3 * float(areas(mesh.vertices, mesh.faces).sum()) / max(len(mesh.faces), 1)))
    f0, rough, layered = (np.zeros(len(normals)) for _ in range(3))
    told = np.zeros((len(normals), 2))
    figures: dict[str, float] = {}
    others = REST if (skin | hair).any() else OBJECT
    groups = {"skin": skin, "hair": hair, "rest": ~skin & ~hair}
    for (name, group), prior in zip(groups.items(), (SKIN, HAIR, others), strict=True):
        if not group.any():
            continue
        found = _group(sums, group & often, prior)
        f0[group], rough[group], layered[group] = found.f0, found.roughness, found.f0 > 0
        told[group & shown] = found.told
        if found.measured and prior.varies:
            check()
            own = group & often
            slopes = _slopes(normals, seen, w, lit, rows[group[seen.vertex[rows]]], found.roughness, found.fitted)
            u, v = departures(mesh, own, slopes, found.fitted, prior.spread_of(found.fitted))
            trust = found.explained / (found.explained + DOUBT)
            varied = found.f0 * (1 + trust * (u - u[own].mean()) / found.fitted)
            f0[group] = varied[group].clip(*prior.f0).clip(0, prior.top)
            rough[group] = (found.roughness + trust * v)[group].clip(*ROUGHNESS_RANGE)
        figures[f"gloss_{name}_roughness"] = float(rough[group].mean())
        figures[f"gloss_{name}_explained"] = found.explained
        if found.assumed:
            figures[f"gloss_{name}_assumed"] = 1.0
        if found.refused:
            figures[f"gloss_{name}_refused_f0"] = found.refused
    # groups meet without a step
    near = Smoother(mesh, EDGES * edge)
    f0, roughness = near(np.stack([f0, rough], 1)).T
    f0 = np.where(near(layered[:, None])[:, 0] > 0.01, f0, 0.0).clip(0, 1)
    of = layers(normals, seen, lit, f0, roughness)
    if hair.any():
        most = room_for_layer(near, of, albedo, seen, w, lit, f0, roughness, hair)
        f0 = near(np.where(hair, np.minimum(f0, most), f0)[:, None])[:, 0].clip(0, 1)
    figures |= {f"gloss_{name}_f0": float(f0[group].mean()) for name, group in groups.items() if group.any()}
    r = correction(near, of, albedo, seen, w, lit, f0, roughness, np.where(skin, FIELD, 0.0))
    return Fitted(
        r.astype(np.float32), f0.astype(np.float32), roughness.astype(np.float32),
        lit.received.astype(np.float32),
        {k: round(v, 5) for k, v in figures.items()}, bool(skin.any()) or "gloss_rest_refused_f0" not in figures,
        told.astype(np.float32),
    )  # fmt: skip


def _in_enough(vertex: npt.NDArray[np.int64], weights: F64, count: int) -> Mask:
    """(count,) vertices with MIN_VIEWS observations of some weight. vertex, weights (m,)."""
    return np.asarray(np.bincount(vertex[weights > 0], minlength=count) >= MIN_VIEWS)


def _weights(normals: F64, seen: Seen) -> F64:
    """w (M,)."""
    cosine = (normals[seen.vertex] * seen.wo).sum(1)
    off = np.abs(seen.colour - seen.predicted).mean(1)
    usual = max(1.4826 * float(np.median(off)), 1e-6) if len(off) else 1.0
    robust = np.minimum(1, OUTLIER * usual / np.maximum(off, 1e-9))
    return np.asarray(robust * ((cosine - GRAZING) / (FACING - GRAZING)).clip(0, 1))


def _sums(normals: F64, seen: Seen, weights: F64, lit: Lit, rows: npt.NDArray[np.int64]) -> _Sums:
    """Of the observations `rows` (m,)."""
    v, w, colour, count = seen.vertex[rows], weights[rows], _shown(seen)[rows], len(normals)
    base = _eliminated(seen, w, v, count)
    cosine = (normals[v] * seen.wo[rows]).sum(1)
    h, g, q = (np.zeros((count, len(ALPHAS))) for _ in range(3))
    lobes, shade = lit.lobes(rows, ALPHAS), lit.shade[rows]
    shade = np.maximum(shade / max(float(shade.mean()), 1e-12), 1e-6) if len(v) else shade
    for k, alpha in enumerate(ALPHAS):
        kept = 1 - standard.layer(cosine, np.full(len(v), TYPICAL_F0), np.full(len(v), alpha))
        t = kept[:, None] * shade
        x, y = (base(z, t) for z in (lobes[:, k, 0].astype(np.float64), colour - lobes[:, k, 1]))
        for out, product in ((h, x * x), (g, x * y), (q, y * y)):
            out[:, k] = np.bincount(v, w * product.sum(1), count)
    y = base(colour, shade)
    bare, weight = (np.asarray(np.bincount(v, z, count), np.float64) for z in (w * (y * y).sum(1), w))
    return _Sums(h, g, q, bare, weight)


def _slopes(
    normals: F64, seen: Seen, weights: F64, lit: Lit, rows: npt.NDArray[np.int64], roughness: float, f0: float
) -> Slopes:
    """Sums for the departures from a roughness and F0, of the observations `rows` (m,)."""
    v, w, count = seen.vertex[rows], weights[rows], len(normals)
    steps = np.clip(roughness + DELTA * np.array([-1, 0, 1]), 0.1, 1.0)
    lobes, shade = lit.lobes(rows, (steps**2).astype(np.float32)).astype(np.float64), lit.shade[rows]
    cosine = (normals[v] * seen.wo[rows]).sum(1)
    kept = 1 - standard.layer(cosine, np.full(len(v), TYPICAL_F0), np.full(len(v), steps[1] ** 2))
    t = kept[:, None] * np.maximum(shade / max(float(shade.mean()), 1e-12), 1e-6)
    changed = (lobes[:, 2] - lobes[:, 0]) / (steps[2] - steps[0])
    parts = (lobes[:, 1, 0], f0 * changed[:, 0] + changed[:, 1], _shown(seen)[rows] - lobes[:, 1, 1])
    base = _eliminated(seen, w, v, count)
    x, z, y = (base(part, t) for part in parts)

    def total(a: F64, b: F64) -> F64:
        return np.asarray(np.bincount(v, w * (a * b).sum(1), count), np.float64)

    return Slopes(
        xx=total(x, x), xz=total(x, z), zz=total(z, z), xy=total(x, y), zy=total(z, y), yy=total(y, y),
        weight=3.0 * np.asarray(np.bincount(v, w, count), np.float64),
    )  # fmt: skip


def _shown(seen: Seen) -> F64:
    """(M, 3) what the layer is fitted to: the photos, or of polarised pairs the mirror reflection alone."""
    return seen.colour if seen.mirror is None else seen.mirror


def _eliminated(seen: Seen, w: F64, vertex: npt.NDArray[np.int64], count: int) -> Callable[[F64, F64], F64]:
    """z (m, 3), t (m, 3) -> z without its best multiple of t; z itself where the photos show no base."""
    if seen.mirror is not None:
        return lambda z, t: z
    return lambda z, t: _without_base(z, t, w, vertex, count)


def _without_base(z: F64, t: F64, w: F64, vertex: npt.NDArray[np.int64], count: int) -> F64:
    """z (m, 3) less its best multiple of t (m, 3) at each vertex, colour by colour."""

    def total(values: F64) -> F64:
        return np.stack([np.bincount(vertex, values[:, i], count) for i in range(values.shape[1])], 1)

    norm = np.maximum(total(w[:, None] * t * t), 1e-12)
    return np.asarray(z - (total(w[:, None] * z * t) / norm)[vertex] * t)


@dataclass(frozen=True, slots=True)
class _Group:
    """A group's mean F0 (0: no layer), as the regression has it (fitted) and after the prior (f0), roughness, and the
    share of the view-dependent variance that its layer explains. measured: whether that is enough. refused: F0 above
    DIELECTRIC that was found, else 0; assumed: the layer is none that the photos tell. told: share of the photos in F0
    and in roughness."""

    f0: float
    fitted: float
    roughness: float
    explained: float
    measured: bool = False
    refused: float = 0.0
    assumed: bool = False
    told: tuple[float, float] = (0.0, 0.0)


def _group(sums: _Sums, own: Mask, prior: Prior) -> _Group:
    """The material of a group by the evidence of its vertices `own` (V,)."""
    if own.sum() < MIN_VERTICES:
        return _Group(prior.usual, prior.usual, prior.roughness, 0.0)
    h, g, q = (np.maximum(x[own].sum(0), 1e-30) if x is not sums.g else x[own].sum(0) for x in (sums.h, sums.g, sums.q))
    mean = (g / h).clip(*prior.f0)
    error = np.maximum(q - 2 * mean * g + mean**2 * h, 1e-30)
    cost = 0.5 * INDEPENDENT * np.log(error / error.min())
    cost += 0.5 * ((np.sqrt(ALPHAS) - prior.roughness) / prior.spread) ** 2
    k = int(cost.argmin())
    explained = 1 - float(error[k]) / max(float(sums.bare[own].sum()), 1e-30)
    if explained < MIN_EXPLAINED:  # the photos say nothing: skin is as usual, everything else has no layer
        if prior.assumed and _is_free(prior.assumed, h[-1], g[-1], q[-1], float(sums.bare[own].sum())):
            return _Group(prior.assumed, prior.assumed, float(np.sqrt(ALPHAS[-1])), explained, assumed=True)
        return _Group(prior.usual, prior.usual, prior.roughness, explained)
    if mean[k] > prior.most:
        return _Group(0.0, 0.0, prior.roughness, explained, refused=float(mean[k]))
    rough, fitted = _lowest(np.sqrt(ALPHAS).astype(np.float64), cost), float(mean[k])
    told = precision_share(np.sqrt(ALPHAS), cost, prior.spread)
    if prior.usual:
        f0 = float(np.clip(drawn(fitted, prior.usual, explained), *prior.f0))
        return _Group(f0, fitted, rough, explained, measured=True, told=(weight_of(explained), told))
    f0 = at_least(fitted, float(g[k] / h[k]), FREE * float(error[k] / h[k]))
    if f0 <= 0:
        return _Group(f0, fitted, rough, explained)
    # where F0 is raised, the photos tell a layer and its roughness, and of F0 only that it is small
    return _Group(f0, f0, rough, explained, measured=True, told=(fitted / f0, told))


def _is_free(f0: float, h: float, g: float, q: float, bare: float) -> bool:
    """Whether the photos allow the roughest layer of this F0: matt bone, stone and paint have one as well."""
    return q - 2 * f0 * g + f0**2 * h < (1 + FREE) * bare


def at_least(fitted: float, best: float, free: float) -> float:
    """Mean F0 of a material without a usual one: `fitted`, the regression's (>= 0), but LEAST_F0 where it is below and
    photos allow it: (F0 - best)^2 <= (fitted - best)^2 + free. best: F0 of the least error, of any sign; free: FREE of
    the error that is left, over H (>= 0)."""
    return max(fitted, min(LEAST_F0, best + float(np.hypot(fitted - best, np.sqrt(free)))))


def drawn(fitted: float, usual: float, explained: float) -> float:
    """Mean F0 from that of the regression and the usual one, by the share that the layer explains."""
    weight = weight_of(explained)
    return weight * fitted + (1 - weight) * usual


def weight_of(explained: float) -> float:
    """Weight of the photos in the mean F0 of a material with a usual one, by the share that the layer explains."""
    odds = max(explained, 0.0) / max(1 - explained, 1e-9)
    return odds / (odds + HALF)


def precision_share(x: npt.NDArray[np.floating], cost: F64, spread: float) -> float:
    """Share of the photos in the precision of a roughness, in [0, 1]: 1 - prior'' / cost'' at the least of the costs
    (K,) over x (K,), negative log likelihoods that include the prior's of this standard deviation."""
    k = int(np.clip(cost.argmin(), 1, len(x) - 2))
    curve = 2 * float(np.polyfit(x[k - 1 : k + 2].astype(np.float64), cost[k - 1 : k + 2], 2)[0])
    return float(np.clip(1 - spread**-2 / max(curve, 1e-12), 0, 1))


def _lowest(x: F64, cost: F64) -> float:
    """Place of the least cost (K,) over x (K,), between the samples by a parabola."""
    k = int(cost.argmin())
    if k in (0, len(x) - 1):
        return float(x[k])
    a, b, _ = np.polyfit(x[k - 1 : k + 2], cost[k - 1 : k + 2], 2)
    return float(np.clip(-b / (2 * a), x[k - 1], x[k + 1]))
