"""The fit on a ball whose every property is known, its checkpoints, and the tables that feed it."""

from __future__ import annotations

import math
from collections.abc import Callable
from dataclasses import replace
from pathlib import Path

import cv2
import numpy as np
import pytest
import torch

from pipeline import transforms
from pipeline.errors import Cancelled, StageError
from stages.inverse_rendering.config import Config
from stages.inverse_rendering.fit import Hooks, Trainer, run_fit
from stages.inverse_rendering.initial_geometry import Start
from stages.inverse_rendering.initialise import new_trainer
from stages.inverse_rendering.objective import calibrated_colours, terms
from stages.inverse_rendering.outputs import predict_view
from stages.inverse_rendering.ray_sampling import PhotoView, PixelTable, factor_for, image_rays
from tests.support.spread import made_once

RADIUS, SIDE = 0.1, 64
SMALL = Config(
    lr_sdf=0.2,  # few steps for 8 mm
    image_side=64,
    steps=200,
    batch=512,
    samples=8,
    grid_cells=48,
    levels=2,
    hash_levels=6,
    hash_log2_size=12,
    hash_fine=0.004,
    width=32,
)


def ball_view(index: int, gain: float = 1.0) -> PhotoView:
    """A photo of a ball, half red half blue, under a light that falls off from +y: closed form by hand."""
    angle = 2 * math.pi * index / 12
    centre = 0.5 * np.array([math.sin(angle), 0.4 * math.sin(3 * angle), math.cos(angle)])
    z = -centre / np.linalg.norm(centre)
    x = np.cross(z, [0, 1, 0])
    x /= np.linalg.norm(x)
    world_from_cam = transforms.rigid(np.stack([x, np.cross(z, x), z], 1), centre)
    K = np.array([[90.0, 0, SIDE / 2], [0, 90.0, SIDE / 2], [0, 0, 1]])
    uv = transforms.pixel_centres(SIDE * 4, SIDE * 4) / 4  # 4 x 4 samples a pixel
    o, d = transforms.rays(K, world_from_cam, np.zeros(5), uv)
    b = d @ o
    under = b * b - (o @ o - RADIUS**2)
    hit = under > 0
    p = o + (-b - np.sqrt(np.where(hit, under, 0)))[:, None] * d
    n = p / RADIUS
    albedo = np.where(n[:, :1] > 0, [[0.6, 0.3, 0.3]], [[0.25, 0.3, 0.6]])
    rgb = np.where(hit[:, None], gain * albedo * (0.7 + 0.3 * n[:, 1:2]), 0)
    image = rgb.reshape(SIDE, 4, SIDE, 4, 3).mean((1, 3))
    alpha = hit.reshape(SIDE, 4, SIDE, 4).mean((1, 3))
    return PhotoView(index, image.astype(np.float32), alpha.astype(np.float32), K, world_from_cam, np.zeros(5))


def ball_start(radius: float = 0.108) -> Start:
    lo, cell = -0.14, 0.01
    i = np.stack(np.meshgrid(*[np.arange(29)] * 3, indexing="ij"), -1)
    values = np.linalg.norm(lo + cell * i, axis=-1) - radius
    return Start(values.astype(np.float32), np.full(3, lo, np.float32), cell)


def trainer(
    settings: Config = SMALL, calibrated: bool = False, gains: Callable[[int], float] = lambda i: 1.0
) -> Trainer:
    views = [ball_view(i, gains(i)) for i in range(12) if i != 5]
    return new_trainer(views, ball_start(), settings, calibrated, "cpu")


def hooks(path: Path | None = None, stop: Callable[[], bool] = lambda: False) -> Hooks:
    return Hooks(lambda *a, **k: None, stop, path)


def fit_of_the_ball(_: Path) -> Trainer:
    t = trainer()
    run_fit(t, hooks())
    return t


@pytest.fixture(scope="module")
def fitted(tmp_path_factory: pytest.TempPathFactory) -> Trainer:
    return made_once(tmp_path_factory, "fit_of_the_ball", fit_of_the_ball)


def test_the_ball_is_found(fitted: Trainer) -> None:
    """Started 8 mm too large, silhouettes and shading bring the surface to the ball's, and an unseen view is right."""
    d = torch.nn.functional.normalize(torch.randn(500, 3, generator=torch.Generator().manual_seed(0)), dim=-1)
    d = d[d[:, 1].abs() < 0.6]
    s, g = (x.detach() for x in fitted.model.geometry(RADIUS * d))
    assert float(s.abs().mean()) < 0.0012
    assert float((torch.nn.functional.normalize(g, dim=-1) * d).sum(-1).mean()) > 0.99
    view = ball_view(5)
    rgba = predict_view(fitted.model, view, 1, 8, "cpu")
    inside = view.alpha > 0.99
    assert np.abs(rgba[..., :3][inside] - view.rgb[inside]).mean() < 0.03
    assert np.abs(rgba[..., 3] - view.alpha).mean() < 0.02


def test_the_fit_finds_out_what_the_ball_requires(fitted: Trainer) -> None:
    """It is Lambertian, its photos are of one camera, and it began 8 mm too large; test_cross_validation.py has more."""
    c = fitted.choices
    assert c is not None and not c.specular and not c.calibrated and c.refine_geometry and c.light_order == 3
    assert len(fitted.model.light()) == 16 and all(
        f["why"] == "cross-validation" for k, f in c.facts.items() if k != "rank"
    )


@pytest.mark.slow
def test_shading_goes_to_the_light(fitted: Trainer) -> None:
    """The ball's radiance is a (0.7 + 0.3 n_y), for which E = pi c_0 Y_0 + 2 pi / 3 c_1 Y_1 y: c_1 / c_0 = 0.371. Left
    to itself the fit keeps its even light and paints the shading onto the ball."""

    def slope(t: Trainer) -> tuple[float, float]:
        c = t.model.light().detach().mean(-1)
        return float(c[1] / c[0]), float(c[2:4].abs().max() / c[0])

    up, aside = slope(fitted)
    assert abs(up - 0.371) < 0.06 and aside < 0.05
    free = trainer(SMALL.changed(albedo_sparsity=0.0, uniform_albedo_until=0.0))
    run_fit(free, hooks())
    assert slope(free)[0] < 0.28


@pytest.mark.slow
def test_a_fit_repeats_bit_by_bit(fitted: Trainer) -> None:
    again = trainer()
    run_fit(again, hooks())
    for (name, a), (_, b) in zip(fitted.model.state_dict().items(), again.model.state_dict().items(), strict=True):
        assert torch.equal(a, b), name


@pytest.mark.slow
def test_a_calibrated_fit_repeats_bit_by_bit(all_cores: None) -> None:
    """The colour matrices are shared by many rays: their gradient's sum must not depend on timing."""
    short = SMALL.changed(steps=40, batch=4096)
    states = []
    for _ in range(2):
        t = trainer(short, calibrated=True)
        run_fit(t, hooks())
        states.append(t.model.state_dict())
    for name in states[0]:
        assert torch.equal(states[0][name], states[1][name]), name


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


@pytest.mark.slow
def test_three_interruptions_change_nothing(fitted: Trainer, tmp_path: Path) -> None:
    path = tmp_path / "checkpoint.pt"
    for stop_at in (20, 75, 150):  # in the first level, across the refinement, in the second
        t = trainer()
        with pytest.raises(Cancelled):
            run_fit(t, hooks(path, lambda t=t, s=stop_at: t.step >= s))  # type: ignore[misc]
        assert t.step == stop_at and path.is_file() and not path.with_suffix(".new").exists()
    last = trainer()
    run_fit(last, hooks(path))
    for (name, a), (_, b) in zip(fitted.model.state_dict().items(), last.model.state_dict().items(), strict=True):
        assert torch.equal(a, b), name


@pytest.mark.slow
def test_a_torn_or_foreign_checkpoint_is_not_used(tmp_path: Path) -> None:
    path = tmp_path / "checkpoint.pt"
    path.write_bytes(b"torn")
    t = trainer()
    assert not t.load(path)
    t.save(path)
    assert trainer().load(path)
    assert not trainer(SMALL.changed(seed=7)).load(path)


WEIGHTS = {
    "mask": 2.0, "eikonal": 3.0, "rgb": 5.0, "white": 7.0, "specular_energy": 11.0, "albedo_sparsity": 13.0,
    "shininess_prior": 17.0, "smooth": 19.0,
}  # fmt: skip


def weighed_ball() -> Trainer:
    """A fit whose terms all differ and all have another weight: its skin is patchy, its light not white, and its
    matrices are not the identity."""
    t = trainer(SMALL.changed(**WEIGHTS), calibrated=True)
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
        "rgb": np.abs(srgb - target).mean(1).sum() / 512,
        "white": np.abs(light - light.mean(1)[:, None]).mean(1).sum(),
        "specular_energy": shaded.specular.double().numpy().mean(),
        "albedo_sparsity": np.abs(log - middle).mean(),
        "shininess_prior": (np.log(shaded.inv_kappa.double().numpy() / 0.1) ** 2).mean(),
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
    """Along a random direction of one part of the model. The median that albedo_sparsity holds fixed is left out,
    and so is what depends on the shape alone."""
    t = weighed_ball()
    settings = t.settings.changed(albedo_sparsity=0.0, mask=0.0, eikonal=0.0, smooth=0.0)
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


@pytest.mark.slow
def test_calibration_takes_the_cameras_gains() -> None:
    t = trainer(calibrated=True, gains=lambda i: 1.2 if i % 2 else 0.8)
    t.settings = SMALL.changed(lr_appearance=0.03)
    t = Trainer(t.views, t.settings, "cpu", t.model)
    run_fit(t, hooks())
    gains = torch.diagonal(t.model.calibration(), dim1=1, dim2=2).mean(-1)
    odd = torch.tensor([v.index % 2 for v in t.views], dtype=torch.bool)
    assert float(gains[odd].mean() / gains[~odd].mean()) > 1.15


def test_divergence_is_told() -> None:
    t = trainer()
    with torch.no_grad():
        t.model.light.coefficients.fill_(float("nan"))
    with pytest.raises(StageError, match="diverged"):
        run_fit(t, hooks())


def test_a_draw_depends_on_its_seed_alone() -> None:
    table = PixelTable([ball_view(i) for i in range(3)], 64, "cpu")
    a, b, c = table.draw(64, 0.25, 1), table.draw(64, 0.25, 1), table.draw(64, 0.25, 2)
    assert torch.equal(a.rays.d, b.rays.d) and not torch.equal(a.rays.d, c.rays.d)
    assert int((a.alpha <= 0.5).sum()) == 16


@pytest.mark.parametrize("outside_share", [0.0, 0.25, 0.9])
def test_a_ray_stands_for_as_many_as_it_was_drawn_from(outside_share: float) -> None:
    """However many rays are drawn on either side, the weighted mean of alpha is that of all pixels in question."""
    table = PixelTable([ball_view(i) for i in range(3)], 64, "cpu")
    batch = table.draw(4000, outside_share, 0)
    out = batch.alpha <= 0.5
    pools = len(table.inside), len(table.outside)
    assert int(out.sum()) == int(4000 * outside_share) and float(batch.share.mean()) == pytest.approx(1, rel=1e-4)
    if outside_share:
        ratio = float(batch.share[out][0] / batch.share[~out][0])
        assert ratio == pytest.approx(pools[1] / pools[0] * (1 - outside_share) / outside_share, rel=1e-4)
        everyone = torch.cat([table.alpha[table.inside], table.alpha[table.outside]]).mean()
        assert float((batch.share * batch.alpha).mean()) == pytest.approx(float(everyone), rel=0.02)


@pytest.mark.parametrize(
    ("size", "side", "loose", "exact"),
    [
        ((1024, 1024), 512, 2, 2),
        ((640, 640), 512, 2, 2),
        ((512, 512), 512, 1, 1),
        ((997, 991), 512, 2, 1),
        ((1368, 770), 512, 3, 2),
        ((4, 4), 100, 1, 1),
    ],
)
def test_blocks(size: tuple[int, int], side: int, loose: int, exact: int) -> None:
    assert factor_for(size, side) == loose and factor_for(size, side, exact=True) == exact


def test_odd_sizes_lose_only_the_blocks_that_do_not_fill() -> None:
    v = ball_view(0)
    v = replace(v, rgb=v.rgb[:63, :61], alpha=v.alpha[:63, :61])
    table = PixelTable([v], 32, "cpu")
    blocks = v.alpha[:62, :60].reshape(31, 2, 30, 2).mean((1, 3))
    assert len(table.alpha) <= 31 * 30 and len(table.inside) == (blocks > 0.5).sum() > 100
    assert float(table.alpha[table.inside].sum()) == pytest.approx(float(blocks[blocks > 0.5].sum()), rel=1e-5)


def test_rays_undo_the_lens() -> None:
    """Points along a ray project back to the block's centre through OpenCV's own distortion."""
    view = ball_view(0)
    lens = np.array([-0.2, 0.05, 1e-3, -2e-3, 0.01])
    view = PhotoView(0, view.rgb, view.alpha, view.K, view.world_from_cam, lens)
    rays = image_rays(view, 2, "cpu")
    points = (rays.o + 0.5 * rays.d).double().numpy()
    cam_from_world = transforms.inverse_rigid(view.world_from_cam)
    rvec, _ = cv2.Rodrigues(cam_from_world[:3, :3])
    uv, _ = cv2.projectPoints(points, rvec, cam_from_world[:3, 3], transforms.centre_K_from_corner_K(view.K), lens)
    assert np.abs(uv[:, 0] + 0.5 - transforms.pixel_centres(SIDE, SIDE, 2)).max() < 2e-3


def test_what_lies_behind_an_edge_shows() -> None:
    """A ray that grazes a small ball before a large one: covered, in the render and for the mask's term."""
    from stages.inverse_rendering.ray_sampling import Rays
    from stages.inverse_rendering.render import render_rays, sample_shell, solid_behind

    lo, cell = -0.14, 0.005
    i = np.stack(np.meshgrid(*[np.arange(57)] * 3, indexing="ij"), -1)
    p = lo + cell * i
    values = np.minimum(
        np.linalg.norm(p - [0, 0, -0.06], axis=-1) - 0.06, np.linalg.norm(p - [0, 0, 0.08], axis=-1) - 0.03
    )
    start = Start(values.astype(np.float32), np.full(3, lo, np.float32), cell)
    t = new_trainer([ball_view(k) for k in range(3)], start, SMALL.changed(levels=1), False, "cpu")
    t.model.beta.fill_(0.002)
    x = torch.tensor([0.0292, 0.0292, 0.0, 0.065])
    o = torch.stack([x, torch.zeros(4), torch.full((4,), 0.5)], -1)
    o[1, 0], o[1, 1] = 0.0, 0.0292
    rays = Rays(o, torch.tensor([[0.0, 0, -1]]).expand(4, 3).contiguous())
    shell = sample_shell(t.model, rays, 16, None, torch.ones(4, dtype=torch.bool))
    behind = solid_behind(t.model, shell, rays)
    assert (shell.tau[:2] < 3.5).all() and (behind[:2] > 0).all() and behind[3] == 0
    _, opacity = render_rays(t.model, rays, 16)
    assert (opacity[:3] > 0.95).all() and opacity[3] < 0.2


def test_shading_every_sample_is_the_mean_of_the_samples(fitted: Trainer) -> None:
    """Against a plain loop over one ray's samples; and close to shading once, which the shell is thin enough for."""
    from stages.inverse_rendering.render import sample_shell, shade_shell

    model, rays = fitted.model, image_rays(ball_view(5), 1, "cpu")
    shell = sample_shell(model, rays, 8, None, None)
    pick = torch.nonzero(shell.hit).squeeze(-1)[::97]
    once = shade_shell(model, shell, rays, pick)
    model.spec = replace(model.spec, volumetric=True)
    try:
        every = shade_shell(model, shell, rays, pick)
    finally:
        model.spec = replace(model.spec, volumetric=False)
    i = int(pick[3])
    d = rays.d[shell.kept[i]]
    by_hand = torch.zeros(3)
    for s in range(8):
        g = shell.gradient[8 * i + s]
        at = rays.o[shell.kept[i]] + shell.t[i, s] * d
        by_hand += shell.share[i, s] * model.shade(at[None], (g / g.norm())[None], -d[None]).total[0]
    assert torch.allclose(every.total[3], by_hand, rtol=1e-4, atol=1e-6)
    assert float((every.total - once.total).abs().median()) < 0.01 * float(once.total.mean())


@pytest.mark.slow
def test_short_products_find_the_same_ball() -> None:
    """bfloat16 for the networks alone: finite, and the surface where float32 has it."""
    t = trainer(SMALL.changed(precision="bfloat16"))
    run_fit(t, hooks())
    d = torch.nn.functional.normalize(torch.randn(500, 3, generator=torch.Generator().manual_seed(0)), dim=-1)
    s = t.model.geometry(RADIUS * d[d[:, 1].abs() < 0.6])[0]
    assert t.guard.dropped == 0 and float(s.abs().mean()) < 0.0015
