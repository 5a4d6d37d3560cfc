"""The fit on a ball whose every property is known, its checkpoints, and the tables that feed it."""

from __future__ import annotations

from dataclasses import replace
from pathlib import Path

import cv2
import numpy as np
import pytest
import torch

from pipeline import transforms
from pipeline.errors import Cancelled, StageError
from stages.inverse_rendering.fit import Trainer
from stages.inverse_rendering.initial_geometry import Start
from stages.inverse_rendering.initialise import new_trainer
from stages.inverse_rendering.outputs import predict_view
from stages.inverse_rendering.ray_sampling import PhotoView, PixelTable, factor_for, image_rays
from stages.inverse_rendering.training_loop import run_fit
from tests.support.small_ball import RADIUS, SIDE, SMALL, ball_view, fit_of_the_ball, hooks, trainer
from tests.support.spread import made_once


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
    """It is Lambertian, its photos are of one camera, and it began 8 mm too large."""
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
    from pipeline.fields.paper.rendering import EverySample
    from stages.inverse_rendering.render import sample_shell, shade_shell

    model, rays = fitted.model, image_rays(ball_view(5), 1, "cpu")
    shell = sample_shell(model, rays, 8, None, None)
    pick = torch.nonzero(shell.hit).squeeze(-1)[::97]
    once = shade_shell(model, shell, rays, pick)
    ours, model.rendering = model.rendering, EverySample(model.rendering)
    try:
        every = shade_shell(model, shell, rays, pick)
    finally:
        model.rendering = ours
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
