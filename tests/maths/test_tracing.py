"""Sphere tracing on shapes whose answer is known."""

from __future__ import annotations

import pytest
import torch

from pipeline.maths import tracing


def ball(p: torch.Tensor) -> torch.Tensor:
    return p.norm(dim=-1) - 1.0


def trace(
    o: list[float], d: list[float], near: float = 0.0, far: float = 10.0, **kw: float
) -> tuple[float, bool, float]:
    t, hit, s = tracing.sphere_trace(
        ball,
        torch.tensor([o]).double(),
        torch.tensor([d]).double(),
        torch.tensor([near]).double(),
        torch.tensor([far]).double(),
        min_step=0.01,
        **kw,
    )
    return float(t), bool(hit), float(s)


@pytest.mark.parametrize("factor", [0.95, 1.2])
def test_hits_are_exact(factor: float) -> None:
    t, hit, s = trace([0, 0, 3], [0, 0, -1], factor=factor)
    assert hit and t == pytest.approx(2.0, abs=1e-6) and abs(s) < 1e-6
    t, hit, _ = trace([0.8, 0, 3], [0, 0, -1], factor=factor)
    assert hit and t == pytest.approx(3 - 0.6, abs=1e-5)


def test_misses_report_the_closest_approach() -> None:
    t, hit, s = trace([1.2, 0, 3], [0, 0, -1])
    assert not hit and t == pytest.approx(3, abs=0.15) and s == pytest.approx(0.2, abs=0.01)


def test_rays_that_begin_inside_are_no_hits() -> None:
    assert not trace([0, 0, 0], [0, 0, 1])[1]


def test_an_empty_interval_is_no_hit() -> None:
    assert not trace([0, 0, 3], [0, 0, -1], near=5.0, far=4.0)[1]


def test_a_grazing_ray_ends() -> None:
    t, _, s = trace([1.0000001, 0, 3], [0, 0, -1])
    assert t == pytest.approx(3, abs=0.05) and s < 1e-3


def test_box_interval() -> None:
    lo, hi = torch.tensor([-1.0, -1, -1]), torch.tensor([1.0, 1, 1])
    o = torch.tensor([[0, 0, 3.0], [0, 0, 0], [5, 0, 3], [-1, 0, 3]])
    d = torch.tensor([[0, 0, -1.0], [1, 0, 0], [0, 0, -1], [0, 0, -1]])
    near, far = tracing.box_interval(o, d, lo, hi)
    assert near[:2].tolist() == [2.0, 0.0] and far[:2].tolist() == [4.0, 1.0]
    assert far[2] <= near[2]
    assert torch.isfinite(near).all() and not torch.isnan(far).any()
