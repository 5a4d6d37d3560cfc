"""A fit to two captures of one ball under two lights: its lights, its albedo, and that it goes on from any step."""

from __future__ import annotations

from pathlib import Path

import numpy as np
import pytest
import torch

from pipeline.fields.face import FaceModel
from pipeline.maths import sh
from pipeline.transforms import F64
from stages.inverse_rendering.albedo_level import set_level
from stages.inverse_rendering.config import Config
from stages.inverse_rendering.fit import Trainer
from stages.inverse_rendering.initialise import new_trainer
from stages.inverse_rendering.model_selection import own_lights
from stages.inverse_rendering.observations import surface_hits
from stages.inverse_rendering.second_capture import Samples, Second, first_capture, of_first, solve_light
from stages.inverse_rendering.training_loop import Hooks, run_fit
from tests.support.balls import RADIUS, start, texture
from tests.support.lit_balls import FIRST, SECOND, photos

VIEWS = 16
SETTINGS = Config(
    image_side=96,
    steps=150,
    batch=512,
    samples=6,
    grid_cells=48,
    hash_log2_size=12,
    hash_levels=6,
    hash_fine=0.004,
    width=32,
    refine_geometry="off",
    shadows=False,
)


def trainer(settings: Config = SETTINGS, *, two: bool = True, calibrated: bool = False) -> Trainer:
    second = Second(photos(SECOND, VIEWS, second=True, turn=0.1), [None] * VIEWS, calibrated)
    views = photos(FIRST, VIEWS)
    return new_trainer(views, start(), settings, False, "cpu", start(), second=second if two else None)


def hooks(path: Path | None = None) -> Hooks:
    return Hooks(lambda *a, **k: None, lambda: False, path)


def wrong_by(coefficients: torch.Tensor, true: F64) -> float:
    """Error of the bands 1 and 2 over band 0, without the level."""
    c = coefficients.detach().double().numpy()
    return float(np.abs(c[1:9] / c[0] - true[1:9] / true[0]).max())


def albedo_error(model: FaceModel) -> float:
    """Root mean square, after one gain."""
    n = sh.spiral(1500)
    with torch.no_grad():
        a = model.spatial(torch.from_numpy((RADIUS * n).astype(np.float32)))[0].double().numpy()
    t = texture(n)
    return float(np.sqrt(((a * (a * t).sum() / (a * a).sum() - t) ** 2).mean()))


@pytest.mark.slow
def test_two_lights_tell_both_lights_and_a_better_albedo() -> None:
    found = {}
    for two in (False, True):
        t = trainer(two=two)
        while t.choices is None:
            t.advance()
        lights = own_lights(t.model)
        found[two] = [wrong_by(c(), true) for c, true in zip(lights, (FIRST, SECOND), strict=False)]
        found[two].append(albedo_error(run_fit(t, hooks())))
        if two:
            assert t.second_facts()["and_then"] < t.second_facts()["albedos_differ_at_first"]  # type: ignore[operator]
    (alone, albedo), (first, second, joint) = found[False], found[True]
    assert first < 0.8 * alone and second < alone
    assert joint < 0.9 * albedo


@pytest.mark.slow
def test_it_goes_on_from_any_step(tmp_path: Path) -> None:
    few = SETTINGS.changed(steps=24, batch=128)
    whole = run_fit(trainer(few, calibrated=True), hooks())
    for stop in (8, 21):
        begun = trainer(few, calibrated=True)
        for _ in range(stop):
            begun.advance()
        begun.save(tmp_path / "c.pt")
        again = trainer(few, calibrated=True)
        model = run_fit(again, hooks(tmp_path / "c.pt"))
        assert again.second_facts()
        for (name, a), b in zip(whole.state_dict().items(), model.state_dict().values(), strict=True):
            assert torch.equal(a, b), (stop, name)


def test_the_selection_sees_the_first_capture_alone() -> None:
    t = trainer()
    assert len(t.pixels.view.unique()) == 2 * VIEWS
    first = first_capture(t)
    assert len(first.views) == VIEWS == len(of_first(t.views)) and first.table is not None
    drawn = first.table.draw(500, 0.2, 0)
    assert int(drawn.view.max()) < VIEWS and drawn.rays.second is not None and not bool(drawn.rays.second.any())
    alone = trainer(two=False)
    assert first_capture(alone) is alone and alone.pixels.draw(10, 0.2, 0).rays.second is None


def test_a_decision_that_is_taken_back_leaves_both_lights_as_they_were() -> None:
    t = trainer(SETTINGS.changed(steps=20, batch=128), calibrated=True)
    for _ in range(3):
        t.advance()
    state, before = t.kept(), {k: v.clone() for k, v in t.model.state_dict().items()}
    while t.choices is None:
        t.advance()
    assert t.model.second is not None and t.model.second.light().shape != before["second.light.coefficients"].shape
    t.recall(state)
    for name, value in t.model.state_dict().items():
        assert torch.equal(value, before[name]), name
    t.advance()
    assert t.model.calibration.own == (False, True)


def test_a_level_that_is_set_changes_no_photo_of_either_capture() -> None:
    t = trainer()
    rays = t.pixels.draw(800, 0.0, 1).rays
    x, n, hit = surface_hits(t.model.geometry, rays, torch.arange(len(rays.d)))
    rays = rays[hit]
    assert rays.second is not None and 0 < int(rays.second.sum()) < len(x)

    def colours() -> tuple[torch.Tensor, torch.Tensor]:
        with torch.no_grad():
            shaded = t.model.shade(x, n, -rays.d, rays.stations)
        return shaded.total, shaded.albedo

    total, albedo = colours()
    labels = [np.ones(v.alpha.shape, np.uint8) for v in t.views]
    gain = float(set_level(t.model, t.pixels, t.views, labels, ("", "face"), 0.2, {})["gain"])
    after, darker = colours()
    assert not 0.9 < gain < 1.1 and torch.allclose(darker, gain * albedo, rtol=1e-3)
    assert torch.allclose(after, total, rtol=1e-4)


def test_only_the_second_capture_has_colour_matrices_where_only_it_needs_them() -> None:
    t = trainer(calibrated=True)
    with torch.no_grad():
        t.model.calibration.net[-1].weight.normal_(std=0.3)  # type: ignore[operator, union-attr]
    matrices = t.model.calibration()
    eye = torch.eye(3).expand(VIEWS, 3, 3)
    assert torch.equal(matrices[:VIEWS], eye) and not torch.allclose(matrices[VIEWS:], eye, atol=1e-2)
    assert t.model.spec.colour_matrices and not t.model.of_light(second=False).spec.calibrated


def test_a_light_from_known_albedo_is_found_exactly_and_despite_outliers() -> None:
    rng = np.random.default_rng(0)
    n = rng.normal(size=(3000, 3))
    n /= np.linalg.norm(n, axis=1, keepdims=True)
    wo = n + 0.6 * rng.normal(size=n.shape)
    wo /= np.linalg.norm(wo, axis=1, keepdims=True)
    mirror = 2 * (n * wo).sum(1, keepdims=True) * n - wo
    albedo, reflects = rng.uniform(0.2, 0.8, n.shape), rng.uniform(0.02, 0.1, len(n))
    falls = np.exp(-0.2 * np.arange(4))[None]
    true = rng.normal(0, 0.3, (16, 3)) + 3 * np.eye(16)[:, :1]
    knots = sh.spiral(20_000)  # an oracle of its own: quadrature of the light over the hemisphere
    radiance = sh.sh_basis(torch.from_numpy(knots), 3).numpy() @ true
    arrives = np.maximum(n @ knots.T, 0) @ radiance * (4 * np.pi / len(knots))
    spread = np.repeat(falls[0], [1, 3, 5, 7])
    colour = albedo / np.pi * arrives
    colour += reflects[:, None] * (sh.sh_basis(torch.from_numpy(mirror), 3).numpy() * spread @ true)
    samples = Samples(colour, albedo, n, mirror, reflects, falls)
    found, left = solve_light(samples, true + 0.001)
    assert np.allclose(found[:9], true[:9], atol=0.03) and left < 1e-3
    spoilt = colour.copy()
    spoilt[::20] += 2.0
    robust, _ = solve_light(Samples(spoilt, albedo, n, mirror, reflects, falls), true + 0.001)
    assert np.allclose(robust[:9], true[:9], atol=0.05)
