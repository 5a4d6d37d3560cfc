"""I(x) + D(x): values, normals by finite differences, units, and what the rest of the code asks of a geometry."""

from __future__ import annotations

import pytest
import torch

from pipeline.fields.paper import displaced
from pipeline.fields.paper.displaced import DisplacedSdf
from pipeline.fields.paper.priors import HullPrior, SpherePrior
from pipeline.maths.tracing import sphere_interval


def hull(scale: float = 1.0) -> HullPrior:
    axis = torch.linspace(-0.2, 0.2, 41)
    grid = torch.stack(torch.meshgrid(axis, axis, axis, indexing="ij"), -1)
    return HullPrior((grid.norm(dim=-1) - 0.1) * scale, torch.full((3,), -0.2) * scale, 0.01 * scale)


def moved(prior: HullPrior | SpherePrior) -> DisplacedSdf:
    torch.manual_seed(0)
    g = DisplacedSdf(prior, 32, 2)
    with torch.no_grad():
        g.displacement.net[-1].weight.normal_(std=0.02)  # type: ignore[operator,union-attr]
    return g


def test_the_sum_and_its_normal() -> None:
    g = moved(hull()).double()
    x = 0.1 * torch.nn.functional.normalize(torch.randn(20, 3, dtype=torch.float64), dim=-1) + 0.01
    known, away = g.parts(x)
    s, n, d = g.with_displacement(x)
    assert torch.equal(s, known + away) and torch.equal(d, away) and away.abs().max() > 1e-5
    h = 1e-7
    for axis in range(3):
        step = torch.zeros(3, dtype=torch.float64)
        step[axis] = h
        slope = (sum(g.parts(x + step)) - sum(g.parts(x - step))) / (2 * h)  # type: ignore[operator]
        assert torch.allclose(slope, n[:, axis], atol=1e-4)


def test_a_new_displacement_is_zero() -> None:
    g = DisplacedSdf(hull())
    x = torch.randn(50, 3) * 0.1
    assert torch.equal(g.parts(x)[1], torch.zeros(50))


@pytest.mark.parametrize("scale", [1e-3, 1.0, 1e4])
def test_lengths_follow_the_scene(scale: float) -> None:
    """beta, cells and displacements are shares of Omega's radius, so that a statue is a large face."""
    one, other = moved(hull()), moved(hull(scale))
    x = torch.randn(30, 3) * 0.1
    assert torch.allclose(other.parts(x * scale)[1], one.parts(x)[1] * scale, rtol=1e-3, atol=1e-6 * scale)
    assert float(other.beta() / one.beta()) == pytest.approx(scale, rel=1e-4)
    assert other.cell / one.cell == pytest.approx(scale, rel=1e-4)
    s, g = other(x * scale)
    assert bool(torch.isfinite(s).all()) and bool(torch.isfinite(g).all())


@pytest.mark.parametrize("scale", [1e-3, 1.0, 50.0, 1000.0])
def test_rays_meet_a_subject_of_any_size(scale: float) -> None:
    """Tracing with the module's own lengths against bisection in float64, with D != 0: within 1e-4 of Omega's radius,
    the same rays at each size, and a subject that lies I + D and not I - D away."""
    g = moved(hull(scale))
    with torch.no_grad():
        g.displacement.net[-1].bias.fill_(-0.03)  # type: ignore[operator,union-attr]
    centre, radius = g.known.sphere()
    n = torch.nn.functional.normalize(torch.randn(40, 3, generator=torch.Generator().manual_seed(0)), dim=-1)
    o = centre + 0.99 * radius * n
    d = torch.nn.functional.normalize(0.3 * radius * n.roll(1, 0) - 0.99 * radius * n, dim=-1)
    near, far = sphere_interval(o, d, centre, radius)
    t, hit, s = g.trace(o, d, near, far)
    low, high = torch.zeros(40, dtype=torch.float64), (centre + 0.3 * radius * n.roll(1, 0) - o).norm(dim=-1).double()

    def at(t: torch.Tensor) -> torch.Tensor:
        known, away = g.parts(o + t.float()[:, None] * d)
        return (known + away).detach()

    assert (at(low) > 0).all() and (at(high) < 0).all()
    for _ in range(40):
        middle = 0.5 * (low + high)
        outside = at(middle) > 0
        low, high = torch.where(outside, middle, low), torch.where(outside, high, middle)
    assert hit.float().mean() > 0.9
    assert ((t - high)[hit].abs() / radius).max() < 1e-3 and (s[hit].abs() / radius).max() < 5e-5 / 0.15
    with torch.no_grad():
        assert (g.parts(o[hit] + t[hit, None] * d[hit])[1].abs() / radius).mean() > 0.01, "D says nothing here"


def test_the_steps_of_a_trace_are_the_papers(monkeypatch: pytest.MonkeyPatch) -> None:
    """Around a head, whose Omega has 15 cm: until 0.05 mm, at most 5 cm times 1.2 a step."""
    seen: dict[str, float] = {}
    monkeypatch.setattr(displaced, "aggressive_trace", lambda *a, **k: seen.update(k))
    g = DisplacedSdf(SpherePrior(torch.zeros(3), 0.15, 8, 1), 8, 1)
    g.trace(*(torch.zeros(1, 3),) * 2, *(torch.zeros(1),) * 2)
    assert seen == pytest.approx({"threshold": 5e-5, "truncation": 0.05, "factor": 1.2})


def test_beta_stays_positive() -> None:
    """(|raw| + 1e-4) times Omega's radius, as in VolSDF: the same for either sign, and never below the least."""
    g = DisplacedSdf(hull())
    radius = float(hull().sphere()[1])
    for raw in (-1.0, 0.0, 1e-9, 5.0):
        with torch.no_grad():
            g.beta_raw.fill_(raw)
        assert float(g.beta()) == pytest.approx((abs(raw) + 1e-4) * radius, rel=1e-5)


def test_the_hull_goes_on_beyond_its_grid() -> None:
    p = hull()
    x = torch.tensor([[0.5, 0.0, 0.0], [0.2, 0.2, 0.9], [0.0, 0.0, 0.0], [0.21, 0.0, 0.0]], requires_grad=True)
    s = p.sdf(x)
    s.sum().backward()
    assert s[0].item() == pytest.approx(0.4, abs=0.01) and s[2] < -0.09 and bool(torch.isfinite(x.grad).all())
    centre, radius = p.sphere()
    assert float(centre.norm()) < 0.01 and 0.1 < radius < 0.25


def test_an_empty_hull_has_a_sphere() -> None:
    """It holds the whole grid, and not much more."""
    p = HullPrior(torch.ones(5, 5, 5), torch.zeros(3), 0.1)
    centre, radius = p.sphere()
    corners = 0.4 * torch.tensor([[i, j, k] for i in (0.0, 1) for j in (0.0, 1) for k in (0.0, 1)])
    assert (centre - 0.2).abs().max() <= 0.05 + 1e-6
    assert float((corners - centre).norm(dim=-1).max()) <= radius < 0.5


def test_normals_can_be_learnt_through() -> None:
    """The Eikonal term needs the derivative of the gradient by the parameters: against differences, in float64."""
    torch.manual_seed(0)
    g = DisplacedSdf(SpherePrior(torch.zeros(3), 0.2, 16, 2), 16, 2).double()
    x = torch.randn(10, 3, dtype=torch.float64) * 0.1

    def uneven() -> torch.Tensor:
        return ((g(x)[1].norm(dim=-1) - 1) ** 2).mean()

    with torch.no_grad():
        g.displacement.net[-1].weight.normal_(std=0.02)  # type: ignore[operator,union-attr]
    uneven().backward()
    weights = {name: p for name, p in g.named_parameters() if name.endswith("weight")}
    for name, p in weights.items():
        way, values = torch.randn(p.shape, dtype=torch.float64), []
        assert p.grad is not None, name
        for sign in (1, -1):
            with torch.no_grad():
                p.add_(sign * 1e-5 * way)
            values.append(float(uneven().detach()))
            with torch.no_grad():
                p.sub_(sign * 1e-5 * way)
        slope = (values[0] - values[1]) / 2e-5
        assert float((p.grad * way).sum()) == pytest.approx(slope, rel=1e-3, abs=1e-6), name
    assert len(weights) > 4
    with torch.no_grad():
        assert not g(torch.zeros(1, 3))[0].requires_grad
