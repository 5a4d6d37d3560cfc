"""The captured light as one picture: what the photos show where they show it, elsewhere what then explains the light
on the subject.

    R = k P + (1 - k) max((1 - w) P + w (a + sum_i q_i Y_i) + q_h h, h P)

Symbols
    P, k, h        what the photos show, how far it is known, and where they are clipped (surroundings.py)
    w              0 up to NEAR from what they show, 1 from FAR on: a gap goes on as its edges
    a              the median of P, or the mean of the fitted light where nothing is known but clipped places
    Y_i            the harmonics up to ORDER
    q_h            the brightness of all clipped places, above the pictures around them
    E(n), E_R(n)   irradiance of the fitted light, and of R
    f(n)           how well the photos see a surface of the normal n

q is the least, over the three colours c, each in units of the mean of E, of

    sum_n f(n) |E_R(n) - E(n)|^2 / pi^2 + sum_i (1 + l_i^2) (TIE^2 |mean_c q_i|^2 + TIE_COLOUR^2 |q_i - mean_c q_i|^2)

The fitted light is not used itself where nothing is known. Its harmonics were found from what reaches the subject: the
light of a window lies on half of the sphere in them, and no photo tells the light behind a person who is shown from the
front. In a room of which the truth is known the logarithm of R is off by 1.0, of the fitted light by 1.7 (person_c:
docs/benchmarks.md, Surroundings in the photos). The sum is least squares where the set of places that the maximum cuts
is fixed: Gauss-Newton steps, with a factor against jumps of that set.
"""

from __future__ import annotations

from dataclasses import dataclass

import cv2
import numpy as np
import numpy.typing as npt

from pipeline.lighting.dome import environment, harmonics
from pipeline.lighting.surroundings import Surroundings
from pipeline.maths import sh
from pipeline.maths.latlong import latlong_weights
from pipeline.maths.smoothstep import smoothstep

F32 = npt.NDArray[np.float32]
F64 = npt.NDArray[np.float64]

ORDER = 6  # of the harmonics in what is not known
TIE, TIE_COLOUR = 0.01, 0.05  # a difference of .01 from the median costs as much as an error of .01 of the irradiance
FREE = 0.1, 0.01  # factors of the tie of the mean, and of the clipped places: they may have any brightness
NEAR, FAR = np.radians(5.0), np.radians(20.0)
SOLVE_WIDTH, STEPS, DAMPING, ENOUGH = 64, 60, 0.6, 1e-4
LOWEST = 4  # order up to which irradiance is compared, also of a light with fewer: higher ones hardly reach it
CONTRADICTS = 0.15  # error of the irradiance from which what photos show and what the subject received disagree
KNOWN = 0.9  # share from which a place counts for the median


def captured_environment(light: F32, width: int, around: Surroundings | None) -> F32:
    """(width / 2, width, 3) picture of the captured light, nowhere negative, for any renderer. light: its fitted
    harmonics ((L + 1)^2, 3); around: what the photos show. `dome.environment` without it, and where no picture that
    shows it has the irradiance that the subject received: the level of the light may be wrong, where nothing tells
    it."""
    problem = None if around is None else _Problem.of(light, around)
    if around is None or problem is None:
        return environment(light, width)
    picture = problem.picture(problem.solve(), around)
    if irradiance_error(light, picture, around) > CONTRADICTS:
        return environment(light, width)
    return np.asarray(_resized(picture, width).reshape(width // 2, width, 3), np.float32)


def irradiance_error(light: F32, image: F32, around: Surroundings) -> float:
    """Error of the picture's irradiance (H, W, 3) against the fitted light's: root mean square over the normals that
    photos see, relative to the mean of E."""
    solid, basis = _solid(SOLVE_WIDTH), harmonics(SOLVE_WIDTH, sh.ORDER)
    facing = _facing(around)
    found = basis.T @ (solid * _resized(image, SOLVE_WIDTH))
    scale = sh.clamped_cosine(sh.ORDER).numpy()[:, None]
    wanted = basis @ (scale * _padded(light, sh.ORDER))
    mean = np.maximum(np.abs((facing * wanted).sum(0)), 1e-12)
    error = (basis @ (scale * found) - wanted) / mean
    return float(np.sqrt((facing * error**2).sum(0).mean()))


@dataclass(frozen=True, slots=True)
class _Problem:
    """The sum of squares on pixels of SOLVE_WIDTH. weights (n, 1): solid angles; basis (n, m): of q; known, least,
    start (n, 3) and free (n, 1): the picture; low (n, L): harmonics up to the order in which irradiance is compared, of
    which the light has `wanted` (L, 3); metric (L, L): of irradiance; unit, median (3,): of the colours; ties (m,)."""

    weights: F64
    basis: F64
    known: F64
    free: F64
    least: F64
    start: F64
    low: F64
    wanted: F64
    metric: F64
    unit: F64
    median: F64
    ties: F64

    @classmethod
    def of(cls, light: F32, around: Surroundings) -> _Problem | None:
        """None where the fitted light is not positive, so that there is no unit."""
        weights, order = _solid(SOLVE_WIDTH), max(int(np.sqrt(len(light))) - 1, LOWEST)
        wanted = _padded(light, order)
        low, scale = harmonics(SOLVE_WIDTH, order), sh.clamped_cosine(order).numpy()
        facing = _facing(around)
        unit = (facing * ((low * scale) @ wanted)).sum(0) / np.pi
        if not (unit > 0).all():
            return None
        known, free, least = _parts(around, SOLVE_WIDTH)
        sure = free[:, 0] < 1 - KNOWN
        median = np.median(known[sure] / (1 - free[sure]), 0) if sure.any() else unit
        basis = _full_basis(around, SOLVE_WIDTH)
        start = _start(around, median, SOLVE_WIDTH)
        band = np.repeat(np.arange(ORDER + 1.0), 2 * np.arange(ORDER + 1) + 1)
        ties = np.append(1 + band**2, [FREE[1] ** 2] * (basis.shape[1] - len(band)))
        ties[0] *= FREE[0]
        metric = scale[:, None] * (low.T @ (facing * low)) * scale / np.pi**2
        known, least, start, wanted = (x / unit for x in (known, least, start, wanted))
        return cls(weights, basis, known, free, least, start, low, wanted, metric, unit, median, ties)

    def solve(self) -> F64:
        """q (m, 3), in units of the colours."""
        m = self.basis.shape[1]
        q, mean = np.zeros((m, 3)), np.full((3, 3), 1 / 3)
        tie = np.kron(TIE**2 * mean + TIE_COLOUR**2 * (np.eye(3) - mean), np.diag(self.ties))
        for _ in range(STEPS):
            shown = self.start + self.basis @ q
            left = self.wanted - self.low.T @ (self.weights * (self.known + self.free * np.maximum(shown, self.least)))
            above = shown >= self.least * (1 - 1e-6)  # at the limit as well: it may rise
            matrix, side = tie.copy(), -tie @ q.T.reshape(-1)
            for c in range(3):
                slope = self.low.T @ (self.weights * self.free * above[:, [c]] * self.basis)
                part = slice(c * m, (c + 1) * m)
                matrix[part, part] += slope.T @ self.metric @ slope
                side[part] += slope.T @ self.metric @ left[:, c]
            step = np.linalg.solve(matrix, side).reshape(3, m).T
            q += DAMPING * step
            if np.abs(step).max() < ENOUGH:
                break
        return q

    def picture(self, q: F64, around: Surroundings) -> F32:
        """(H, W, 3) R, as large as what photos show."""
        width = around.away.shape[1]
        known, free, least = _parts(around, width)
        shown = _start(around, self.median, width) + (_full_basis(around, width) @ q) * self.unit
        found = known + free * np.maximum(shown, least)
        return np.asarray(found.reshape(width // 2, width, 3), np.float32)


def _solid(width: int) -> F64:
    """(pixels, 1) solid angles."""
    shape = width // 2, width
    return np.broadcast_to(latlong_weights(*shape[::-1]), shape).reshape(-1, 1)


def _facing(around: Surroundings) -> F64:
    """(pixels of SOLVE_WIDTH, 1) f times the solid angle; the sum is 1."""
    weight = _solid(SOLVE_WIDTH) * _resized(around.facing, SOLVE_WIDTH)[:, None]
    return np.asarray(weight / weight.sum())


def _padded(light: F32, order: int) -> F64:
    """((order + 1)^2, 3) harmonics of a light, with 0 for those that it does not have."""
    out = np.zeros(((order + 1) ** 2, 3))
    out[: len(light)] = light[: len(out)]
    return out


def _far(around: Surroundings, width: int) -> F64:
    """(pixels, 1) w."""
    return smoothstep(_resized(around.away, width), NEAR, FAR)[:, None]


def _start(around: Surroundings, median: F64, width: int) -> F64:
    """(pixels, 3) the picture in what is not known, without B. median (3,)."""
    far = _far(around, width)
    return (1 - far) * _resized(around.radiance, width) + far * median


def _full_basis(around: Surroundings, width: int) -> F64:
    """(pixels, m) the functions of q: w Y_i, and h if there are clipped places."""
    smooth = _far(around, width) * harmonics(width, ORDER)
    return np.concatenate([smooth, _clipped(around, width)], 1) if around.clipped.any() else smooth


def _clipped(around: Surroundings, width: int) -> F64:
    """(pixels, 1) the share of a pixel's unknown part that is clipped."""
    free = 1 - _resized(around.share, width)
    return (_resized(around.clipped, width) / np.maximum(free, 1e-6)).clip(max=1)[:, None]


def _parts(around: Surroundings, width: int) -> tuple[F64, F64, F64]:
    """The known radiance (pixels, 3) times its share, the share (pixels, 1) that is free, and the least (pixels, 3)."""
    known, radiance = (_resized(x, width) for x in (around.radiance * around.share[..., None], around.radiance))
    return known, 1 - _resized(around.share, width)[:, None], radiance * _clipped(around, width)


def _resized(image: F32, width: int) -> F64:
    """(pixels, ...) a picture at another size."""
    how = cv2.INTER_AREA if width < image.shape[1] else cv2.INTER_LINEAR
    out = np.asarray(cv2.resize(image, (width, width // 2), interpolation=how), np.float64)
    return out.reshape(width * width // 2, *image.shape[2:])
