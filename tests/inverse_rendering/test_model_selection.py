"""The rules of the model selection by themselves: errors are made up, so that each rule is asked on both sides of its
limit. test_cross_validation.py has them on photos."""

from __future__ import annotations

import math
from dataclasses import replace
from types import SimpleNamespace
from typing import Any

import numpy as np
import pytest
import torch

from stages.inverse_rendering import cross_validation, model_selection
from stages.inverse_rendering.config import Config
from stages.inverse_rendering.light_estimate import LightEstimate
from stages.inverse_rendering.model_selection import apply_light, given_model, select_model, strongest
from tests.inverse_rendering.test_cross_validation import trainer
from tests.support.balls import Ball, gloss

FULL = 4


def worse(error: float, by: float) -> float:
    """The error that is larger than another by a part of this size, in quadrature."""
    return math.hypot(error, by)


def judged(monkeypatch: pytest.MonkeyPatch, errors: dict[tuple[str, str], float]) -> model_selection.Choices:
    """The choices for made-up validation errors, by lobe or none, and by the cameras' response."""

    def response(t: object, order: int | None, *, gain: bool) -> str:
        return ("gains" if order is not None else "gains alone") if gain else "offsets"

    def error(t: object, order: int | None, r: str) -> float:
        return errors["none" if order is None else "lobe", r]

    monkeypatch.setattr(cross_validation, "alike", lambda t: "one")
    monkeypatch.setattr(cross_validation, "solve_response", response)
    monkeypatch.setattr(cross_validation, "validation_error", error)
    settings = Config(rank=2, refine_geometry="off", light_order=3)
    model: Any = SimpleNamespace(spec=SimpleNamespace(light_order=FULL))
    return model_selection._judge_colours(given_model(settings, calibrated=True), settings, None, model)  # type: ignore[arg-type]


ALL = {(a, b): 1.0 for a in ("lobe", "none") for b in ("one", "gains", "offsets", "gains alone")}


@pytest.mark.parametrize(("size", "kept"), [(0.2, False), (0.4, True), (0.55, True)])
def test_a_lobe_is_kept_if_it_is_a_third_of_what_remains(
    monkeypatch: pytest.MonkeyPatch, size: float, kept: bool
) -> None:
    assert judged(monkeypatch, ALL | {("none", "one"): worse(1.0, size)}).specular is kept


@pytest.mark.parametrize(
    ("offsets", "alone", "calibrated"),
    [(1.2, 0.5, True), (0.5, 0.5, True), (1.2, 2.0, True), (0.5, 2.0, False)],
    ids=["better than offsets, and alone", "alone", "better than offsets", "neither"],
)
def test_gains_must_beat_offsets_or_a_model_without_a_lobe(
    monkeypatch: pytest.MonkeyPatch, offsets: float, alone: float, calibrated: bool
) -> None:
    """Offsets, which no camera has, do as well where the gains only take up what the lobe leaves."""
    errors = ALL | {("lobe", "one"): worse(1.0, 0.1), ("lobe", "offsets"): offsets, ("none", "gains alone"): alone}
    assert judged(monkeypatch, errors).calibrated is calibrated
    same = errors | {("lobe", "one"): worse(1.0, 0.01)}
    assert not judged(monkeypatch, same).calibrated, "a difference below MIN_DIFFERENCE"


@pytest.mark.parametrize(("prior", "own", "moved"), [(0.05, 0.01, True), (0.015, 0.01, False), (0.01, 0.05, False)])
def test_a_silhouette_that_the_prior_misses_asks_for_relief(
    monkeypatch: pytest.MonkeyPatch, prior: float, own: float, moved: bool
) -> None:
    theirs, ours = object(), object()
    monkeypatch.setattr(model_selection, "prior_surface", lambda fit: theirs)
    monkeypatch.setattr(model_selection, "surface_points", lambda *a: (None, None))
    monkeypatch.setattr(model_selection, "observe", lambda *a: None)
    monkeypatch.setattr(cross_validation, "validation_samples", lambda *a: None)
    monkeypatch.setattr(model_selection, "silhouette_error", lambda fit, g: prior if g is theirs else own)
    fit: Any = SimpleNamespace(validation=(1,), model=SimpleNamespace(geometry=ours))
    given = given_model(Config(), calibrated=False)
    found = model_selection._judge_refinement(given, fit, None, [], None)  # type: ignore[arg-type]
    assert found.refine_geometry is moved and found.facts["relief"]["silhouette_error"] == own


def test_the_strongest_bases_are_those_of_the_largest_share() -> None:
    """Mean coefficients times the bases' values at normal incidence."""
    share = torch.tensor([[0.1, 0.9, 0.5, 0.2], [0.3, 0.7, 0.5, 0.2]])
    model: Any = SimpleNamespace(
        beta=torch.zeros(1),
        spatial=lambda x: (None, None, share),
        shading=SimpleNamespace(bases=lambda n, wo: torch.tensor([[9.0, 1.0, 0.1, 2.0]])),
    )
    samples: Any = SimpleNamespace(x=np.zeros((2, 3)))
    products = share.numpy().mean(0) * [9.0, 1.0, 0.1, 2.0]  # 1.8, 0.8, 0.05, 0.4
    for k in range(1, 5):
        assert strongest(model, samples, k) == tuple(sorted(np.argsort(products)[::-1][:k].tolist()))


def test_an_estimated_light_replaces_all_of_the_old_one() -> None:
    model = trainer(Ball()).model
    with torch.no_grad():
        model.light.coefficients.fill_(7.0)
    estimate = LightEstimate(np.arange(1.0, 17.0), 0.5, 1.0)
    changed = apply_light(model, estimate)
    light = model.light().detach()
    assert torch.equal(light[:16], torch.arange(1.0, 17.0)[:, None].expand(16, 3)) and not light[16:].any()
    assert any(p is model.light.coefficients for p in changed)


def paired() -> Any:
    """A fit of a ball's cross-polarised photos, with the mirror reflection of each view beside them."""
    fit = trainer(Ball(), specular="off", light_order="auto")
    shiny = Ball(gloss(5)).photos()
    fit.views = [replace(v, mirror=s.rgb - v.rgb) for v, s in zip(fit.views, shiny, strict=True)]
    return fit


def test_polarised_pairs_tell_the_light_of_a_model_without_a_lobe() -> None:
    """The dull ball's photos alone tell no light beyond order 3; the lobe is of band 5."""
    choices, estimate = select_model(paired())
    assert not choices.specular and choices.light_known and choices.light_order >= 5
    assert choices.facts["light"]["from"] == "polarised pairs"
    assert choices.facts["specular"]["why"] == model_selection.CROSSED
    assert estimate is not None and estimate.explained > 0.9
    bands = [float(np.abs(estimate.coefficients[b * b : (b + 1) ** 2]).max()) for b in range(1, 7)]
    assert int(np.argmax(bands)) + 1 == 5
    alone, none = select_model(trainer(Ball(), specular="off", light_order="auto"))
    assert none is None and not alone.light_known and alone.light_order == 3
