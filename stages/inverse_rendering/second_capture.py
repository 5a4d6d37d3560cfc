"""A second capture of the subject in the fit: its photos, and its light in closed form.

    c_pv = a_p / pi E'(n_p) s'_p + w(n . wo) sum_lm A_l L'_lm Y_lm(w_r)

Symbols as in light_estimate.py; a prime marks the second capture. The albedo a_p and the reflectance w are those that
the first capture tells, because the subject is the same; so each colour of L' is a linear least-squares problem. It is
solved when the first light was estimated. Then both lights are corrected until the two captures show one albedo
(two_lights.py), and again near the end of the fit, when the shadows are known.

Residuals have Huber's weights. The prior of L' is its value before, with a weight of RIDGE of the mean eigenvalue.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from typing import Protocol

import numpy as np
import numpy.typing as npt
import torch

from pipeline.fields.appearance import TYPICAL_INV_KAPPA, SpatialField
from pipeline.fields.face import FaceModel
from pipeline.fields.light import ShLight
from pipeline.maths import sh
from pipeline.maths.vmf import ATTENUATIONS
from stages.inverse_rendering.config import Config
from stages.inverse_rendering.initial_geometry import Start
from stages.inverse_rendering.light_estimate import DARKEST, MIN_VIEWS, RIDGE, reflectance
from stages.inverse_rendering.model_selection import MAX_ESTIMATE_ORDER, Fit, own_lights
from stages.inverse_rendering.observations import (
    Observations,
    lobe_basis,
    observe,
    pictures,
    point_means,
    surface_points,
)
from stages.inverse_rendering.ray_sampling import U8, PhotoView, PixelTable
from stages.inverse_rendering.relight_model import change_light
from stages.inverse_rendering.two_lights import Agreed, Shown, agree, irradiance_rows

F64 = npt.NDArray[np.float64]
Fact = dict[str, str | float | bool]
RAYS, SEED = 6000, 90_863
LEARNED = 40_000  # places at which the reflectance is learned anew
ROUNDS, HUBER, LEAST_NOISE = 8, 1.5, 1e-6
MIN_POINTS = 200


@dataclass(frozen=True, slots=True)
class Second:
    """views: fitted photos of the second capture, in the first one's asset coordinates, marked as `second`. labels:
    (H, W) codes of each, or None. calibrated: whether its photos have colour matrices."""

    views: list[PhotoView]
    labels: list[U8 | None]
    calibrated: bool


@dataclass(slots=True)
class FirstCapture:
    """The part of a fit with two captures that the model selection reads: the first capture alone."""

    views: list[PhotoView]
    settings: Config
    device: str
    model: FaceModel
    prior: Start | None
    level: int
    table: PixelTable | None
    validation: tuple[int, ...]
    light_given: str


def of_first(views: Sequence[PhotoView]) -> list[PhotoView]:
    """The views of the first capture, which come before those of the second."""
    return [v for v in views if not v.second]


def first_capture(fit: Fit) -> Fit:
    """A fit as if it had the first capture alone; the fit itself if it has no other."""
    if fit.model.second is None:
        return fit
    views = of_first(fit.views)
    table = None if fit.table is None else fit.table.only(tuple(range(len(views))))
    return FirstCapture(
        views, fit.settings, fit.device, fit.model, fit.prior, fit.level, table, fit.validation, fit.light_given
    )


class Running(Protocol):
    """The parts of a running fit that are read here."""

    views: list[PhotoView]
    settings: Config
    model: FaceModel
    light_given: str

    @property
    def pixels(self) -> PixelTable:
        """The photos' pixels."""
        ...


@dataclass(frozen=True, slots=True)
class Samples:
    """M colours of the second capture (M, 3), and what is known there: albedo (M, 3) with shadows, unit normals and
    mirror directions (M, 3), reflectance w (M,), A_l of the lobe (M, L + 1) or (1, L + 1)."""

    colour: F64
    albedo: F64
    normal: F64
    mirror: F64
    reflects: F64
    falls: F64


def solve_light(s: Samples, before: F64) -> tuple[F64, float]:
    """The coefficients ((L + 1)^2, 3), drawn to `before`, and the share of the colours' variance that is left."""
    order = s.falls.shape[1] - 1
    basis = sh.sh_basis(torch.from_numpy(s.normal), order).numpy()
    arriving = basis * sh.clamped_cosine(order).numpy()
    lobe = lobe_basis(s.mirror, s.falls) * s.reflects[:, None]
    out = np.array(before, np.float64)
    left, total = 0.0, 0.0
    for c in range(3):
        rows = s.albedo[:, c, None] / np.pi * arriving + lobe
        y = s.colour[:, c] - rows @ before[:, c]
        weight, change = np.ones(len(y)), np.zeros(rows.shape[1])
        for _ in range(ROUNDS):
            gram = (rows * weight[:, None]).T @ rows
            gram += RIDGE * max(float(np.trace(gram)) / len(gram), 1e-300) * np.eye(len(gram))
            change = np.linalg.solve(gram, (rows * weight[:, None]).T @ y)
            residual = np.abs(y - rows @ change)
            noise = max(1.4826 * float(np.median(residual)), LEAST_NOISE)
            weight = 1 / np.maximum(residual / (HUBER * noise), 1)
        out[:, c] += change
        left += float((weight * (y - rows @ change) ** 2).sum())
        total += float((weight * (s.colour[:, c] - s.colour[:, c].mean()) ** 2).sum())
    return out, left / max(total, 1e-300)


# ------------------------------------------------------------------ from the photos of both captures
@dataclass(frozen=True, slots=True)
class Pair:
    """Places that the photos of both captures show, with their colours without the photos' colour matrices (M, 3)."""

    first: Observations
    second: Observations
    colours: tuple[F64, F64]

    @property
    def normal(self) -> F64:
        """Unit normals of the places (P, 3)."""
        return np.asarray(self.first.n.detach().cpu().double().numpy(), np.float64)

    @property
    def seen(self) -> npt.NDArray[np.bool_]:
        """(P,) places with MIN_VIEWS photos of each capture."""
        counts = [np.bincount(s.point, minlength=len(s.x)) >= MIN_VIEWS for s in (self.first, self.second)]
        return np.asarray(counts[0] & counts[1], np.bool_)


def places(fit: Running) -> Pair:
    """Random places of the surface in the photos of both captures."""
    geometry = fit.model.geometry
    rays = fit.pixels.draw(RAYS, 0.0, SEED + fit.settings.seed).rays
    x, n = surface_points(geometry, rays)
    views = [[v for v in fit.views if v.second is flag] for flag in (False, True)]
    first, second = (observe(geometry, pictures(v), x, n) for v in views)
    matrices = np.asarray(fit.model.calibration().detach().cpu().double().numpy(), np.float64)
    split = len(views[0])
    return Pair(first, second, (_corrected(first, matrices[:split]), _corrected(second, matrices[split:])))


def _corrected(seen: Observations, matrices: F64) -> F64:
    """(M, 3) colours without their photos' colour matrices (V, 3, 3)."""
    return np.asarray(np.einsum("nij,nj->ni", np.linalg.inv(matrices)[seen.view], seen.colour), np.float64)


def light_from_first(fit: Running) -> Fact:
    """Set the light of the second capture from its photos, with the albedo that those of the first have under the
    first light and the usual lobe; then let the two lights agree. Returns the facts for the report; the light stays as
    it is if too few places are seen in both."""
    model, pair = fit.model, places(fit)
    usual = [_usual_lobe(model, s) for s in (pair.first, pair.second)]
    shown = _shown(model, pair, usual)
    albedo, good = _albedo(shown[0], pair)
    keep = good[pair.second.point]
    if good.sum() < MIN_POINTS or keep.sum() < MIN_POINTS:
        return {"light": "from the photos alone: too few places are seen in both captures"}
    order = min(model.spec.light_order, MAX_ESTIMATE_ORDER)
    s = pair.second
    found, left = solve_light(
        Samples(
            pair.colours[1][keep],
            albedo[s.point][keep],
            s.normal[keep],
            s.mirror[keep],
            reflectance(s.cosine[keep]) * float(model.spec.specular),
            _falls(model, order),
        ),
        np.zeros((sh.count(order), 3)),
    )
    _set(_own(model), found)
    facts: Fact = {
        "light": "from the albedo of both captures",
        "unexplained": round(left, 4),
        "places": int(good.sum()),
    }
    agreed = None if fit.light_given else agree(pair.normal, *_shown(model, pair, usual))
    if agreed is not None:
        set_lights(model, agreed)
        facts |= {"albedos_differ_at_first": round(agreed.before, 5), "and_then": round(agreed.after, 5)}
    return facts


def correct_lights(fit: Running, spatial: SpatialField) -> Fact:
    """Set the two lights under which the photos of both captures show one albedo, with the usual lobe and the shadows
    so far, and learn the reflectance anew; the facts for the report, empty if too few places tell it or the first light
    was given."""
    if fit.light_given:
        return {}
    model, pair = fit.model, places(fit)
    found = agree(pair.normal, *_shown(model, pair, [_usual_lobe(model, s) for s in (pair.first, pair.second)]))
    if found is None:
        return {}
    x, n = surface_points(model.geometry, fit.pixels.draw(LEARNED, 0.0, fit.settings.seed).rays)
    change_light(model, spatial, x, n, lambda: set_lights(model, found))
    return {"albedos_differ_before": round(found.before, 5), "albedos_differ": round(found.after, 5)}


def set_lights(model: FaceModel, found: Agreed) -> None:
    """Set both lights."""
    light, second = own_lights(model)
    _set(light, found.first)
    _set(second, found.second)


def _shown(model: FaceModel, pair: Pair, lobes: list[F64]) -> tuple[Shown, Shown]:
    """Both captures at the places; nothing (NaN) where one has too few photos. lobes: w A_l Y_lm(w_r) of each
    observation."""
    assert model.second is not None
    seen, out = pair.seen, []
    parts = ((pair.first, model.light, model.shadowing), (pair.second, model.second.light, model.second.shadowing))
    for (s, light, shadowing), colour, lobe in zip(parts, pair.colours, lobes, strict=True):
        counts = np.where(seen, np.bincount(s.point, minlength=len(s.x)), np.nan).astype(np.float64)
        with torch.no_grad():
            shadow = torch.ones_like(s.x) if shadowing is None else shadowing(s.x)
        out.append(
            Shown(
                point_means(s.point, colour, counts),
                point_means(s.point, lobe, counts),
                np.asarray(shadow.double().cpu().numpy(), np.float64),
                np.asarray(light().detach().cpu().double().numpy(), np.float64),
            )
        )
    return out[0], out[1]


def _falls(model: FaceModel, order: int) -> F64:
    """A_l (1, order + 1) of the usual lobe."""
    usual = torch.full((1,), TYPICAL_INV_KAPPA, dtype=torch.float64)
    return np.asarray(ATTENUATIONS[model.spec.attenuation](usual, order).numpy(), np.float64)


def _usual_lobe(model: FaceModel, s: Observations) -> F64:
    """w A_l Y_lm(w_r) (M, (L + 1)^2) of the usual skin."""
    lobe = lobe_basis(s.mirror, _falls(model, model.spec.light_order))
    return np.asarray(lobe * (reflectance(s.cosine) * float(model.spec.specular))[:, None], np.float64)


def _albedo(shown: Shown, pair: Pair) -> tuple[F64, npt.NDArray[np.bool_]]:
    """(P, 3) albedo of the places under the first light, and where it is known (P,)."""
    rows = irradiance_rows(pair.normal, sh.order_of(torch.from_numpy(shown.light)))
    arriving, diffuse = shown.arriving(rows), shown.diffuse()
    dark = DARKEST * np.pi * shown.light[0] / np.sqrt(4 * np.pi)
    good = (arriving > dark).all(1) & (diffuse > 0).all(1)  # NaN is neither
    return np.where(good[:, None], np.pi * diffuse / np.where(good[:, None], arriving, 1.0), 0.0), good


def _own(model: FaceModel) -> ShLight:
    assert model.second is not None and isinstance(model.second.light, ShLight)
    return model.second.light


def _set(light: ShLight, found: F64) -> None:
    with torch.no_grad():
        light.coefficients.zero_()
        light.coefficients[: len(found)] = torch.from_numpy(found).to(light.coefficients)
