"""The paper's preset and its priors, on a ball whose every property is known."""

from __future__ import annotations

from dataclasses import replace
from pathlib import Path
from typing import Any

import numpy as np
import pytest
import torch

from pipeline.errors import Cancelled, StageError
from pipeline.fields.face import FaceModel, FittedField, load_model
from pipeline.fields.paper.sinusoidal import SinusoidalField, positional_encoding
from pipeline.maths.density import laplace_density, ray_weights
from stages.inverse_rendering.objective import Terms
from stages.inverse_rendering.outputs import predict_view
from stages.inverse_rendering.paper import render as paper_render
from stages.inverse_rendering.paper import trainer as paper
from stages.inverse_rendering.paper.config import PaperConfig
from stages.inverse_rendering.paper.render import geometry_of, render_samples
from stages.inverse_rendering.ray_sampling import Rays
from stages.inverse_rendering.training_loop import run_fit
from tests.support.imface_checkpoint import ours, published
from tests.support.small_ball import SMALL, ball_start, ball_view, hooks

PAPER = PaperConfig(preset="paper")
COMPARED = PaperConfig(**{**SMALL.model_dump(), "preset": "comparison"})
TINY = PAPER.changed(
    image_side=64, steps=6, batch=64, samples=8, width=24, depth=5, basis_width=16, basis_depth=2,
    lr_appearance=2e-3, lr_light=1e-2,
)  # fmt: skip


def trainer(settings: PaperConfig = TINY, **changes: Any) -> paper.PaperTrainer:
    views = [ball_view(i) for i in range(0, 12, 2)]
    return paper.new_paper_trainer(views, ball_start(0.1), settings.changed(**changes), True, "cpu")


def test_the_preset_is_the_papers() -> None:
    """The numbers of the supplement, section B."""
    assert (PAPER.rgb, PAPER.white, PAPER.specular_energy) == (1.0, 5e-3, 8e-3)
    assert (PAPER.embedding, PAPER.eikonal, PAPER.displacement) == (1e3, 0.1, 1e-3)
    assert (PAPER.batch, PAPER.samples, PAPER.rank, PAPER.light_order) == (2048, 32, 3, 10)
    assert (PAPER.lr_appearance, PAPER.lr_light) == (1e-4, 1e-4)
    assert (PAPER.appearance, PAPER.basis_inputs, PAPER.density) == ("sinusoidal", "paper", "laplace")
    assert PAPER.attenuation == "exponential" and PAPER.calibration == "on"
    assert PAPER.steps == 3000 * 43 and PAPER.image_side == 1024


def test_schedule() -> None:
    """Halved at 375, 750, ..., 2,250 of 3,000 epochs, and then no more."""
    found = [paper.rate_factor(e / 3000) for e in (0, 374, 375, 749, 750, 2249, 2250, 2999)]
    assert found == [1, 1, 0.5, 0.5, 0.25, 1 / 32, 1 / 64, 1 / 64]


@pytest.mark.slow
def test_rates_of_the_parts(tmp_path: Path) -> None:
    """ImFace's networks at 1 %, its codes and all else at the full rate; the hull's samples are no parameters."""
    torch.save({"decoder": published(ours(False), "2022")}, tmp_path / "envs_last.pth")
    t = trainer(prior="imface", prior_file=str(tmp_path / "envs_last.pth"))
    rate = {id(p): g["start"] for g in t.optimiser.param_groups for p in g["params"]}
    for name, p in t.model.named_parameters():
        slow = name.startswith("geometry.prior.") and ".z_" not in name
        assert rate[id(p)] == pytest.approx(2e-5 if slow else 1e-2 if name.startswith("light") else 2e-3), name
    names = [n for n, _ in trainer().model.named_parameters() if n.startswith("geometry.prior")]
    assert names == []


@pytest.mark.parametrize("prior", ["hull", "sphere", pytest.param("imface", marks=pytest.mark.slow)])
def test_every_prior_fits_saves_and_loads(prior: str, tmp_path: Path) -> None:
    """Steps move every parameter, the file gives the same field back, and the stages after the fit can ask it."""
    torch.save({"decoder": published(ours(True), "2022")}, tmp_path / "envs_last.pth")
    t = trainer(prior=prior, prior_file=str(tmp_path / "envs_last.pth"), prior_scale=0.12)
    before = {n: p.detach().clone() for n, p in t.model.named_parameters()}
    run_fit(t, hooks())
    assert t.guard.dropped == 0
    still = [n for n, p in t.model.named_parameters() if torch.equal(p, before[n])]
    allowed = ("calibration.embedding", "calibration.net.0")  # its last layer starts at zero and moves first
    sleeping = ("deform.net", "reference.net")  # replaced by what the hyper-networks give
    assert [n for n in still if not n.startswith(allowed) and not any(s in n for s in sleeping)] == []
    t.model.save(tmp_path / "field.npz")
    again = load_model(tmp_path / "field.npz")
    x = 0.1 * torch.nn.functional.normalize(torch.randn(50, 3), dim=-1)
    for a, b in zip(t.model.geometry(x), again.geometry(x), strict=True):
        assert torch.equal(a, b)
    field = FittedField(again)
    s, g = field.sdf_and_gradient(x.numpy())
    assert np.isfinite(s).all() and np.isfinite(g).all() and field.cell > 0
    assert field.material(x.numpy()).albedo.shape == (50, 3) and field.light.shape == (121, 3)


def test_a_prior_without_its_file_is_told() -> None:
    with pytest.raises(StageError, match=r"licensed(.|\n)*docs/imface.md"):
        trainer(prior="imface")


def test_what_is_rendered_is_eq_18_by_hand() -> None:
    """One ray at a time, in float64, from the same model: samples, density, weights and shading written out again."""
    t = trainer()
    geometry = geometry_of(t.model)
    o = torch.tensor([[0.0, 0, 0.5], [0.05, 0, 0.5], [0.12, 0, 0.5], [0.5, 0, 0.5]])
    rays = Rays(o, torch.tensor([[0.0, 0, -1]]).expand(4, 3).contiguous())
    with torch.no_grad():
        got = render_samples(t.model, rays, 8, None)
    assert got.kept.tolist() == [0, 1, 2]
    centre, radius = geometry.known.sphere()
    shell = 5e-4 * radius / 0.15  # half a millimetre of a head whose sphere has 15 cm
    for i in range(3):
        to = o[i] - centre
        half = float((radius**2 - to[:2].square().sum()).sqrt())
        near, far = float(to[2]) - half, float(to[2]) + half
        hit = i < 2
        if hit:
            depth = torch.linspace(near, far, 20_001)
            s = torch.cat([geometry(o[i] + d[:, None] * rays.d[i])[0] for d in depth.split(5_000)])
            t0 = float(depth[(s < 0).nonzero()[0, 0]])
            first, step = t0 - shell, 2 * shell / 8
        else:
            first, step = near, (far - near) / 8
        at = first + step * (torch.arange(8) + 0.5)
        s, g = geometry(o[i] + at[:, None] * rays.d[i])
        delta = torch.full((1, 8), step)
        delta[0, -1] += (far - t0 - shell) if hit else 0.0
        w, tau = ray_weights(laplace_density(s[None], geometry.beta()), delta)
        n = torch.nn.functional.normalize(g, dim=-1)
        colour = t.model.shade(o[i] + at[:, None] * rays.d[i], n, -rays.d[i].expand(8, 3)).total
        expected = (w[0, :, None] * colour).sum(0)
        assert torch.allclose(got.colour[i], expected, rtol=0.03, atol=1e-4), i
        assert float(got.opacity[i]) == pytest.approx(float(-torch.expm1(-tau)), abs=0.02)
    assert got.opacity[0] > 0.99 and got.opacity[2] < 0.3 and got.opacity[3] == 0


def test_samples_lie_half_a_millimetre_around_the_surface_and_the_last_reaches_to_the_far_side(
    monkeypatch: pytest.MonkeyPatch,
) -> None:
    """What the renderer asks its parts for, on a ray through the ball's middle: places, directions and lengths."""
    t = trainer()
    centre, radius = geometry_of(t.model).known.sphere()
    asked: dict[str, torch.Tensor] = {}
    shade, weights = type(t.model).shade, ray_weights

    def spied_shade(self: FaceModel, x: torch.Tensor, n: torch.Tensor, wo: torch.Tensor) -> Any:
        asked.update(x=x, wo=wo)
        return shade(self, x, n, wo)

    def spied_weights(density: torch.Tensor, delta: torch.Tensor) -> Any:
        asked.update(delta=delta)
        return weights(density, delta)

    monkeypatch.setattr(type(t.model), "shade", spied_shade)
    monkeypatch.setattr(paper_render, "ray_weights", spied_weights)
    monkeypatch.setattr(paper_render, "NEGLIGIBLE", -1.0)
    d = torch.nn.functional.normalize(torch.tensor([[0.2, -0.1, -1.0]]), dim=-1)
    o = torch.as_tensor(centre) - 0.5 * d
    with torch.no_grad():
        render_samples(t.model, Rays(o, d), 8, None)
        along = ((asked["x"] - o) @ d[0]).sort().values
        depth = torch.linspace(0.5 - float(radius), 0.5, 20_001)
        s = torch.cat([geometry_of(t.model)(o + part[:, None] * d)[0] for part in depth.split(5_000)])
        t0 = float(depth[(s < 0).nonzero()[0, 0]])
    shell = 5e-4 * float(radius) / 0.15
    assert torch.allclose(asked["wo"], -d.expand(8, 3))
    assert torch.allclose(along, t0 + shell * ((torch.arange(8) + 0.5) / 4 - 1), atol=0.3 * shell)
    assert float(along[-1] - along[0]) == pytest.approx(2 * shell * 7 / 8, rel=0.01)
    far = 0.5 + float(radius)
    assert float(asked["delta"].sum()) == pytest.approx(far - t0 + shell, abs=0.3 * shell)
    assert torch.allclose(asked["delta"][0, :7], torch.full((7,), shell / 4), rtol=1e-4)


@pytest.mark.parametrize("prior", ["hull", "imface"])
def test_the_terms_are_eq_20_by_hand(prior: str, tmp_path: Path) -> None:
    """[NeuFace eq. 20] in float64 from what was rendered, each part with a weight of its own; a prior without codes has
    no embedding term, and a pixel that shows the subject in part has no colour term."""
    torch.save({"decoder": published(ours(True), "2022")}, tmp_path / "envs_last.pth")
    weights = {
        "rgb": 2.0,
        "white": 3.0,
        "specular_energy": 5.0,
        "embedding": 7.0,
        "eikonal": 11.0,
        "displacement": 13.0,
    }
    file = str(tmp_path / "envs_last.pth")
    t = trainer(prior=prior, prior_file=file, prior_scale=0.12, **weights)
    torch.manual_seed(0)
    with torch.no_grad():
        t.model.light.coefficients[:4] += 0.3 * torch.rand(4, 3)
        t.model.calibration.net[-1].weight.normal_(std=0.1)
        for name, p in t.model.named_parameters():
            if name.startswith("geometry.") and not name.startswith("geometry.prior.") or ".z_" in name:
                p.add_(0.01 * torch.randn(p.shape))
    batch = t.pixels.draw(64, 0.25, 0)
    batch.alpha[:3] = torch.tensor([0.3, 0.6, 0.98])
    found: Terms = paper.paper_terms(t.model, batch, t.settings, torch.Generator().manual_seed(0))
    with torch.no_grad():
        jitter = torch.rand(64, t.settings.samples, generator=torch.Generator().manual_seed(0))
        got = render_samples(t.model, batch.rays, t.settings.samples, jitter)
        A, light = t.model.calibration().double().numpy(), t.model.light().double().numpy()
        geometry = geometry_of(t.model)
        z = geometry.known.embeddings()
        radius = float(geometry.known.sphere()[1])
    radiance = np.einsum("nij,nj->ni", A[batch.view.numpy()], got.colour.double().numpy())
    srgb = np.where(radiance <= 0.0031308, 12.92 * radiance, 1.055 * np.maximum(radiance, 1e-9) ** (1 / 2.4) - 0.055)
    alpha = batch.alpha.numpy()
    target = np.where(alpha[:, None] > 0.99, batch.target.double().numpy(), 0)
    sure = (alpha > 0.99) | (alpha < 0.01)
    assert not sure[:3].any() and sure.sum() > 20
    parts = {
        "rgb": np.abs(srgb - target).mean(1)[sure].sum() / 64,
        "white": np.abs(light - light.mean(1)[:, None]).mean(1).sum(),
        "specular_energy": got.specular.double().numpy().mean(1).sum() / 64,
        "eikonal": np.abs(np.linalg.norm(got.gradient.double().numpy(), axis=1) - 1).mean(),
        "displacement": np.abs(got.moved.double().numpy()).mean() / radius,
    }
    if prior == "imface":
        assert z is not None
        parts["embedding"] = (z.double().numpy() ** 2).sum()
    assert set(found.scalars) == set(parts)
    for name, value in parts.items():
        got_ = float(found.scalars[name].detach())
        assert got_ == pytest.approx(weights[name] * value, rel=2e-3) and value > 1e-7, name
    total = sum(weights[name] * value for name, value in parts.items())
    assert float(found.total.detach()) == pytest.approx(total, rel=1e-3)


def test_rays_past_the_head_have_no_shape_terms() -> None:
    """The extreme of [NeuFace eq. 20]: nothing is met, so that the colour is black, which is what the mask says."""
    t = trainer()
    batch = t.pixels.at(t.pixels.outside[:16])
    away = replace(batch, rays=Rays(batch.rays.o, -batch.rays.d))
    found = paper.paper_terms(t.model, away, t.settings, torch.Generator().manual_seed(0))
    assert list(found.scalars) == ["rgb", "white", "specular_energy"]
    assert float(found.scalars["rgb"].detach()) == 0 and float(found.scalars["specular_energy"].detach()) == 0


def test_interruptions_change_nothing(tmp_path: Path) -> None:
    whole = trainer()
    run_fit(whole, hooks())
    path = tmp_path / "checkpoint.pt"
    first = trainer()
    with pytest.raises(Cancelled):
        run_fit(first, hooks(path, lambda: first.step >= 3))
    last = trainer()
    run_fit(last, hooks(path))
    for (name, a), (_, b) in zip(whole.model.state_dict().items(), last.model.state_dict().items(), strict=True):
        assert torch.equal(a, b), name


@pytest.mark.slow
def test_the_ball_gets_its_colours() -> None:
    t = trainer(steps=60, batch=192, width=48)
    run_fit(t, hooks())
    view = ball_view(5)
    rgba = predict_view(t.model, view, 2, 8, "cpu")
    small = view.rgb.reshape(32, 2, 32, 2, 3).mean((1, 3))
    inside = view.alpha.reshape(32, 2, 32, 2).mean((1, 3)) > 0.99
    assert np.abs(rgba[..., :3][inside] - small[inside]).mean() < 0.06
    assert t.guard.dropped == 0 and float(t.model.beta) > 0


# ------------------------------------------------------------------ networks
def test_the_sinusoidal_field_is_not_odd_and_keeps_its_spread() -> None:
    """With zero biases f(-x) = 2 f(0) - f(x) at the start; and deep layers neither die nor saturate."""
    torch.manual_seed(0)
    f = SinusoidalField(torch.zeros(3), 1.0, 3, True, width=64, depth=8)
    x = torch.rand(2000, 3) * 2 - 1
    raw = lambda p: torch.logit(f(p)[0])  # noqa: E731
    assert (raw(x) + raw(-x) - 2 * raw(torch.zeros(1, 3))).abs().mean() > 0.01
    h = x
    for i, layer in enumerate(f.layers):
        h = layer(torch.cat([h, x], -1) if i == 4 else h)
        assert 0.4 < float(h.detach().std()) < 0.9, i
    a, rho, c, s = f(x)
    assert a.min() > 0 and a.max() < 1 and c.min() >= 0 and s.min() > 0 and rho.shape == (2000,)


def test_positional_encoding_is_gamma() -> None:
    u = torch.tensor([[0.1, -0.3, 0.7]])
    found = positional_encoding(u, 6)[0]
    assert found.shape == (36,)
    for k in range(6):
        expected = torch.cat([torch.sin(2.0**k * torch.pi * u[0]), torch.cos(2.0**k * torch.pi * u[0])])
        assert torch.allclose(found[6 * k : 6 * k + 6], expected, atol=1e-5)


def test_the_sphere_prior_starts_as_a_sphere() -> None:
    torch.manual_seed(0)
    t = trainer(prior="sphere")
    centre, radius = geometry_of(t.model).known.sphere()
    d = torch.nn.functional.normalize(torch.randn(200, 3), dim=-1)
    s, g = t.model.geometry(centre + 0.6 * radius * d)
    assert float(s.detach().abs().max()) < 0.15 * radius
    assert float((torch.nn.functional.normalize(g.detach(), dim=-1) * d).sum(-1).min()) > 0.9


def test_the_key_depends_on_the_content_of_the_priors_file(tmp_path: Path) -> None:
    path = tmp_path / "envs_last.pth"
    digests = set()
    for content in (b"a", b"b"):
        path.write_bytes(content)
        settings = PaperConfig(prior="imface", prior_file=str(path))
        digests.add(settings.prior_digest)
        assert "prior_file" not in settings.model_dump()
    assert len(digests) == 2 and PaperConfig().prior_digest not in digests
