"""Loss terms: values by hand, and gradients where they could break."""

from __future__ import annotations

import numpy as np
import pytest
import torch

from pipeline.colour import linear_from_srgb
from pipeline.maths import losses


def test_rgb_is_zero_for_the_right_colour_and_keeps_its_gradient_above_one() -> None:
    target = torch.tensor([[0.2, 0.5, 1.0]])
    assert float(losses.rgb_l1(linear_from_srgb(target), target)) == pytest.approx(0, abs=1e-6)
    x = torch.tensor([[0.0, 2.0, -0.1]], requires_grad=True)
    losses.rgb_l1(x, target).sum().backward()
    assert torch.isfinite(x.grad).all() and (x.grad != 0).all()


def test_a_clipped_value_is_a_limit() -> None:
    """Per channel in float64: at a lower limit only what is below it costs, at an upper limit only what is above it."""
    generator = torch.Generator().manual_seed(0)
    target = torch.rand(200, 3, generator=generator, dtype=torch.float64)
    colour = (1.5 * torch.rand(200, 3, generator=generator, dtype=torch.float64) - 0.2).requires_grad_()
    bound = torch.randint(-1, 2, (200, 3), generator=generator, dtype=torch.int8)

    def by_hand(linear: np.ndarray) -> np.ndarray:
        srgb = np.where(linear <= 0.0031308, 12.92 * linear, 1.055 * np.maximum(linear, 0.003) ** (1 / 2.4) - 0.055)
        r, b = srgb - target.numpy(), bound.numpy()
        cost = np.where(b == 0, np.abs(r), np.where(b > 0, np.maximum(-r, 0), np.maximum(r, 0)))
        return np.asarray(cost)

    found = losses.rgb_residual(colour, target, bound)
    values = colour.detach().numpy()
    assert np.allclose(found.detach().numpy(), by_hand(values), rtol=1e-6, atol=1e-7)
    found.sum().backward()
    assert colour.grad is not None
    h = 1e-6
    for c in range(3):
        step = np.zeros((200, 3))
        step[:, c] = h
        slope = (by_hand(values + step) - by_hand(values - step)) / (2 * h)
        assert np.allclose(colour.grad[:, c].numpy(), slope[:, c], rtol=1e-3, atol=1e-6)


def test_clipped_values_at_the_extremes() -> None:
    target = torch.tensor([[1.0, 1.0, 1.0]] * 3)
    bright = torch.tensor([[1e6] * 3, [1.0] * 3, [0.0] * 3], requires_grad=True)
    cost = losses.rgb_residual(bright, target, torch.ones(3, 3, dtype=torch.int8)).mean(-1)
    assert cost.tolist() == pytest.approx([0, 0, 1], abs=1e-6)
    cost.sum().backward()
    assert bright.grad is not None and torch.isfinite(bright.grad).all()
    assert not bright.grad[0].any() and (bright.grad[2] < 0).all()
    free = torch.zeros(3, 3, dtype=torch.int8)
    assert torch.equal(losses.rgb_residual(bright, target, free).mean(-1), losses.rgb_l1(bright, target))


def test_colour_loss_against_scipys_huber() -> None:
    from scipy.special import huber

    t = losses.RGB_SCALE
    r = np.abs(np.random.default_rng(0).normal(0, t, (500, 3)))
    assert 0.1 < (r > t).mean() < 0.5
    residual = torch.from_numpy(r).requires_grad_()
    cost = losses.rgb_cost(residual)
    assert np.allclose(cost.detach().numpy(), huber(t, r).mean(1) / t, rtol=1e-6, atol=1e-9)
    cost.sum().backward()
    assert residual.grad is not None
    h = 1e-7
    slope = (huber(t, r + h) - huber(t, r - h)) / (2 * h * 3 * t)
    assert np.allclose(residual.grad.numpy(), slope, rtol=1e-4, atol=1e-6)


def test_the_colour_loss_pulls_as_an_absolute_value_from_its_scale_on() -> None:
    r = torch.tensor([0.0, 1e-20, 0.5 * losses.RGB_SCALE, losses.RGB_SCALE, 1.0, 1e6])[:, None].expand(6, 3).clone()
    cost = losses.rgb_cost(r.requires_grad_())
    cost.sum().backward()
    assert torch.isfinite(cost).all() and r.grad is not None
    assert (3 * r.grad[:, 0]).tolist() == pytest.approx([0, 0, 0.5, 1, 1, 1], rel=1e-5, abs=1e-9)


def test_what_is_above_its_limit_costs() -> None:
    f = torch.tensor([-1.0, 0.0, 0.17, 0.34, 17.0], requires_grad=True)
    cost = losses.above(f, 0.17)
    assert cost.tolist() == pytest.approx([0, 0, 0, 1, 99], rel=1e-5)
    cost.sum().backward()
    assert f.grad is not None and f.grad[[0, 1]].tolist() == [0, 0]
    assert f.grad[[3, 4]].tolist() == pytest.approx([1 / 0.17] * 2)


def test_white_light_counts_colour_alone() -> None:
    assert losses.white_light(torch.tensor([[2.0, 2, 2]])).item() == 0
    assert losses.white_light(torch.tensor([[3.0, 0, 0]])).item() == pytest.approx(4 / 3)


@pytest.mark.parametrize("squared", [True, False])
def test_eikonal(squared: bool) -> None:
    g = torch.tensor([[0.0, 0, 0], [1, 0, 0], [0, 3, 0]], requires_grad=True)
    found = losses.eikonal(g, squared)
    assert found.tolist() == pytest.approx([1, 0, 4 if squared else 2], abs=1e-5)
    found.sum().backward()
    assert torch.isfinite(g.grad).all()


def test_the_other_terms() -> None:
    assert losses.displacement(torch.tensor([-2.0, 1.0])).tolist() == [2, 1]
    assert losses.embedding(torch.tensor([[3.0, 4.0]])).item() == 25
    assert losses.specular_energy(torch.tensor([[0.0, 0.3, 0.6]])).item() == pytest.approx(0.3)
    n = torch.tensor([[0.0, 0, 1]])
    assert losses.normal_consistency(n, n).item() == 0 and losses.normal_consistency(n, -n).item() == 2


def test_shininess_prior_is_even_and_finite_at_a_mirror() -> None:
    s = torch.tensor([0.1, 0.2, 0.05, 0.0, 1e6], requires_grad=True)
    found = losses.shininess_prior(s, 0.1)
    assert found[0].item() == 0 and found[1].item() == pytest.approx(found[2].item(), rel=1e-5)
    found.sum().backward()
    assert torch.isfinite(found).all() and torch.isfinite(s.grad).all()


def test_albedo_sparsity_counts_departures_from_the_usual_skin() -> None:
    even = torch.full((9, 3), 0.3)
    assert losses.albedo_sparsity(even).abs().max().item() == 0
    spotted = even.clone()
    spotted[0] *= 0.5
    found = losses.albedo_sparsity(spotted)
    assert found[0].item() == pytest.approx(0.6931, abs=1e-4) and found[1:].abs().max().item() == 0
    assert torch.allclose(losses.albedo_sparsity(spotted * 0.7), found, atol=1e-6)  # blind to the light's strength
    black = torch.zeros(3, 3, requires_grad=True)
    losses.albedo_sparsity(black).sum().backward()
    assert torch.isfinite(black.grad).all()
