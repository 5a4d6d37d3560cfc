"""Correction of the light's low bands by what skin tells: its albedo does not depend on the direction that it faces.

    a(x) E(n) = kappa E'(n) + noise,   E' = E + E_0 sum_{lm} b_lm A_l Y_lm(n),   l = 1, 2

for each colour, with a the fitted albedo of the skin, E the irradiance of the fitted light, E_0 its mean over the skin.
kappa and kappa b are a linear least-squares problem, divided by E, with Huber weights (lips, brows, stubble). E' is the
irradiance of the light with coefficients L_lm + E_0 b_lm, whose mean radiance over the sphere stays white. All of it is
then scaled so that the mean irradiance of the face, and with it the level of its albedo, stays as it was.
Without this, light of two colours, of a window and a lamp, colours the two sides of the albedo.

The skin is what photos label as the face, and of the placed head what lies near it and has the face's colour: ears,
neck and a bare scalp face sides from which a face alone tells no light.

The corrected light must leave some irradiance in every direction, also in those that no skin faces: kappa E' >=
kappa E_min(d), linear in the unknowns, at directions d all around; E_min is DARKEST of the mean, or the irradiance
before where that is less. Such a quadratic problem is a least distance problem [Lawson and Hanson 1974, ch. 23].

What makes the luminance of the skin, or of the face alone, no more even is no error of the light, and is left out: on
a person between white walls the sheen of the cheeks' sides was taken for light, and the albedo got pale patches.

Prior: b ~ N(0, std^2). A face is nearly mirror-symmetric, so that light from the side can't be mistaken for its
colours: the terms odd in x have ODD_STD. The others, from above or from the front, also fit the skin's own pattern:
their standard deviation is small where the lobe determined the light (light_estimate.py).

Differs: not in the paper, whose losses draw the light to white and the albedo to evenness.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np
import numpy.typing as npt
import torch
from scipy.linalg import cholesky, solve_triangular
from scipy.optimize import nnls
from torch import Tensor

from pipeline.colour import LUMA
from pipeline.fields.appearance import SpatialField
from pipeline.fields.face import FaceModel
from pipeline.fields.light import ShLight
from pipeline.fields.shadowing import fibonacci
from pipeline.maths import sh
from pipeline.registration.head_regions import Near
from pipeline.skin_colour import ALIKE, against_face
from stages.inverse_rendering.albedo_level import lobe_std
from stages.inverse_rendering.observations import skin_inside, surface_hits, surface_points
from stages.inverse_rendering.ray_sampling import PhotoView, Rays, factor_for, image_rays
from stages.inverse_rendering.relight_model import change_light

F64 = npt.NDArray[np.float64]
Fact = dict[str, str | float | bool]

ORDER = 2  # of the correction: irradiance has hardly more bands
SIDE = 256  # pixels at which skin is looked up
POINTS, MIN_POINTS = 12_000, 500
PATCHES = 50.0  # independent places on a face
ODD_STD, EVEN_STD = 0.5, 0.3  # standard deviations of b; of the even terms, the largest
TRUSTED = (
    3.0  # the even terms' is TRUSTED lobe_std^2: .02 on a head whose lobe explains 45 %, .3 where it explains 25 %
)
LEVEL_STD = 10.0  # of kappa: free
ROUNDS = 15
HUBER, LEAST_NOISE = 1.5, 1e-3
DARKEST, DIRECTIONS = 0.1, 512  # of the mean irradiance; directions in which the corrected one is at least as bright
FEASIBLE = 1e-9  # least share of the distance that is left: below it no light meets the limits
SEED = 31_337


@dataclass(frozen=True, slots=True)
class SkinLight:
    """change: (9, 3) to be added to the light's first coefficients. explained: (3,) share of the variance of each
    colour's albedo over the face that it explains."""

    change: F64
    explained: F64


@dataclass(frozen=True, slots=True)
class Asked:
    """facts: for the report; changed: whether the light was corrected."""

    facts: Fact
    changed: bool


def skin_points(model: FaceModel, views: Sequence[PhotoView], device: str) -> tuple[Tensor, Tensor]:
    """x and unit n (N, 3) at about POINTS random pixels of skin in all photos; (0, 3) without labels."""
    generator = np.random.default_rng(SEED)
    each = max(POINTS // max(len(views), 1), 1)
    found = [(torch.zeros(0, 3, device=device), torch.zeros(0, 3, device=device))]
    for view in views:
        factor = factor_for(view.size, SIDE)
        inside = skin_inside(view, factor)
        if inside is None:
            continue
        pixels = np.flatnonzero(inside)
        chosen = torch.from_numpy(generator.permutation(pixels)[:each]).to(device)
        rays = image_rays(view, factor, device)
        x, n, _ = surface_hits(model.geometry, rays[chosen], chosen)
        found.append((x, n))
    return torch.cat([x for x, _ in found]), torch.cat([n for _, n in found])


def correction(albedo: F64, irradiance: F64, n: F64, even_std: float, around: F64) -> SkinLight | None:
    """The correction from albedo and irradiance (N, 3) at skin with unit normals n (N, 3), x to the person's left.

    around: (DIRECTIONS, 3) irradiance at directions(). None if the points are too few or not finite, or have no light.
    """
    if len(albedo) < MIN_POINTS or not all(np.isfinite(v).all() for v in (albedo, irradiance, around)):
        return None
    basis, mirrored, elsewhere = irradiance_basis(n), irradiance_basis(n * [-1, 1, 1]), irradiance_basis(directions())
    odd = np.abs(basis + mirrored).max(0) < np.abs(basis - mirrored).max(0)
    std = np.where(odd, ODD_STD, even_std)
    std[0] = LEVEL_STD
    change, explained = np.zeros((basis.shape[1], 3)), np.zeros(3)
    for c in range(3):
        level, mean = float(np.median(albedo[:, c])), float(irradiance[:, c].mean())
        if level <= 0 or (irradiance[:, c] <= 0).any():
            return None
        rows = basis * (mean / irradiance[:, c, None])
        rows[:, 0] = 1
        limits = mean * elsewhere
        limits[:, 0] = around[:, c] - least_irradiance(around[:, c])
        y = albedo[:, c] / level
        solved = _robust(rows, y, std, limits)
        residual, spread = y - rows @ solved, float(((y - y.mean()) ** 2).sum())
        explained[c] = 1 - float((residual**2).sum()) / max(spread, 1e-300)
        b = solved / max(solved[0], 1e-3)
        b[0] = 0
        change[:, c] = mean * b
    return SkinLight(change, explained)


def directions() -> F64:
    """(DIRECTIONS, 3) unit vectors all around, at which the irradiance is limited from below."""
    return np.asarray(fibonacci(DIRECTIONS).double().numpy(), np.float64)


def least_irradiance(irradiance: F64) -> F64:
    """(D,) what a correction must leave of an irradiance (D,): DARKEST of the mean, or what there was, if that is
    less."""
    return np.minimum(irradiance, DARKEST * float(irradiance.mean()))


def unevenness(albedo: F64) -> float:
    """Robust standard deviation of the logarithm of the luminance of an albedo (N, 3) above 0."""
    log = np.log(np.maximum(albedo @ LUMA, 1e-9))
    return 1.4826 * float(np.median(np.abs(log - np.median(log))))


def irradiance_basis(n: F64) -> F64:
    """A_l Y_lm (N, 9) at unit normals n (N, 3): E = irradiance_basis @ coefficients. [NeuFace eq. 14]"""
    d = torch.from_numpy(np.asarray(n, np.float64))
    return np.asarray((sh.sh_basis(d, ORDER) * sh.clamped_cosine(ORDER).to(d)).numpy(), np.float64)


def _robust(rows: F64, y: F64, std: F64, limits: F64) -> F64:
    """Maximum a posteriori of y = rows s + noise with Huber's weights, where limits @ s >= 0. Noise counts as that of
    PATCHES observations."""
    solved: F64 = np.zeros_like(std)
    residual = y - np.median(y)
    for _ in range(ROUNDS):
        noise = max(1.4826 * float(np.median(np.abs(residual))), LEAST_NOISE)
        weight = PATCHES / len(y) / noise**2 / np.maximum(np.abs(residual) / (HUBER * noise), 1)
        gram = (rows * weight[:, None]).T @ rows + np.diag(std**-2)
        solved = limited(gram, (rows * weight[:, None]).T @ y, limits)
        residual = y - rows @ solved
    return solved


def limited(gram: F64, g: F64, limits: F64) -> F64:
    """s (M,) with the least s' gram s / 2 - g's where limits (D, M) @ s >= 0; gram (M, M) is positive definite.

    With gram = R'R and z = R (s - s_0), s_0 the solution without limits: the least |z| where
    limits R^-1 z >= -limits s_0, from non-negative least squares [Lawson and Hanson 1974, ch. 23]. s = 0 meets all
    limits, so that there always is a solution.
    """
    root = cholesky(gram)
    free: F64 = solve_triangular(root, solve_triangular(root, g, trans="T"))
    short = -limits @ free
    if (short <= 0).all():
        return free
    scale = np.linalg.norm(limits, axis=1).clip(1e-300)
    sides = solve_triangular(root, limits.T / scale, trans="T")
    system = np.vstack([sides, short / scale])
    target = np.zeros(len(system))
    target[-1] = 1
    left = system @ nnls(system, target)[0] - target
    return free if abs(left[-1]) < FEASIBLE else free + solve_triangular(root, -left[:-1] / left[-1])


@dataclass(frozen=True, slots=True)
class Skin:
    """x and unit n (N, 3) on the skin; irradiance (N, 3) of the light there, albedo (N, 3)."""

    x: Tensor
    n: Tensor
    irradiance: Tensor
    albedo: Tensor

    @classmethod
    def of(cls, light: ShLight, spatial: SpatialField, x: Tensor, n: Tensor) -> Skin:
        """What the fit has at these points."""
        with torch.no_grad():
            return cls(x, n, light.irradiance(n), spatial(x)[0])

    def with_bare(self, other: Skin, near: Near | None) -> Skin:
        """Skin all over the head: of other points of the surface, those near the head that have this face's colour; the
        face alone if these are fewer."""
        if near is None or not len(self.x):
            return self
        alike = against_face(_array(self.albedo), _array(other.albedo))[1] < ALIKE
        own = torch.from_numpy(np.flatnonzero(alike & near(_array(other.x)))).to(other.x.device)
        if len(own) < MIN_POINTS:
            return self
        return Skin(other.x[own], other.n[own], other.irradiance[own], other.albedo[own])


def correct_light(
    model: FaceModel,
    views: Sequence[PhotoView],
    rays: Rays,
    explained: float | None,
    device: str,
    near: Near | None = None,
) -> Asked | None:
    """Correct the light of a model by the skin in its photos, and its reflectance so that the photos stay as they are,
    if that makes the skin and the face more even; None if there is nothing to correct or no skin.

    rays: towards the whole subject. explained: share of the view-dependent variance that the light's estimate explains,
    None without an estimate. near: the placed head; None without one, and then the labelled face is all skin.
    """
    light, spatial = model.light, model.spatial
    if not isinstance(light, ShLight) or not isinstance(spatial, SpatialField) or len(light.coefficients) < 9:
        return None
    face = Skin.of(light, spatial, *skin_points(model, views, device))
    if not len(face.x):
        return None
    x, facing = surface_points(model.geometry, rays)
    skin = face.with_bare(Skin.of(light, spatial, x, facing), near)
    with torch.no_grad():
        around = _array(light.irradiance(torch.from_numpy(directions()).to(light.coefficients)))
    a, e, normals = (_array(t) for t in (skin.albedo, skin.irradiance, skin.n))
    even = EVEN_STD if explained is None else min(TRUSTED * lobe_std(explained) ** 2, EVEN_STD)
    found = correction(a, e, normals, even, around)
    if found is None:
        return None
    now, then = _uneven(skin, found)
    on_face = (now, then) if skin is face else _uneven(face, found)
    facts: Fact = {"skin_uneven": round(now, 4), "skin_uneven_corrected": round(then, 4)}
    if skin is not face:
        facts |= {"face_uneven": round(on_face[0], 4), "face_uneven_corrected": round(on_face[1], 4)}
    if then >= now or on_face[1] >= on_face[0]:
        return Asked(facts, False)
    error = change_light(model, spatial, x, facing, lambda: _apply(light, found, face.n, face.irradiance))
    facts |= {"skin_explains": round(float(found.explained.mean()), 3), "relearned_within": round(error, 5)}
    return Asked(facts, True)


def _uneven(skin: Skin, found: SkinLight) -> tuple[float, float]:
    """Unevenness of the skin before and after a correction of the light."""
    albedo, e = _array(skin.albedo), _array(skin.irradiance)
    corrected = e + irradiance_basis(_array(skin.n)) @ found.change
    return unevenness(albedo), unevenness(albedo * e / np.maximum(corrected, 1e-9))


def _apply(light: ShLight, found: SkinLight, n: Tensor, irradiance: Tensor) -> None:
    """Add the correction to a light, with the irradiance (N, 3) of the face with normals n (N, 3) before."""
    with torch.no_grad():
        light.coefficients[: len(found.change)] += torch.from_numpy(found.change).to(light.coefficients)
        # the level of the face's albedo stays what other sources say (albedo_level.py)
        light.coefficients.mul_(float(irradiance.mean()) / float(light.irradiance(n).mean()))


def _array(t: Tensor) -> F64:
    return np.asarray(t.double().cpu().numpy(), np.float64)
