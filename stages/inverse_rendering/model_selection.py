"""Model selection, once during the fit, by cross-validation. Settings that are not 'auto' are never changed.

The fit begins with the whole model. When `SELECTION_AT` of the steps are done, every part that does not reduce the
error on the validation views is removed for the rest of the fit: the specular lobe, bases beyond the rank, SH bands
beyond the order, colour matrices, and refined geometry. Until then the validation views are not fitted; afterwards they
are.
"""

from __future__ import annotations

from dataclasses import asdict, dataclass, replace
from typing import Any, Protocol

import numpy as np
import torch
from torch import Tensor, nn

from pipeline.fields.appearance import START_RHO, IntegratedBasis, SpatialField, restart_lobe
from pipeline.fields.face import FaceModel
from pipeline.fields.geometry import GridSdf
from pipeline.fields.light import ShLight
from pipeline.fields.parts import Geometry
from pipeline.maths import sh
from stages.inverse_rendering import cross_validation
from stages.inverse_rendering.config import AUTO, Config
from stages.inverse_rendering.cross_validation import NEGLIGIBLE, ValidationSamples, more
from stages.inverse_rendering.initial_geometry import Start
from stages.inverse_rendering.light_estimate import LightEstimate, light_from_lobe, light_from_mirror, reflectance
from stages.inverse_rendering.observations import observe, pictures, surface_points
from stages.inverse_rendering.ray_sampling import PhotoView, PixelTable, Rays, evenly_spaced

SELECTION_AT = 0.3  # share of the steps: the surface is accurate to a millimetre, and most steps are still to come
RAYS = 1500
MAX_ESTIMATE_ORDER = 6  # a lobe of skin's width passes no higher SH bands
SEED = 715_517
MIN_VIEWS = 8  # fewest views for validation views
VALIDATION_SHARE, MAX_VALIDATION = 0.12, 6
DIFFUSE_ORDER = 3  # SH order that diffuse skin determines [NeuFace eq. 15]
MIRROR_ORDER = 6  # that the mirror reflection of polarised pairs determines
MIN_DIFFERENCE = (
    0.02  # of the mean radiance: smaller differences of cameras can't be separated from the lobe's residual
)
MIN_SPECULAR = 0.3  # of the remaining error: smaller lobes are noise. Heads have 0.6 to 0.8, a matt stone one 0.2
MAX_REST = 0.75  # of the lobe's size: with a larger remaining error, the rank can't be determined (docs/model.md)
SILHOUETTE = 0.01  # share of the validation views' rays: allowed excess of the prior's silhouette error

CROSSED = "cross-polarised photos show no highlights"
SELECTED = "cross-validation"  # reason of a decision, in the report
GIVEN = "given"  # the light's: it was measured
TAKEN_BACK = "a trial took the selection back"
Facts = dict[str, dict[str, str | float | bool]]


class Fit(Protocol):
    """The parts of a running fit that the model selection reads. validation: positions of the validation views.
    light_given: source of a light that is known before the fit, else empty."""

    views: list[PhotoView]
    settings: Config
    device: str
    model: FaceModel
    prior: Start | None
    level: int
    table: PixelTable | None
    validation: tuple[int, ...]
    light_given: str


@dataclass(frozen=True, slots=True)
class Choices:
    """The selected model. columns: the bases that are kept. facts: the figures of each decision, for the report.
    light_known: the light is known from view-dependent residuals (light_estimate.py), or was given."""

    specular: bool
    light_order: int
    columns: tuple[int, ...]
    calibrated: bool
    refine_geometry: bool
    facts: Facts
    light_known: bool = False

    @property
    def rank(self) -> int:
        """k."""
        return len(self.columns)

    def plain(self) -> dict[str, Any]:
        """As a dictionary, for a checkpoint."""
        return asdict(self)


def restored(plain: dict[str, Any]) -> Choices:
    """Inverse of `plain`."""
    return Choices(**{**plain, "columns": tuple(plain["columns"])})


def validation_views(count: int, settings: Config) -> tuple[int, ...]:
    """Positions of the validation views among `count` views: about one in eight, evenly spaced."""
    if count < MIN_VIEWS or not settings.has_open_parts:
        return ()
    n = min(max(round(VALIDATION_SHARE * count), 2), MAX_VALIDATION)
    return evenly_spaced(count, n)


# ------------------------------------------------------------------ deciding
def given_model(s: Config, *, calibrated: bool) -> Choices:
    """The model of the settings, without selection. calibrated: whether it has colour matrices."""
    given = Choices(
        s.specular != "off",
        s.first_order,
        tuple(range(s.first_rank)),
        calibrated,
        s.refine_geometry != "off",
        {},
    )
    why = f"fewer than {MIN_VIEWS} views: no validation views" if s.has_open_parts else "setting"
    return replace(given, facts=facts_of(given, s, why))


def select_model(fit: Fit) -> tuple[Choices, LightEstimate | None]:
    """Select the model on the validation views, and estimate the light from view-dependent residuals, unless it is
    given."""
    s, model = fit.settings, fit.model
    out = given = given_model(s, calibrated=model.spec.calibrated)
    paired = polarised(fit.views)
    wanted = s.estimates_light and (s.specular != "off" or paired) and not fit.light_given
    if not fit.validation and not wanted:
        return (_with_given_light(out, fit.light_given) if fit.light_given else out), None
    shots = pictures(fit.views)
    rays = _exact_rays(fit, SEED + s.seed)
    seen = observe(model.geometry, shots, *surface_points(model.geometry, rays))
    found = cross_validation.validation_samples(seen, fit.validation, model) if fit.validation else None
    gain = np.ones((len(fit.views), 3))
    if found is not None:
        out = _judge_colours(given, s, found, model, MIRROR_ORDER if paired else DIFFUSE_ORDER)
        if out.calibrated:
            gain = cross_validation.solve_response(found, out.light_order, gain=True).gain
        if s.refine_geometry == AUTO and fit.prior is not None:
            out = _judge_refinement(out, fit, found, shots, rays)
    elif fit.validation:
        out = replace(given, facts=facts_of(given, s, "too few points are visible in enough views"))
    estimate = None
    if wanted and paired:
        mirrors = [replace(v, rgb=v.mirror) for v in fit.views if v.mirror is not None]
        kept = np.array([v.mirror is not None for v in fit.views])
        shiny = observe(model.geometry, pictures(mirrors), seen.x, seen.n)
        estimate = light_from_mirror(
            shiny, min(out.light_order, MAX_ESTIMATE_ORDER), gain[kept], model.spec.attenuation
        )
        out = replace(out, facts={**out.facts, "specular": {**out.facts["specular"], "why": CROSSED}})
    elif wanted and out.specular:
        estimate = light_from_lobe(seen, min(out.light_order, MAX_ESTIMATE_ORDER), gain, model.spec.attenuation)
    if fit.light_given:
        return _with_given_light(out, fit.light_given), None
    return _with_light_source(out, estimate, paired), estimate


def _with_given_light(c: Choices, source: str) -> Choices:
    """The choices with the light that was given."""
    light: dict[str, str | float | bool] = {**c.facts["light"], "from": source, "why": GIVEN}
    return replace(c, light_known=True, facts={**c.facts, "light": light})


def unselected(fit: Fit) -> Choices:
    """The whole model, after a trial took its selection back (trials.py)."""
    given = given_model(fit.settings, calibrated=fit.model.spec.calibrated)
    out = replace(given, facts=facts_of(given, fit.settings, TAKEN_BACK))
    return _with_given_light(out, fit.light_given) if fit.light_given else _with_light_source(out, None)


def polarised(views: list[PhotoView]) -> bool:
    """Whether the photos are cross-polarised: their pairs show the mirror reflection, they do not."""
    return any(v.mirror is not None for v in views)


def _with_light_source(c: Choices, estimate: LightEstimate | None, paired: bool = False) -> Choices:
    """The choices with the source of the light."""
    light: dict[str, str | float | bool] = {"from": "uniform albedo"}
    if estimate is not None:
        told = {"explained": estimate.explained, "explained_on_skin": estimate.explained_on_skin}
        figures = {k: round(v, 4) for k, v in (told | {"level_by_skin": estimate.level}).items()}
        figures["bands_scaled_by"] = round(estimate.scale, 3)
        light = {"from": "polarised pairs" if paired else "view-dependent residuals", **figures}
    return replace(c, light_known=estimate is not None, facts={**c.facts, "light": {**c.facts["light"], **light}})


def apply_light(model: FaceModel, estimate: LightEstimate) -> list[nn.Parameter]:
    """Set the model's light, and skin's typical lobe everywhere. Returns the overwritten parameters."""
    spatial, basis, light = own_parts(model)
    last = spatial.net[-1]
    assert isinstance(last, nn.Linear)
    with torch.no_grad():
        light.coefficients.zero_()
        light.coefficients[: len(estimate.coefficients)] = torch.from_numpy(estimate.coefficients).to(last.weight)[
            :, None
        ]
    restart_lobe(last, START_RHO)
    pretrain_basis(basis)
    return [*last.parameters(), *basis.parameters(), light.coefficients]


def own_parts(model: FaceModel) -> tuple[SpatialField, IntegratedBasis, ShLight]:
    """The parts of a model that the model selection supports: hash encoding, integrated bases, SH light."""
    spatial, basis, light = model.spatial, model.basis, model.light
    assert isinstance(spatial, SpatialField) and isinstance(basis, IntegratedBasis) and isinstance(light, ShLight)
    return spatial, basis, light


def own_lights(model: FaceModel) -> list[ShLight]:
    """The light of every capture of the model, the first one's first; all are SH."""
    lights = [model.light] if model.second is None else [model.light, model.second.light]
    return [light for light in lights if isinstance(light, ShLight)]


def pretrain_basis(basis: IntegratedBasis) -> None:
    """Pre-train the bases so that their sum is the reflectance of rough skin, for strength START_RHO and all c = 1."""
    basis.learn(lambda cosine: torch.from_numpy(reflectance(cosine.cpu().numpy())).to(cosine) / START_RHO)


def _table(fit: Fit) -> PixelTable:
    assert fit.table is not None
    return fit.table


def _exact_rays(fit: Fit, seed: int) -> Rays:
    """Rays of random subject pixels that are not clipped: points in highlights would be over-represented."""
    batch = _table(fit).draw(RAYS, 0.0, seed)
    exact = ~(batch.bound > 0).any(-1)
    return batch.rays[exact]


def _judge_colours(
    given: Choices, s: Config, t: ValidationSamples, model: FaceModel, least: int = DIFFUSE_ORDER
) -> Choices:
    """Select lobe, calibration, order and rank, in an order in which each uses the previous results. least: SH order
    that the light has at least."""
    full, facts = model.spec.light_order, facts_of(given, s, "not tested")
    most = _best_order(t, full) if given.specular else None
    one, gains = cross_validation.alike(t), cross_validation.solve_response(t, most, gain=True)
    offsets = cross_validation.solve_response(t, most, gain=False)
    gains_alone = cross_validation.solve_response(t, None, gain=True)
    without, with_gains, control = (cross_validation.validation_error(t, most, r) for r in (one, gains, offsets))
    alone = cross_validation.validation_error(t, None, gains_alone)
    differ = more(without, with_gains) > MIN_DIFFERENCE and (with_gains < control or alone < without)
    calibrated = differ if s.calibration == AUTO else given.calibrated
    facts["calibration"] = _fact(calibrated, s.calibration, without, with_gains) | {
        "error_with_offsets": round(control, 5),
        "error_with_gains_alone": round(alone, 5),
    }
    used = gains if calibrated else one
    orders = [cross_validation.validation_error(t, order, used) for order in range(full + 1)]
    without_lobe = alone if calibrated else cross_validation.validation_error(t, None, one)
    best = min(orders)
    clearly = more(without_lobe, best) > max(NEGLIGIBLE, MIN_SPECULAR * best)
    specular = clearly if s.specular == AUTO else given.specular
    facts["specular"] = _fact(specular, s.specular, without_lobe, best)
    order = given.light_order
    if s.light_order == AUTO:
        order = next(o for o in range(full + 1) if more(orders[o], best) < NEGLIGIBLE) if specular else 0
        order = min(max(order, least), full)
        why = SELECTED if least == DIFFUSE_ORDER else "the mirror reflection of polarised pairs"
        facts["light"] = {"order": order, "why": why, "error_of_order": _listed(orders)}
    columns = given.columns
    if s.rank == AUTO and not specular:
        facts["rank"]["why"] = "no specular lobe, so its bases are not used"
    if s.rank == AUTO and specular:
        ranks = cross_validation.by_rank(t, order, used, given.rank)
        clear = min(ranks) < MAX_REST * more(without_lobe, best)
        k = cross_validation.least_rank(ranks) if clear else given.rank
        columns = strongest(model, t, k)
        why = SELECTED if clear else "the remaining error is too large; fewer bases would save no time"
        facts["rank"] = {"k": k, "why": why, "error_of_rank": _listed(ranks)}
    return Choices(specular, order, columns, calibrated, given.refine_geometry, facts)


def _best_order(t: ValidationSamples, full: int) -> int:
    """The SH order with the least validation error if all cameras respond equally: a higher one would fit noise."""
    errors = [cross_validation.validation_error(t, order, cross_validation.alike(t)) for order in range(full + 1)]
    return int(np.argmin(errors))


def _judge_refinement(out: Choices, fit: Fit, t: ValidationSamples, shots: list[Any], rays: Rays) -> Choices:
    """Whether the fitted surface explains the validation views better than the prior. rays: those of t: the
    same places are compared, so that surfaces that are the same have the same error."""
    prior = prior_surface(fit)
    seen = observe(prior, shots, *surface_points(prior, rays))
    before = cross_validation.validation_samples(seen, fit.validation, fit.model)
    own, theirs = (silhouette_error(fit, g) for g in (fit.model.geometry, prior))
    moved = theirs > own + SILHOUETTE
    fact: dict[str, str | float | bool] = {
        "modelled": moved,
        "why": SELECTED,
        "silhouette_error_of_prior": round(theirs, 5),
        "silhouette_error": round(own, 5),
    }
    if before is not None:  # else the prior is so wrong that hardly any of its points is on the subject
        was, now = (_consistency(x, out.calibrated) for x in (before, t))
        moved = moved or more(was, now) > NEGLIGIBLE
        fact |= _fact(moved, AUTO, was, now)
    return replace(out, refine_geometry=moved, facts=out.facts | {"relief": fact})


def _consistency(t: ValidationSamples, calibrated: bool) -> float:
    """Validation error of a surface without a lobe: each point is predicted by its mean over the fitted views."""
    response = cross_validation.solve_response(t, None, gain=True) if calibrated else cross_validation.alike(t)
    return cross_validation.validation_error(t, None, response)


def silhouette_error(fit: Fit, geometry: Geometry) -> float:
    """Share of the validation views' rays that hit the surface outside of the mask, or miss it inside."""
    batch = _table(fit).only(fit.validation).draw(RAYS, 0.5, SEED + 2)
    hit = _hits(geometry, batch.rays.o, batch.rays.d)
    return float((hit != (batch.alpha > 0.5)).double().mean())


def _hits(geometry: Geometry, o: Tensor, d: Tensor) -> Tensor:
    from pipeline.maths.tracing import box_interval

    near, far = box_interval(o, d, *geometry.box())
    _, hit, _ = geometry.trace(o, d, near, far)
    return hit & (far > near)


def prior_surface(fit: Fit) -> GridSdf:
    """The prior's surface at the current grid resolution."""
    assert fit.prior is not None
    prior = fit.prior.surface("cpu")
    for _ in range(fit.level):
        prior.refine()
    prior.to(fit.device)
    prior.to_device(fit.device)
    return prior


def strongest(model: FaceModel, t: ValidationSamples, k: int) -> tuple[int, ...]:
    """Indices of the k bases with the largest mean share of c . B, ascending."""
    with torch.no_grad():
        x = torch.from_numpy(t.x[:: max(len(t.x) // 4096, 1)]).float().to(model.beta.device)
        c = model.spatial(x)[2]
        up = torch.tensor([[0.0, 0.0, 1.0]], device=x.device)
        share = (c.mean(0) * model.shading.bases(up, up)[0]).cpu().numpy()
    return tuple(sorted(int(j) for j in np.argsort(-share, kind="stable")[:k]))


def facts_of(c: Choices, s: Config, why: str) -> Facts:
    """The facts if nothing was tested."""
    return {
        "specular": {"modelled": c.specular, "why": "setting" if s.specular != AUTO else why},
        "light": {"order": c.light_order, "why": "setting" if s.light_order != AUTO else why},
        "rank": {"k": c.rank, "why": "setting" if s.rank != AUTO else why},
        "calibration": {"modelled": c.calibrated, "why": "setting" if s.calibration != AUTO else why},
        "relief": {"modelled": c.refine_geometry, "why": "setting" if s.refine_geometry != AUTO else why},
    }


def _fact(modelled: bool, setting: str, without: float, with_it: float) -> dict[str, str | float | bool]:
    return {
        "modelled": modelled,
        "why": SELECTED if setting == AUTO else "setting",
        "error_without": round(without, 5),
        "error_with": round(with_it, 5),
    }


def _listed(errors: list[float]) -> str:
    return ", ".join(f"{e:.5f}" for e in errors)


# ------------------------------------------------------------------ taking over
def take_over(model: FaceModel, c: Choices) -> dict[nn.Parameter, tuple[nn.Parameter, slice | list[int]]]:
    """Remove the parts that were not selected from the model. Returns, for every parameter that became smaller, the old
    parameter and the rows that are kept."""
    swaps: dict[nn.Parameter, tuple[nn.Parameter, slice | list[int]]] = {}
    spec = model.spec
    if c.rank < spec.rank:
        heads = [*range(5), *(5 + j for j in c.columns)]
        spatial, basis, _ = own_parts(model)
        for net, rows in ((spatial.net, heads), (basis.net, list(c.columns))):
            last = net[-1]
            assert isinstance(last, nn.Linear)
            for name in ("weight", "bias"):
                old = getattr(last, name)
                new = nn.Parameter(old.detach()[rows].clone())
                setattr(last, name, new)
                swaps[new] = (old, rows)
            last.out_features = len(rows)
        spatial.rank = c.rank
    if c.light_order < spec.light_order:
        kept = slice(0, sh.count(c.light_order))
        for light in own_lights(model):
            old = light.coefficients
            light.coefficients = nn.Parameter(old.detach()[kept].clone())
            swaps[light.coefficients] = (old, kept)
    if model.second is not None:
        model.calibration.own = (c.calibrated, spec.second_calibrated)
    elif not c.calibrated:
        model.calibration.reset()
    model.spec = replace(spec, rank=c.rank, light_order=c.light_order, specular=c.specular, calibrated=c.calibrated)
    return swaps
