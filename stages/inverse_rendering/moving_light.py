"""Does the light stand still relative to the subject, or relative to the camera? Decided before the fit, on the initial
geometry, by photos that had no vote.

    world                       c_pv = g_v D_p
    turntable, camera, flash    c_pv = g_v a_p s_pv E(R_pv^T n_p)

Symbols: c_pv colour (mean of the channels) of point p in view v; g_v gain of a view; D_p the point's radiance; a_p its
albedo; E(n) = sum_k f_k max(n . w_k, 0) the irradiance of LAMPS lamps with flux f_k >= 0 in the light's frame R_pv;
s_pv the falloff (pipeline.maths.light_frame).

Each model is fitted to the views without a vote by alternating least squares, the flux by non-negative ones; a
validation view's gain is found from every second of its points, and its error at the others. Under a light that moves
with the camera a point is bright where it faces the camera, which no D_p explains; under a still light a point keeps
its radiance, which no light in the camera's frame explains. Both models have one free number a
point, so the errors can be compared.

Source: ours; bilinear regression and non-negative least squares, textbook methods.
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
import numpy.typing as npt
import torch
from scipy.optimize import nnls

from pipeline.maths import sh
from pipeline.maths.light_frame import CAMERA, FLASH, MOVING, TURNTABLE, WORLD, Stations, turn_of
from stages.inverse_rendering.initial_geometry import Start
from stages.inverse_rendering.observations import Observations, observe, pictures
from stages.inverse_rendering.ray_sampling import PhotoView
from stages.inverse_rendering.stereo import surface_points

F64 = npt.NDArray[np.float64]
I64 = npt.NDArray[np.int64]
Bool = npt.NDArray[np.bool_]

SAMPLES = 2000  # points
LAMPS = 100  # over the sphere, 20 degrees apart
MIN_VIEWS, MIN_SEEN, MIN_TEST = 8, 3, 100  # views; training views of a point; observations for an error
EVERY = 6  # one view in so many has no vote
ROUNDS = 12
CLEARLY = 0.8  # of the still light's error: a moving light must be better than that
FLASHED = 1.0  # the same where more than MOST of the photos say that a flash fired
MOST = 0.5
NEARLY = 1.05  # of the error: a turntable is chosen before lamps on the camera up to that
RIDGE = 1e-3  # of the mean eigenvalue: lamps behind the subject, which hardly light what a photo shows, go out


@dataclass(frozen=True, slots=True)
class LightFrame:
    """Where the light stands still (pipeline.maths.light_frame); errors of the models as shares of the mean radiance,
    NaN where nothing could be compared. flux (LAMPS,): of a moving light, for a mean irradiance of 1 over the
    observations; None of a still one. spread: standard deviation of the photos' gains g_v under the chosen light, whose
    mean is 1. distance: d_0, the median distance of the points from their cameras."""

    frame: str
    errors: dict[str, float]
    flux: F64 | None
    distance: float
    why: str
    spread: float = 0.0

    def facts(self) -> dict[str, str | float | bool]:
        """For the report."""
        known = {f"error_{k}": round(e, 5) for k, e in self.errors.items() if np.isfinite(e)}
        return {"frame": self.frame, "why": self.why, **known}


def light_frame(views: list[PhotoView], start: Start, wanted: str, device: str, flashed: float = 0.0) -> LightFrame:
    """Decide it. wanted: the setting, `auto` or a frame. flashed: share of the photos whose metadata say that a flash
    fired."""
    points, normals = surface_points(start.values, start.lo, start.cell)
    every = max(len(points) // SAMPLES, 1)
    x, n = (torch.from_numpy(a[::every].astype(np.float32)).to(device) for a in (points, normals))
    if wanted == WORLD or not len(x):
        return LightFrame(WORLD, {}, None, 1.0, "setting" if wanted == WORLD else "no surface")
    return decide(observe(start.surface(device), pictures(views), x, n), views, wanted, flashed)


def decide(seen: Observations, views: list[PhotoView], wanted: str, flashed: float = 0.0) -> LightFrame:
    """The same, from observations."""
    stations, distance = _stations(seen, views)
    parts = _divided(seen)
    found = {f: _solve(seen, parts, _lit(f, seen, stations, distance)) for f in (WORLD, *MOVING)}
    errors = {f: one.error for f, one in found.items()}
    frame, why = wanted, "setting"
    if wanted == "auto":
        frame, why = chosen_frame(errors, flashed > MOST)
    own = found[frame]
    return LightFrame(frame, errors, own.flux if frame != WORLD else None, distance, why, own.spread)


def chosen_frame(errors: dict[str, float], flashed: bool) -> tuple[str, str]:
    """The frame, and the reason. flashed: whether the metadata say that a flash fired."""
    if not all(np.isfinite(e) for e in errors.values()):
        return (FLASH, "metadata") if flashed else (WORLD, "too few views to compare")
    moving = min(MOVING, key=lambda f: errors[f])
    if moving == CAMERA and errors[TURNTABLE] < NEARLY * errors[CAMERA]:
        moving = TURNTABLE  # far more common than distant lamps on the camera
    limit = FLASHED if flashed and moving != TURNTABLE else CLEARLY
    return moving if errors[moving] < limit * errors[WORLD] else WORLD, "cross-validation"


def _stations(seen: Observations, views: list[PhotoView]) -> tuple[Stations, float]:
    """The camera of each observation, and the median distance."""
    eye = torch.from_numpy(np.stack([v.world_from_cam[:3, 3] for v in views]))[seen.view]
    axes = torch.from_numpy(np.stack([v.world_from_cam[:3, :3] for v in views]))[seen.view]
    away = (seen.x.double().cpu()[seen.point] - eye).norm(dim=-1)
    return Stations(eye, axes), float(away.median()) if len(away) else 1.0


def _lit(frame: str, seen: Observations, stations: Stations, distance: float) -> F64:
    """(M, K) irradiance of each of the model's lamps: E is a sum of them. One that is everywhere alike for `world`."""
    if frame == WORLD:
        return np.ones((len(seen.point), 1))
    x, wo = seen.x.double().cpu()[seen.point], torch.from_numpy(seen.wo)
    turn = turn_of(frame, stations, x, wo, distance)
    cosine = turn(torch.from_numpy(seen.normal)) @ torch.from_numpy(np.ascontiguousarray(sh.spiral(LAMPS).T))
    return np.asarray((cosine.clamp(min=0) * turn.strength).numpy(), np.float64)


@dataclass(frozen=True, slots=True)
class _Parts:
    """Masks (M,) of the observations: train, tune and test."""

    train: Bool
    tune: Bool
    test: Bool


def _divided(seen: Observations) -> _Parts:
    held = seen.view % EVERY == EVERY // 2
    often = np.bincount(seen.point[~held], minlength=len(seen.x)) >= MIN_SEEN
    keep, odd = often[seen.point], seen.point % 2 == 1
    return _Parts(keep & ~held, keep & held & ~odd, keep & held & odd)


@dataclass(frozen=True, slots=True)
class _Solved:
    """A model's error on the validation views, the flux of its lamps, and the spread of the gains."""

    error: float
    flux: F64
    spread: float


def _solve(seen: Observations, parts: _Parts, lit: F64) -> _Solved:
    flux = np.ones(lit.shape[1])
    if len(np.unique(seen.view)) < MIN_VIEWS or parts.test.sum() < MIN_TEST or parts.tune.sum() < MIN_TEST:
        return _Solved(float("nan"), flux / max(float(lit.sum()) / max(len(lit), 1), 1e-12), 0.0)
    c = seen.colour.mean(1)
    c = c / max(float(c.mean()), 1e-12)
    point, view, rows = seen.point, seen.view, parts.train
    gain, albedo = np.ones(int(view.max()) + 1), np.ones(len(seen.x))
    for _ in range(ROUNDS):
        albedo = _ratio(point[rows], (gain[view] * (lit @ flux))[rows], c[rows], len(albedo))
        flux = _positive((gain[view] * albedo[point])[rows, None] * lit[rows], c[rows])
        flux /= max(float((lit[rows] @ flux).mean()), 1e-12)
        gain = _ratio(view[rows], (albedo[point] * (lit @ flux))[rows], c[rows], len(gain))
        gain /= max(gain[np.unique(view[rows])].mean(), 1e-12)
    shown = albedo[point] * (lit @ flux)
    own = _ratio(view[parts.tune], shown[parts.tune], c[parts.tune], len(gain))
    left = (c - own[view] * shown)[parts.test]
    return _Solved(float(np.sqrt(np.mean(left**2))), flux, float(gain[np.unique(view[rows])].std()))


def _positive(m: F64, y: F64) -> F64:
    """Non-negative x (K,) of the least |m x - y|^2, m (M, K), by its normal equations."""
    g = m.T @ m
    root = np.linalg.cholesky(g + RIDGE * max(np.trace(g) / len(g), 1e-12) * np.eye(len(g)))
    return np.asarray(nnls(root.T, np.linalg.solve(root, m.T @ y))[0], np.float64)


def _ratio(group: I64, x: F64, y: F64, count: int) -> F64:
    """(count,) least-squares factor of x for y in each group; 1 for a group without x."""
    under = np.bincount(group, x * x, count)
    return np.where(under > 1e-12, np.bincount(group, x * y, count) / np.maximum(under, 1e-12), 1.0)


def first_light(flux: F64, order: int) -> F64:
    """((order + 1)^2,) SH of the radiance of the lamps' flux (LAMPS,), for a mean irradiance of pi.

    Bands are attenuated as by a Gaussian of the lamps' spacing, because a band-limited lamp rings.
    """
    degree = np.repeat(np.arange(order + 1), 2 * np.arange(order + 1) + 1)
    basis = sh.sh_basis(torch.from_numpy(sh.spiral(LAMPS)), order).numpy()
    spread = np.exp(-degree * (degree + 1) * (4 * np.pi / LAMPS) / (2 * np.pi))
    return np.asarray(np.pi * spread * (flux @ basis), np.float64)
