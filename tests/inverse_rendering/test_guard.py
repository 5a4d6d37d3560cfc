"""A fit through what should never happen: steps that are not finite, and photos and scenes at the extremes."""

from __future__ import annotations

from dataclasses import replace
from functools import cache
from pathlib import Path

import numpy as np
import pytest
import torch

from pipeline.errors import StageError
from stages.inverse_rendering import objective
from stages.inverse_rendering.config import Config
from stages.inverse_rendering.fit import Trainer
from stages.inverse_rendering.guard import Guard
from stages.inverse_rendering.initial_geometry import Start
from stages.inverse_rendering.initialise import new_trainer
from stages.inverse_rendering.ray_sampling import PhotoView
from stages.inverse_rendering.training_loop import Hooks, run_fit
from tests.support.small_ball import SMALL, ball_start, ball_view, hooks

SHORT = SMALL.changed(steps=8, batch=256, levels=1, shadows=False, max_dropped=3)


def trainer(settings: Config = SHORT, views: list[PhotoView] | None = None, start: Start | None = None) -> Trainer:
    photos = [ball_view(i) for i in range(0, 12, 3)] if views is None else views
    return new_trainer(photos, ball_start() if start is None else start, settings, True, "cpu")


def finite(t: Trainer) -> None:
    for name, value in t.model.state_dict().items():
        assert bool(torch.isfinite(value.float()).all()), name


class Poisoned(Trainer):
    """A trainer whose photo 2 holds NaN at step 3."""

    def advance(self) -> None:
        self.enter_level()
        assert self.table is not None
        if self.step == 3:
            self.table.target[self.table.view == 2] = float("nan")
        super().advance()
        if self.step == 4:
            self.table = None


def test_one_bad_step_is_dropped_and_told() -> None:
    plain = trainer()
    t = Poisoned(plain.views, plain.settings, "cpu", plain.model)
    seen: list[dict[str, torch.Tensor]] = []
    while t.step < t.settings.steps:
        t.advance()
        seen.append({k: v.clone() for k, v in t.model.state_dict().items() if k != "beta" and "window" not in k})
    assert t.guard.dropped == 1 and t.step == 8
    assert "step 4: term rgb is nan" in t.guard.causes[0] and "views 6;" in t.guard.causes[0]
    assert all(torch.equal(seen[3][k], seen[2][k]) for k in seen[2]), "a dropped step moved something"
    assert any(not torch.equal(seen[4][k], seen[3][k]) for k in seen[3]), "the fit did not go on"
    finite(t)


def test_a_bad_gradient_of_the_geometry_is_dropped() -> None:
    """A finite loss whose gradient is not: the compiled kernel never sees it, and the next step is clean."""
    t = trainer()
    t.advance()
    before = t.model.geometry.values.detach().clone()
    x = torch.zeros(4, 3, requires_grad=True)
    s, _ = t.model.geometry(x)
    (s * float("nan")).sum().backward()
    assert not t.model.geometry.gradient_is_finite()
    t.model.geometry.drop_gradient()
    t.advance()
    assert t.guard.dropped == 0 and bool(torch.isfinite(t.model.geometry.values).all())
    assert not torch.equal(before, t.model.geometry.values.detach())


def test_without_the_guard_the_run_would_be_lost(monkeypatch: pytest.MonkeyPatch) -> None:
    """The derivative of the colour loss at NaN is NaN, and reaches every parameter."""
    monkeypatch.setattr(Trainer, "_is_finite", lambda self, loss: True)
    plain = trainer()
    t = Poisoned(plain.views, plain.settings, "cpu", plain.model)
    while t.step < t.settings.steps:
        t.advance()
    with pytest.raises(AssertionError):
        finite(t)


def test_a_bad_gradient_names_its_term() -> None:
    """sqrt at 0: the value is finite, the derivative is not."""
    from stages.inverse_rendering.guard import cause_of
    from stages.inverse_rendering.objective import Terms

    t = trainer()
    t.enter_level()
    assert t.table is not None
    batch = t.table.draw(16, 0.25, 0)
    found = Terms()
    found.add("fine", t.model.light.coefficients.sum())
    found.add("steep", torch.sqrt((t.model.light.coefficients[5:] ** 2).sum()))
    cause = cause_of(found, batch, [0] * 4, [("light.coefficients", t.model.light.coefficients)])
    assert cause == "term steep has a gradient that is not finite in light.coefficients"


def test_the_run_stops_at_the_stated_number_with_its_last_good_state(tmp_path: Path) -> None:
    path = tmp_path / "checkpoint.pt"
    t = trainer()
    for _ in range(2):
        t.advance()
    good = {k: v.clone() for k, v in t.model.state_dict().items()}
    for view in t.views:
        view.rgb[:] = np.nan
    t.table = None
    with pytest.raises(StageError, match=r"diverged(.|\n)*3 dropped steps(.|\n)*term rgb is nan"):
        run_fit(t, hooks(path))
    assert t.step == 5
    again = trainer()
    assert again.load(path) and again.guard.dropped == 3
    state = again.model.state_dict()
    assert all(torch.equal(state[k], good[k]) for k in good if k != "beta" and "window" not in k)


def test_the_guard_counts() -> None:
    g = Guard(2)
    g.drop(1, "a")
    with pytest.raises(StageError, match="2 dropped"):
        g.drop(2, "b")


# ------------------------------------------------------------------ photos and scenes at the extremes
def painted(value: float, alpha: float | None = None) -> list[PhotoView]:
    views = [ball_view(i) for i in range(0, 12, 3)]
    for v in views:
        v.rgb[:] = value
        if alpha is not None:
            v.alpha[:] = alpha
    return views


@pytest.mark.parametrize("value", [0.0, 1e-6, 0.5, 1.0, 1e5])
def test_black_white_constant_and_dazzling_photos(value: float) -> None:
    t = trainer(views=painted(value))
    run_fit(t, hooks())
    finite(t)
    assert t.guard.dropped == 0


@pytest.mark.parametrize("alpha", [0.0, 1.0])
def test_photos_of_nothing_and_of_nothing_else(alpha: float) -> None:
    t = trainer(views=painted(0.3, alpha))
    run_fit(t, hooks())
    finite(t)
    assert t.guard.dropped == 0


def test_one_view_and_one_pixel() -> None:
    view = ball_view(0)
    centre = replace(view, rgb=view.rgb[32:33, 32:33], alpha=view.alpha[32:33, 32:33])
    for views in ([view], [centre]):
        t = trainer(views=views)
        run_fit(t, hooks())
        finite(t)
        assert t.guard.dropped == 0


def test_an_empty_batch_costs_nothing() -> None:
    from stages.inverse_rendering.ray_sampling import Batch, Rays

    t = trainer()
    none = torch.zeros(0, 3)
    index = torch.zeros(0, dtype=torch.int64)
    batch = Batch(Rays(none, none), none, none[:, 0], index, none[:, 0], none, none[:, :2])
    found = objective.terms(t.model, batch, t.settings, torch.Generator(), 1.0)
    assert float(found.total.detach()) == 0 and np.isnan(found.error)


@cache
def loss_at(k: float) -> float:
    """Of a fit of the ball in a unit that is 1 / k of the usual one."""
    views = [ball_view(i) for i in range(0, 12, 3)]
    for v in views:
        v.world_from_cam[:3, 3] *= k
    b = ball_start()
    start = Start((b.values * k).astype(np.float32), (b.lo * k).astype(np.float32), b.cell * k)
    lengths = {name: getattr(SHORT, name) * k for name in ("hash_fine", "unseen_smoothing")}
    t = trainer(SHORT.changed(steps=20, **lengths), views, start)
    run_fit(t, Hooks(lambda *a, **k: None, lambda: False))
    finite(t)
    assert t.guard.dropped == 0
    return float(t.loss)


@pytest.mark.parametrize("scale", [pytest.param(1e-3, marks=pytest.mark.slow), 1e5])
@pytest.mark.slow
def test_scenes_of_any_size(scale: float) -> None:
    """The ball of 0.1 units at 1e-4 and 1e4 units: the same fit, in other units."""
    assert loss_at(scale) == pytest.approx(loss_at(1.0), rel=0.05)


def test_calibration_near_singular() -> None:
    """Matrices that nearly swallow a channel: the loss and its gradient stay finite."""
    t = trainer()
    with torch.no_grad():
        last = t.model.calibration.net[-1]
        assert isinstance(last, torch.nn.Linear)
        last.weight.normal_(std=3.0)
        last.bias.copy_(torch.tensor([-1.0, 0, 0, 0, -1 + 1e-7, 0, 0, 0, -1]))
    assert float(torch.linalg.det(t.model.calibration()).abs().min()) < 1.0
    run_fit(t, hooks())
    finite(t)
    assert t.guard.dropped == 0


@pytest.mark.parametrize("size", [0.0, 1e-30, 1e-7, 1e5])
def test_colours_through_singular_matrices(size: float) -> None:
    """A_n of rank 1 and of any size: colour, loss and every gradient are finite."""
    row = torch.tensor([1.0, -0.5, 0.25])
    a = (size * torch.outer(row, row)).expand(2, 3, 3).clone().requires_grad_()
    colour = torch.tensor([[0.0, 0, 0], [1, 1, 1], [1e5, 0, 1e-8]], requires_grad=True)
    out = objective.calibrated_colours(a, torch.tensor([0, 1, 1]), colour)
    objective.losses.rgb_l1(out, torch.full((3, 3), 0.5)).sum().backward()
    by_hand = size * np.outer(colour.detach().double().numpy() @ row.double().numpy(), row.double().numpy())
    assert np.allclose(out.detach().numpy(), by_hand, rtol=1e-5, atol=1e-6 * size * 1e5)
    assert all(x is not None and bool(torch.isfinite(x).all()) for x in (a.grad, colour.grad))


def test_shading_under_bfloat16_autocast() -> None:
    t = trainer()
    n = torch.nn.functional.normalize(torch.randn(64, 3, generator=torch.Generator().manual_seed(0)), dim=-1)
    wo = torch.nn.functional.normalize(n + 0.3 * n.flip(0), dim=-1)
    plain = t.model.shade(0.1 * n, n, wo).total
    with torch.autocast("cpu", dtype=torch.bfloat16):
        half = t.model.shade(0.1 * n, n, wo).total
    half.sum().backward()
    assert half.dtype == torch.float32 and torch.allclose(half, plain, rtol=0.02, atol=0.01)
    assert all(bool(torch.isfinite(p.grad).all()) for p in t.model.parameters() if p.grad is not None)
