"""The objective by hand and by differences, and the colour matrices in it. [NeuFace eqs. 19, 20]"""

from __future__ import annotations

import math

import numpy as np
import pytest
import torch

from pipeline.maths.ggx_width import best_fit_alpha
from pipeline.maths.microfacet import energy
from stages.inverse_rendering.fit import Trainer
from stages.inverse_rendering.objective import calibrated_colours, terms
from tests.support.small_ball import SMALL, trainer


def test_calibration_applies_each_views_matrix() -> None:
    """[NeuFace eq. 19] in float64 by hand, and its gradient from a step of one in each entry. A view without a ray has
    none, and a colour of 1e5 before one of 1e-8 takes nothing from it."""
    a = torch.randn(4, 3, 3, generator=torch.Generator().manual_seed(0)).requires_grad_()
    colour = torch.tensor([[0.1, 0.2, 0.3], [1e5, 0, 1e-8], [0, 0, 1e-8], [1, 1, 1], [0, 0, 0]])
    view, upstream = torch.tensor([2, 0, 0, 1, 2]), np.arange(1, 16).reshape(5, 3) / 7

    def by_hand(matrices: np.ndarray) -> np.ndarray:
        rows = [[sum(matrices[v, i, j] * c[j] for j in range(3)) for i in range(3)]
                for v, c in zip(view.tolist(), colour.double().numpy(), strict=True)]  # fmt: skip
        return np.array(rows)

    found = calibrated_colours(a, view, colour)
    A = a.detach().double().numpy()
    assert np.allclose(found.detach().numpy(), by_hand(A), rtol=1e-5, atol=1e-15)
    (found * torch.from_numpy(upstream).float()).sum().backward()
    assert a.grad is not None
    for index in np.ndindex(4, 3, 3):
        step = np.zeros_like(A)
        step[index] = 1.0
        slope = (by_hand(step) * upstream).sum()  # linear: what a step of one changes
        assert float(a.grad[index]) == pytest.approx(slope, rel=1e-5, abs=1e-12), index
    assert not a.grad[3].any()


WEIGHTS = {
    "mask": 2.0,
    "eikonal": 3.0,
    "rgb": 5.0,
    "white": 7.0,
    "specular_energy": 11.0,
    "albedo_sparsity": 13.0,
    "shininess_prior": 17.0,
    "f0_excess": 23.0,
    "smooth": 19.0,
}
F0_LIMIT = 0.01  # lower than that of the weighed ball, so that there is an excess  # fmt: skip


def weighed_ball() -> Trainer:
    """A fit whose terms all differ and all have another weight: its skin is patchy, its light not white, and its
    matrices are not the identity."""
    t = trainer(SMALL.changed(f0_limit=F0_LIMIT, **WEIGHTS), calibrated=True)
    t.enter_level()
    t.set_rates()
    torch.manual_seed(0)
    with torch.no_grad():
        t.model.light.coefficients[:4] += 0.3 * torch.rand(4, 3)
        last = t.model.calibration.net[-1]
        assert isinstance(last, torch.nn.Linear)
        last.weight.normal_(std=0.05)
        t.model.calibration.embedding.normal_()
        t.model.spatial.encoding.table.normal_()
        t.model.spatial.net[-1].weight.mul_(10)
    t.model.uniform_albedo = False
    return t


def test_the_objective_is_eq_20_by_hand() -> None:
    """[NeuFace eq. 20] in float64: each term written out from the samples' distances, gradients and material, times its
    weight, and their sum; sums over rays are over all rays drawn, those that meet nothing too."""
    from scipy.special import huber

    from stages.inverse_rendering.render import sample_shell, shade_shell, solid_behind

    t = weighed_ball()
    assert t.table is not None
    batch, generator = t.table.draw(512, 0.25, 0), torch.Generator().manual_seed(0)
    found = terms(t.model, batch, t.settings, torch.Generator().manual_seed(0), 0.5)
    with torch.no_grad():
        jitter = torch.rand(512, 8, generator=generator)
        shell = sample_shell(t.model, batch.rays, 8, jitter, batch.alpha > 0.5)
        tau = (shell.tau + solid_behind(t.model, shell, batch.rays)).double().numpy()
        alpha = batch.alpha[shell.kept].double().numpy()
        pick = np.flatnonzero(shell.hit.numpy() & (alpha > 0.99))
        shaded = shade_shell(t.model, shell, batch.rays, torch.from_numpy(pick))
        x = shell.x[torch.from_numpy(pick)]
        moved = x + t.model.geometry.cell * torch.randn(x.shape, generator=generator)
        n, near = (t.model.geometry(p)[1].double().numpy() for p in (x, moved))
        _, rho, c, width = (v.double().numpy() for v in t.model.spatial(x))
        up = torch.tensor([[0.0, 1.0, 0.0]])
        f0 = rho * (c @ t.model.basis(up, up)[0].double().numpy()) / energy(best_fit_alpha(1 / width))
        A, light = t.model.calibration().double().numpy(), t.model.light().double().numpy()
    kept, rays = shell.kept.numpy(), shell.kept.numpy()[pick]
    assert 0 < len(pick) < len(kept) < 512, "rays of all three kinds"
    a = np.clip(tau, 1e-4, None)
    covered = np.where(tau < 3.5, -np.log(1 - np.exp(-a)), 0)
    mask = np.minimum(alpha * covered + (1 - alpha) * tau, 20) * batch.share.numpy()[kept]
    steep = np.linalg.norm(shell.gradient.double().numpy(), axis=1)
    radiance = np.einsum("nij,nj->ni", A[batch.view.numpy()[rays]], shaded.total.double().numpy())
    srgb = np.where(radiance <= 0.0031308, 12.92 * radiance, 1.055 * np.maximum(radiance, 1e-9) ** (1 / 2.4) - 0.055)
    target = batch.target.double().numpy()[rays]
    log = np.log(shaded.albedo.double().numpy())
    middle = np.sort(log, 0)[(len(log) - 1) // 2]
    n, near = n / np.linalg.norm(n, axis=1)[:, None], near / np.linalg.norm(near, axis=1)[:, None]
    parts = {
        "mask": mask.sum() / 512,
        "eikonal": ((steep - 1) ** 2).mean(),
        "rgb": huber(0.03, srgb - target).mean(1).sum() / 0.03 / 512,
        "white": np.abs(light - light.mean(1)[:, None]).mean(1).sum(),
        "specular_energy": shaded.specular.double().numpy().mean(),
        "albedo_sparsity": np.abs(log - middle).mean(),
        "shininess_prior": (np.log(shaded.inv_kappa.double().numpy() / 0.1) ** 2).mean(),
        "f0_excess": np.maximum(f0 / F0_LIMIT - 1, 0).mean(),
        "smooth": 0.5 * (1 - (n * near).sum(1)).mean(),
    }
    assert list(found.scalars) == list(parts)
    for name, value in parts.items():
        got = float(found.scalars[name].detach())
        assert got == pytest.approx(WEIGHTS[name] * value, rel=1e-3, abs=1e-6), name
        assert value > 1e-7, f"{name} says nothing here"
    total = sum(WEIGHTS[name] * value for name, value in parts.items())
    assert float(found.total.detach()) == pytest.approx(total, rel=1e-3)
    assert found.error == pytest.approx(((np.clip(srgb, 0, 1) - target) ** 2).mean(), rel=1e-3)


def test_background_alone_asks_for_nothing_but_a_mask_and_a_distance() -> None:
    t = weighed_ball()
    assert t.table is not None
    outside = t.table.at(t.table.outside[:64])
    found = terms(t.model, outside, t.settings, torch.Generator().manual_seed(0), 1.0)
    assert list(found.scalars) == ["mask", "eikonal"] and math.isnan(found.error)
    assert float(found.total.detach()) == pytest.approx(sum(float(v.detach()) for v in found.scalars.values()))


@pytest.mark.parametrize(
    "name", ["light.coefficients", "spatial.net.4.bias", "basis.net.4.bias", "calibration.net.2.weight"]
)
def test_the_objectives_gradient_is_that_of_differences(name: str) -> None:
    """Along a random direction of one part of the model. The median that albedo_sparsity holds fixed is left out, the
    width that f0_excess holds fixed, and what depends on the shape alone."""
    t = weighed_ball()
    settings = t.settings.changed(albedo_sparsity=0.0, f0_excess=0.0, mask=0.0, eikonal=0.0, smooth=0.0)
    batch = t.pixels.draw(512, 0.25, 0)
    p = dict(t.model.named_parameters())[name]
    way = torch.randn(p.shape, generator=torch.Generator().manual_seed(1))

    def loss() -> torch.Tensor:
        return terms(t.model, batch, settings, torch.Generator().manual_seed(0), 1.0).total

    (slope,) = torch.autograd.grad((loss()), [p])
    found, values = float((slope * way).sum()), []
    for sign in (1, -1):
        with torch.no_grad():
            p.add_(sign * 2e-3 * way)
            values.append(float(loss()))
            p.sub_(sign * 2e-3 * way)
    assert found == pytest.approx((values[0] - values[1]) / 4e-3, rel=0.03) and abs(found) > 1e-3


def test_objective_reaches_every_parameter() -> None:
    """Each part of the model gets a gradient from the sum."""
    t = trainer(calibrated=True)
    t.enter_level()
    t.set_rates()
    assert t.table is not None
    batch = t.table.draw(512, 0.25, 0)
    terms(t.model, batch, t.settings, torch.Generator().manual_seed(0), 1.0).total.backward()
    assert float(t.model.geometry.sink.abs().sum()) > 0
    for name, p in t.model.named_parameters():
        if name in ("geometry.values", "calibration.embedding", "calibration.net.0.weight", "calibration.net.0.bias"):
            continue  # the grid has its sink; the calibration's last layer starts at zero and moves first
        assert p.grad is not None and float(p.grad.abs().sum()) > 0, name
