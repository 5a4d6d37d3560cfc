"""Cross-validation of nested regression models of the photos on validation views.

    c_pv = g_v (D_p + L_s(p, v)),    L_s = w_pv sum_lm L_lm A_l(s_p) Y_lm(w_r)

Symbols: c_pv (M, 3) colour of point p in view v; D_p everything that does not depend on the view, free for every point
(all diffuse shading with its shadows); g_v gain of a view per colour channel; L_lm light; w_r mirror direction; w and
s = 1 / kappa strength and width of the lobe at this time of the fit. D_p is eliminated by subtracting each point's mean
over the training views. So every model is a linear least-squares problem with a closed-form solution.

Validation error: L and D_p come from the training views, the gain of a validation view from every second of its points;
the error is over its other points. The residual of a lobe is an additive light, not a gain. So gains must be better
than one offset per view, or gains alone better than a lobe alone. All errors are RMS, as shares of the photos' mean
radiance. A part of the model is kept if the validation error without it is larger, in quadrature, by more than
`NEGLIGIBLE`.

Source: fixed-effects regression and reduced-rank regression, textbook statistics; the criterion is ours.
"""

from __future__ import annotations

import math
from dataclasses import dataclass, field

import numpy as np
import numpy.typing as npt
import torch

from pipeline.fields.face import FaceModel
from pipeline.maths import sh
from pipeline.maths.vmf import ATTENUATIONS
from stages.inverse_rendering.observations import MIN_COSINE, Observations, lobe_basis, point_means

F64 = npt.NDArray[np.float64]
I64 = npt.NDArray[np.int64]
BOOL = npt.NDArray[np.bool_]

NEGLIGIBLE = 0.005  # of the mean radiance: at medium grey an error of 52 dB, far below the error of any fit
MIN_TRAIN = 3  # fewest training views of a point
MIN_TEST = 100  # fewest observations for a validation error
RIDGE = 1e-9  # of the mean eigenvalue
ROUNDS = 20
COSINE_POWERS = 4  # number of powers of n . wo in a basis
RANK_ROUNDS = 12
RANK_RIDGE = 1e-4  # of the mean region's trace
WORTH = 0.002  # of the error: smallest reduction by a further basis; small, because a basis costs hardly any time
REGIONS = 5  # per axis: regions with their own coefficients


@dataclass(slots=True)
class ValidationSamples:
    """Observations, divided into train, tune and test. point, view (M,); colour (M, 3) in units of the mean radiance;
    cosine (M,) n . wo; x (M, 3) positions; counts (P,) number of training views of each point.

    train: (M,) of fitted views; tune, test: (M,) of validation views, points of even and of odd number. features
    (M, (L + 1)^2): L_s is linear in them. inside: features minus their means; gram: their products over train.
    """

    point: I64
    view: I64
    colour: F64
    features: F64
    cosine: F64
    x: F64
    train: BOOL
    tune: BOOL
    test: BOOL
    counts: F64
    inside: F64 = field(init=False)
    gram: F64 = field(init=False)

    def __post_init__(self) -> None:
        self.inside = self.within(self.features)
        known = self.inside[self.train]
        self.gram = known.T @ known

    def within(self, y: F64) -> F64:
        """y (M, C) minus its mean over the training views of the same point."""
        return np.asarray(y - point_means(self.point[self.train], y[self.train], self.counts)[self.point], np.float64)


def validation_samples(seen: Observations, validation: tuple[int, ...], model: FaceModel) -> ValidationSamples | None:
    """The samples for cross-validation; None if too few points are visible in enough views. validation: positions of
    the validation views."""
    held = np.isin(seen.view, validation)
    counts = np.bincount(seen.point[~held], minlength=len(seen.x))
    keep = counts[seen.point] >= MIN_TRAIN
    odd = seen.point % 2 == 1
    if (keep & held & odd).sum() < MIN_TEST or (keep & held & ~odd).sum() < MIN_TEST:
        return None
    return _of(seen, keep, lobe_features(model, seen, keep), counts, (~held, held & ~odd, held & odd))


def _of(
    seen: Observations, keep: BOOL, features: F64, counts: I64, parts: tuple[BOOL, BOOL, BOOL]
) -> ValidationSamples:
    """The kept observations with their features, divided into `parts`: train, tune and test."""
    point, colour = seen.point[keep], seen.colour[keep]
    train, tune, test = (part[keep] for part in parts)
    return ValidationSamples(
        point,
        seen.view[keep],
        colour / max(float(colour.mean()), 1e-12),
        features,
        seen.cosine[keep],
        seen.x.detach().cpu().double().numpy()[point],
        train,
        tune,
        test,
        np.maximum(counts, 1).astype(np.float64),
    )


def lobe_features(model: FaceModel, seen: Observations, keep: BOOL) -> F64:
    """w A_l(s) Y_lm(w_r) with the fit's current lobe, (M, (L + 1)^2): L_s is linear in them."""
    order = model.spec.light_order
    with torch.no_grad():
        point = torch.from_numpy(seen.point[keep]).to(seen.x.device)
        toward = torch.from_numpy(seen.wo[keep]).to(seen.x)
        _, rho, c, s = model.spatial(seen.x)
        strength = rho[point] * model.basis.integral(seen.x[point], c[point], toward, seen.n[point])
        falls = ATTENUATIONS[model.spec.attenuation](s, order).cpu().numpy()[seen.point[keep]]
        weight = (strength / strength.mean().clamp(min=1e-12)).cpu().numpy()
    return lobe_basis(seen.mirror[keep], weight[:, None] * falls)


# ------------------------------------------------------------------ solving
@dataclass(slots=True)
class Response:
    """Colour response of each view: c -> gain c + offset, (V, 3) each. Mean gain 1, mean offset 0."""

    gain: F64
    offset: F64


def alike(t: ValidationSamples) -> Response:
    """The response with gain 1 and offset 0 for all views."""
    count = int(t.view.max()) + 1
    return Response(np.ones((count, 3)), np.zeros((count, 3)))


def lobe(t: ValidationSamples, order: int | None, r: Response) -> tuple[F64, F64]:
    """L_s up to SH `order` (None: no lobe), given the responses: the residual of the colours, and L_s, (M, 3) each,
    before the responses are applied."""
    y = t.within((t.colour - r.offset[t.view]) / r.gain[t.view])
    if order is None:
        return y, np.zeros_like(y)
    k = sh.count(order)
    f, g = t.inside[:, :k], t.gram[:k, :k]
    ridge = RIDGE * max(float(np.trace(g)) / k, 1e-12)
    b = np.linalg.solve(g + ridge * np.eye(k), f[t.train].T @ y[t.train])
    return y - f @ b, t.features[:, :k] @ b


def solve_response(t: ValidationSamples, order: int | None, *, gain: bool) -> Response:
    """Gains of all views with the lobe of `order`; or offsets, which no camera has, as a control."""
    r = alike(t)
    rows = t.train | t.tune
    known = np.isin(np.arange(len(r.gain)), t.view[t.train])
    view, count = t.view[rows], len(r.gain)
    for _ in range(ROUNDS):
        left, _ = lobe(t, order, r)
        shown, free = t.colour[rows], ((t.colour - r.offset[t.view]) / r.gain[t.view] - left)[rows]
        for c in range(3):
            if gain:
                under = np.bincount(view, free[:, c] ** 2, count)
                over = np.bincount(view, shown[:, c] * free[:, c], count)
                r.gain[:, c] = np.where(under > 0, over / np.maximum(under, 1e-12), 1.0)
            else:
                number = np.maximum(np.bincount(view, minlength=count), 1)
                r.offset[:, c] = np.bincount(view, shown[:, c] - free[:, c], count) / number
        r.gain /= r.gain[known].mean(0)
        r.offset -= r.offset[known].mean(0)
    return r


def gains_of(seen: Observations) -> F64 | None:
    """Gains (V, 3) of the views with observations, without a lobe; None if no point is visible in enough views."""
    counts = np.bincount(seen.point, minlength=len(seen.x))
    keep = counts[seen.point] >= MIN_TRAIN
    if not keep.any():
        return None
    t = _of(seen, keep, np.zeros((int(keep.sum()), 1)), counts, (keep, ~keep, ~keep))
    return solve_response(t, None, gain=True).gain[np.unique(t.view)]


def validation_error(t: ValidationSamples, order: int | None, r: Response) -> float:
    """Validation error (RMS, as a share of the mean radiance)."""
    left, _ = lobe(t, order, r)
    return rms((left * r.gain[t.view])[t.test])


def rms(error: F64) -> float:
    """Root mean square of all entries."""
    return float(np.sqrt(np.mean(error * error)))


def more(without: float, with_it: float) -> float:
    """Increase of an error without a part of the model: sqrt(e_0^2 - e_1^2), negative if it decreases."""
    d = without * without - with_it * with_it
    return math.copysign(math.sqrt(abs(d)), d)


# ------------------------------------------------------------------ the rank
def by_rank(t: ValidationSamples, order: int, r: Response, most: int) -> list[float]:
    """Validation error with k = 1..most bases: L_s = q_pv sum_j c_rj B_j(n . wo), c free in each region r of space.

    q is first the lobe with one strength for all, then the lobe for the strengths that were solved with it. B_j are
    sums of powers of the cosine. c and B are solved alternately by least squares (reduced-rank regression).
    """
    shown = ((t.colour - r.offset[t.view]) / r.gain[t.view]).mean(1, keepdims=True)
    y = t.within(shown)
    region = regions_of(t)
    powers = ((1 - t.cosine) / (1 - MIN_COSINE))[:, None] ** np.arange(COSINE_POWERS)
    errors, first = [], _common_lobe(t, order, y, np.ones(len(y)))
    for k in range(1, most + 1):
        f = t.within(first[:, None] * powers)
        c = _low_rank(f, y[:, 0], region, t.train, k)
        f = t.within(_common_lobe(t, order, y, (powers * c[region]).sum(1))[:, None] * powers)
        c = _low_rank(f, y[:, 0], region, t.train, k)
        errors.append(rms((y[:, 0] - (f * c[region]).sum(1))[t.test]))
    return errors


def least_rank(errors: list[float]) -> int:
    """The smallest k whose error is negligible, or within WORTH of the best.

    Stricter than for other parts: on `head_a` a rank of 1, with an error 1.2 % larger, cost 0.3 dB (docs/model.md).
    """
    best = min(errors)
    return next(k for k, e in enumerate(errors, 1) if e < NEGLIGIBLE or e < (1 + WORTH) * best)


def _common_lobe(t: ValidationSamples, order: int, y: F64, strength: F64) -> F64:
    """(M,) the lobe of the light that, times `strength` (M,), is the least-squares fit to y (M, 1) within points."""
    features = t.features[:, : sh.count(order)]
    f = t.within(features * strength[:, None])
    g = f[t.train].T @ f[t.train]
    g += RIDGE * max(float(np.trace(g)) / len(g), 1e-12) * np.eye(len(g))
    return np.asarray((features @ np.linalg.solve(g, f[t.train].T @ y[t.train]))[:, 0], np.float64)


def regions_of(t: ValidationSamples) -> I64:
    """(M,) index of the box of space that contains a point, REGIONS along the longest side; sparse boxes are merged."""
    lo, hi = t.x.min(0), t.x.max(0)
    edge = float((hi - lo).max()) / REGIONS * 1.0001
    i = ((t.x - lo) / max(edge, 1e-12)).astype(np.int64)
    flat = (i[:, 0] * REGIONS + i[:, 1]) * REGIONS + i[:, 2]
    many = np.bincount(flat[t.train], minlength=REGIONS**3) >= 10 * COSINE_POWERS
    number = np.where(many, np.cumsum(many), 0)
    return np.asarray(number[flat], np.int64)


def _low_rank(f: F64, y: F64, region: I64, train: BOOL, k: int) -> F64:
    """(R, J) coefficients C = U B of rank k of the model f_m . C_r(m), fitted to y (M,) on `train`."""
    count, width = int(region.max()) + 1, f.shape[1]
    gram, right = np.zeros((count, width, width)), np.zeros((count, width))
    for r in range(count):
        rows = train & (region == r)
        gram[r], right[r] = f[rows].T @ f[rows], f[rows].T @ y[rows]
    gram += RANK_RIDGE * np.trace(gram.sum(0)) / count * np.eye(width)
    basis = np.eye(width)[:k]
    u = _strengths(gram, right, basis)
    for _ in range(RANK_ROUNDS):
        system = np.einsum("rk,rij,rl->kilj", u, gram, u).reshape(k * width, k * width)
        system += 1e-9 * max(float(np.trace(system)), 1e-12) * np.eye(len(system))
        basis = np.linalg.solve(system, np.einsum("rk,ri->ki", u, right).ravel()).reshape(k, width)
        basis /= np.maximum(np.linalg.norm(basis, axis=1, keepdims=True), 1e-12)
        u = _strengths(gram, right, basis)
    return u @ basis


def _strengths(gram: F64, right: F64, basis: F64) -> F64:
    """(R, k) least-squares coefficients of every region for given bases (k, J)."""
    own = np.einsum("ki,rij,lj->rkl", basis, gram, basis)
    own += 1e-9 * np.maximum(np.trace(own, axis1=1, axis2=2), 1e-12)[:, None, None] * np.eye(len(basis))
    return np.asarray(np.linalg.solve(own, (right @ basis.T)[..., None])[..., 0], np.float64)
