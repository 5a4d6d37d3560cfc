"""The low bands of two lights from places that both captures show: both must give one albedo.

    D_p / (s_p E(n_p)) = D'_p / (s'_p E'(n_p)),    D_p = mean over views of (c_pv - w_pv sum_lm A_l L_lm Y_lm(w_r))

Symbols as in second_capture.py: c the photos' colours, D the diffuse radiance, E the irradiance of the light L, s the
shadows, w the reflectance; a prime marks the second capture.

One light can't be told from an albedo that changes with the normal: a(x) g(n) under E / g looks the same as a(x) under
E. Two lights can. If g turned both E and E' into irradiances again, E' dE = E dE' on the whole sphere; irradiances are
polynomials of degree 2 in n, so that dE is a multiple of E unless E and E' have a common factor. What is left is one
factor for each colour: the level of the albedo and the white balance of the lights, which other sources tell
(albedo_level.py). So the correction keeps them: both lights are divided, in each colour, by the factor by which the
mean of ln E over the places has risen. Then the mean of ln a stays as well.

The logarithm of the equation is solved by Gauss-Newton steps with Huber's weights, for each colour: the bands 0 to 2 of
L' and the bands 1 and 2 of L. The prior of a change b, in units of the light's band 0, is N(0, STD^2); band 0 of L' is
free. Noise counts as that of PATCHES places, because shadows and errors of the surface are alike around a point.
"""

from __future__ import annotations

from dataclasses import dataclass, replace

import numpy as np
import numpy.typing as npt
import torch

from pipeline.maths import sh

F64 = npt.NDArray[np.float64]
Bool = npt.NDArray[np.bool_]
ORDER = 2  # of the bands that change: irradiance has hardly more
STD, FREE = 0.05, 10.0
PATCHES = 200.0
ROUNDS = 12
HUBER, LEAST_NOISE = 1.5, 1e-3
DARKEST = 0.05  # of the mean: less irradiance, or less diffuse radiance, tells nothing
MIN_POINTS = 300


@dataclass(frozen=True, slots=True)
class Shown:
    """P places in one capture. total (P, 3): mean of their colours over the views; glow (P, (L + 1)^2): mean of w A_l
    Y_lm(w_r), which times the light is the specular part; shadow (P, 3); light ((L + 1)^2, 3)."""

    total: F64
    glow: F64
    shadow: F64
    light: F64

    def diffuse(self) -> F64:
        """D (P, 3)."""
        return np.asarray(self.total - self.glow @ self.light, np.float64)

    def arriving(self, rows: F64) -> F64:
        """s E (P, 3). rows: of `irradiance_rows`."""
        return np.asarray(self.shadow * (rows @ self.light), np.float64)


@dataclass(frozen=True, slots=True)
class Agreed:
    """Both lights after the correction, and the spread of ln(albedo / albedo') before and after it."""

    first: F64
    second: F64
    before: float
    after: float


def irradiance_rows(n: F64, order: int) -> F64:
    """Lambda_l Y_lm (P, (order + 1)^2) at unit normals n (P, 3): E = rows @ light. [NeuFace eq. 14]"""
    d = torch.from_numpy(np.asarray(n, np.float64))
    return np.asarray((sh.sh_basis(d, order) * sh.clamped_cosine(order).to(d)).numpy(), np.float64)


def agree(n: F64, first: Shown, second: Shown) -> Agreed | None:
    """The lights under which both captures show one albedo at places with unit normals n (P, 3); None if too few places
    tell it."""
    rows = [irradiance_rows(n, sh.order_of(torch.from_numpy(s.light))) for s in (first, second)]
    good = _told(first, rows[0]) & _told(second, rows[1])
    if good.sum() < MIN_POINTS:
        return None
    rows = [r[good] for r in rows]
    first, second = (replace(s, total=s.total[good], glow=s.glow[good], shadow=s.shadow[good]) for s in (first, second))
    before = _spread(first, second, rows)
    a, b = np.array(first.light), np.array(second.light)
    for c in range(3):
        a[:, c], b[:, c] = _solved(first, second, rows, c)
    risen = _risen(rows[0] @ first.light, rows[0] @ a)
    a, b = a / risen, b / risen
    after = _spread(replace(first, light=a), replace(second, light=b), rows)
    return Agreed(a, b, before, after) if np.isfinite(after) and after < before else None


def _told(s: Shown, rows: F64) -> Bool:
    """(P,) where light and colour are clear of zero."""
    out = np.ones(len(rows), np.bool_)
    for values in (s.arriving(rows), s.diffuse()):
        out &= (values > DARKEST * np.nanmedian(values, 0)).all(1)
    return out


def _spread(first: Shown, second: Shown, rows: list[F64]) -> float:
    """Mean over the colours of the mean absolute deviation of ln(albedo / albedo') from its median; inf where one is
    not positive."""
    parts = zip((first, second), rows, strict=True)
    ratio = [np.maximum(s.diffuse(), 0) / np.maximum(s.arriving(r), 1e-300) for s, r in parts]
    good = (ratio[0] > 0).all(1) & (ratio[1] > 0).all(1)
    if good.mean() < 0.9:
        return float("inf")
    log = np.log(ratio[0][good] / ratio[1][good])
    return float(np.abs(log - np.median(log, 0)).mean())


def _risen(before: F64, after: F64) -> F64:
    """(3,) geometric mean over the places of the ratio of two irradiances (P, 3), where both are positive."""
    lit = (before > 0) & (after > 0)
    logs = np.log(np.where(lit, after, 1.0)) - np.log(np.where(lit, before, 1.0))
    return np.asarray(np.exp(logs.sum(0) / np.maximum(lit.sum(0), 1)), np.float64)


def _solved(first: Shown, second: Shown, rows: list[F64], c: int) -> tuple[F64, F64]:
    """The coefficients of one colour of both lights."""
    k = sh.count(ORDER)
    lights = [np.array(s.light[:, c]) for s in (first, second)]
    units = [max(float(light[0]), 1e-12) for light in lights]
    k0, k1 = (min(k, len(light)) for light in lights)
    precision = np.concatenate([np.full(k0 - 1, STD**-2), [FREE**-2], np.full(k1 - 1, STD**-2)])
    total = np.zeros(len(precision))  # b so far
    for _ in range(ROUNDS):
        logs, slopes = [], []
        for s, r, light, unit, n in zip((first, second), rows, lights, units, (k0, k1), strict=True):
            dark = 1e-3 * unit
            d = np.maximum(s.total[:, c] - s.glow @ light, dark)
            e = np.maximum(r @ light, dark)
            logs.append(np.log(d) - np.log(e * s.shadow[:, c]))
            slopes.append(-unit * (s.glow[:, :n] / d[:, None] + r[:, :n] / e[:, None]))
        residual = logs[0] - logs[1]
        J = np.concatenate([slopes[0][:, 1:], -slopes[1]], 1)
        middle = np.abs(residual - np.median(residual))
        noise = max(1.4826 * float(np.median(middle)), LEAST_NOISE)
        weight = PATCHES / len(residual) / noise**2 / np.maximum(np.abs(residual) / (HUBER * noise), 1)
        A = (J * weight[:, None]).T @ J + np.diag(precision)
        step = -np.linalg.solve(A, (J * weight[:, None]).T @ residual + precision * total)
        step *= min(1.0, 0.3 / max(float(np.abs(step).max()), 1e-12))
        total += step
        lights[0][1:k0] += units[0] * step[: k0 - 1]
        lights[1][:k1] += units[1] * step[k0 - 1 :]
    return lights[0], lights[1]
