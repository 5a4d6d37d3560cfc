"""The model as a whole: files, shading, the parts' starting values."""

from __future__ import annotations

import zipfile
from pathlib import Path

import numpy as np
import pytest
import torch
from scipy import ndimage

from pipeline.errors import StageError
from pipeline.fields.appearance import TYPICAL_INV_KAPPA, IntegratedBasis
from pipeline.fields.calibration import Calibration
from pipeline.fields.face import FaceModel, FittedField, load_face, load_model
from pipeline.fields.geometry import GridSdf, coarse_distance
from pipeline.fields.light import ShLight
from pipeline.fields.spec import FaceSpec
from pipeline.maths import brdf

LO, CELL = torch.tensor([-0.2, -0.2, -0.2]), 0.02


def ball_model(seed: int = 0, **changes: object) -> FaceModel:
    torch.manual_seed(seed)
    i = torch.stack(torch.meshgrid(*[torch.arange(21)] * 3, indexing="ij"), -1)
    spec = FaceSpec(lo=(-0.2,) * 3, hi=(0.2,) * 3, views=4, hash_levels=4, hash_log2_size=10, hash_fine=0.01, **changes)  # type: ignore[arg-type]
    return FaceModel(spec, GridSdf((LO + CELL * i).norm(dim=-1) - 0.1, LO, CELL))


def sphere_points(n: int) -> torch.Tensor:
    g = torch.Generator().manual_seed(0)
    return torch.nn.functional.normalize(torch.randn(n, 3, generator=g), dim=-1)


@pytest.mark.parametrize("attenuation", ["exponential", "exact"])
def test_shading_is_the_sum_of_the_two_closed_forms(attenuation: str) -> None:
    model = ball_model(attenuation=attenuation)
    with torch.no_grad():
        model.light.coefficients.normal_(std=0.1)
        model.light.coefficients[0] = 4.0
    n = sphere_points(50)
    wo = torch.nn.functional.normalize(n + 0.5 * sphere_points(50).flip(0), dim=-1)
    found = model.shade(0.1 * n, n, wo)
    a, rho, c, s = model.spatial(0.1 * n)
    cb = (c * model.basis(wo, n)).sum(-1)
    diffuse = brdf.diffuse(a, n, model.light())
    specular = brdf.specular(rho, cb, brdf.light_integral(brdf.reflect(wo, n), s, model.light(), attenuation))
    assert torch.allclose(found.total, diffuse + specular) and torch.allclose(found.specular, specular)
    assert (found.specular > 0).any()


def test_shadows_darken_the_diffuse_part_alone() -> None:
    n = sphere_points(50)
    wo = torch.nn.functional.normalize(n + 0.5 * sphere_points(50).flip(0), dim=-1)
    model = ball_model(shadows=True)
    assert model.shadowing is not None
    free = model.shade(0.1 * n, n, wo)
    with torch.no_grad():
        model.shadowing.ratio[:] = torch.tensor([0.5, 0.25, 0.125])[:, None, None, None]
    dark = model.shade(0.1 * n, n, wo)
    assert torch.allclose(dark.diffuse, free.diffuse * torch.tensor([0.5, 0.25, 0.125]), rtol=1e-5)
    assert torch.equal(dark.specular, free.specular) and torch.allclose(dark.total, dark.diffuse + dark.specular)


def test_without_specular_nothing_depends_on_the_view() -> None:
    model = ball_model(specular=False)
    n = sphere_points(10)
    assert torch.equal(model.shade(0.1 * n, n, n).total, model.shade(0.1 * n, n, n.flip(0)).total)


def test_basis_is_positive_and_sees_what_it_should() -> None:
    n, wo = sphere_points(100), sphere_points(100).flip(0)
    turn = torch.linalg.qr(torch.randn(3, 3, generator=torch.Generator().manual_seed(1)))[0]
    for cosine_only in (True, False):
        torch.manual_seed(0)
        basis = IntegratedBasis(3, 16, 2, cosine_only)
        b, turned = basis(wo, n), basis(wo @ turn.T, n @ turn.T)
        assert b.min() >= 0 and b.shape == (100, 3)
        assert torch.allclose(b, turned, atol=1e-5) == cosine_only
        other = n - 2 * wo * (n * wo).sum(-1, keepdim=True)  # another normal at the same cosine (and its mirror image)
        assert torch.allclose(basis(wo, n), basis(wo, -other), atol=1e-5) == cosine_only
        assert torch.allclose(basis(n, wo), basis(-other, wo), atol=1e-5) == cosine_only


@pytest.mark.parametrize("views", [1, 5])
def test_calibration_is_the_identity_plus_what_differs_by_hand(views: int) -> None:
    """A_n = I + M_n - mean M, the network in float64: at the start, and with any weights. One photo alone has nothing
    to differ from, so that its colours stay whatever is learnt."""
    torch.manual_seed(0)
    c = Calibration(views)
    assert torch.equal(c(), torch.eye(3).expand(views, 3, 3))
    with torch.no_grad():
        for p in c.parameters():
            p.normal_()
    w0, b0, w1, b1 = (p.detach().double().numpy() for p in c.net.parameters())
    m = np.maximum(c.embedding.detach().double().numpy() @ w0.T + b0, 0) @ w1.T + b1
    by_hand = np.eye(3) + (m - m.mean(0)).reshape(-1, 3, 3)
    assert np.allclose(c().detach().numpy(), by_hand, atol=1e-4)
    assert (np.abs(by_hand - np.eye(3)).max() > 0.1) == (views > 1)


@pytest.mark.parametrize("refined", [False, True])
def test_file_round_trip(tmp_path: Path, refined: bool) -> None:
    model = ball_model(calibrated=True, attenuation="exact")
    if refined:
        model.geometry.refine()
    model.save(tmp_path / "field.npz")
    again = load_model(tmp_path / "field.npz")
    assert again.spec == model.spec and again.geometry.cell == model.geometry.cell
    for (name, a), (_, b) in zip(model.state_dict().items(), again.state_dict().items(), strict=True):
        assert torch.equal(a, b), name


def test_same_model_same_bytes(tmp_path: Path) -> None:
    for name in ("a.npz", "b.npz"):
        ball_model().save(tmp_path / name)
    assert (tmp_path / "a.npz").read_bytes() == (tmp_path / "b.npz").read_bytes()
    with zipfile.ZipFile(tmp_path / "a.npz") as file:
        assert {i.compress_type for i in file.infolist()} == {zipfile.ZIP_DEFLATED}


def test_foreign_format_is_refused(tmp_path: Path) -> None:
    ball_model().save(tmp_path / "field.npz")
    with np.load(tmp_path / "field.npz") as f:
        arrays = dict(f)
    arrays["spec"] = np.frombuffer(bytes(arrays["spec"]).replace(b'"format": 1', b'"format": 9'), np.uint8)
    np.savez(tmp_path / "other.npz", **arrays)
    with pytest.raises(StageError, match="format"):
        load_face(tmp_path / "other.npz")


def test_fitted_field_answers_in_arrays() -> None:
    field = FittedField(ball_model())
    p = (0.1 * sphere_points(300)).numpy()
    s, g = field.sdf_and_gradient(p)
    assert np.abs(s).max() < 0.003 and np.allclose(g, p / 0.1, atol=0.05)
    m = field.material(p)
    assert m.albedo.shape == (300, 3) and m.coefficients.shape == (300, 3) and (m.inv_kappa > 0).all()
    assert field.basis(p / 0.1, p / 0.1).shape == (300, 3) and field.light.shape == (121, 3)
    lo, hi = field.bounds
    assert (lo < -0.1).all() and (hi > 0.1).all() and field.cell == CELL


def test_a_surface_without_a_lobe_has_no_marks_in_its_lobe() -> None:
    p = (0.1 * sphere_points(300)).numpy()
    glossy, dull = (FittedField(ball_model(specular=on)).material(p) for on in (True, False))
    assert np.ptp(glossy.inv_kappa) > 0 and np.ptp(glossy.coefficients) > 0
    assert not dull.rho.any() and (dull.coefficients == 1).all() and np.allclose(dull.inv_kappa, TYPICAL_INV_KAPPA)
    assert np.array_equal(dull.albedo, glossy.albedo)


def test_refining_keeps_the_surface_and_cleans_the_volume() -> None:
    model = ball_model()
    with torch.no_grad():
        model.geometry.values[1:4, 1:4, 1:4] = -0.02  # a speck away from the ball
        model.geometry.values[9:12, 9:12, 9:12] = 0.02  # a hollow in its middle
    p = 0.1 * sphere_points(200)
    before = model.geometry(p)[0]
    model.geometry.refine()
    assert torch.allclose(model.geometry(p)[0], before, atol=1e-5)
    s, _ = model.geometry(torch.tensor([[-0.16, -0.16, -0.16], [0.0, 0, 0]]))
    assert s[0] > 0.05 and s[1] < -0.01


def test_what_enters_the_band_owes_nothing_to_the_past() -> None:
    """Gradients that reached a coefficient outside the band are forgotten, as they are by a checkpoint."""
    geometry = ball_model().geometry
    far = int(torch.argmax(geometry.values.detach()[1:-1, 1:-1, 1:-1].reshape(-1)))
    size = [n - 2 for n in geometry.shape]
    i, j, k = (int(v) + 1 for v in np.unravel_index(far, size))
    geometry.sink[i, j, k] = 1.0
    geometry.step(0.01)
    with torch.no_grad():
        geometry.values[i, j, k] = 0.0  # the surface comes near
    geometry.find_band()
    geometry.step(0.01)
    assert float(geometry.values.detach()[i, j, k]) == 0.0


def test_what_is_hardly_known_hardly_moves() -> None:
    """Noise of two sizes, a few coefficients with a thousandth of what the others get: a random walk as long as plain
    Adam's would be is cut by a thousand, while a steady pull on the others is followed as before but for one half."""
    geometry = ball_model().geometry
    start = geometry.values.detach().clone()
    faint, firm = geometry.active[:40], geometry.active[40:]
    torch.manual_seed(0)
    for _ in range(60):
        sink = geometry.sink.view(-1)
        sink[faint] = 1e-6 * torch.randn(len(faint))
        sink[firm] = 1e-3
        geometry.step(1e-4)
    moved = (geometry.values.detach() - start).view(-1)
    assert geometry.typical == pytest.approx(1e-3, rel=0.05)
    assert float(moved[faint].abs().max()) < 1e-5
    assert torch.allclose(moved[firm], torch.full((len(firm),), -3e-3), rtol=0.1)
    saved = geometry.optimiser_state()
    other = ball_model().geometry
    other.load_optimiser_state(saved)
    assert other.typical == geometry.typical


@pytest.mark.parametrize("shape", [(24, 24, 24), (25, 22, 27)])
def test_coarse_distance_is_never_too_long(shape: tuple[int, int, int]) -> None:
    rng = np.random.default_rng(0)
    free = np.ones(shape, bool)
    free[tuple(rng.integers(0, n, 6) for n in shape)] = False
    true = ndimage.distance_transform_edt(free)
    found = coarse_distance(free)
    assert found.shape == free.shape and found.min() == 0.5
    assert (found <= np.maximum(true, 0.5) + 1e-5).all() and (found >= true - 4).all()


def test_while_the_light_learns_alone_its_gradient_is_white_and_of_low_order() -> None:
    light = ShLight(4, 1.0)
    gradient = torch.randn(25, 3, generator=torch.Generator().manual_seed(3))
    light.coefficients.grad = gradient.clone()
    light.uniform_gradient(2)
    found = light.coefficients.grad
    assert torch.allclose(found[:9], gradient[:9].mean(1, keepdim=True).expand(9, 3))
    assert (found[:9] != 0).all() and not found[9:].any()
    light.coefficients.grad = None
    light.uniform_gradient(2)  # nothing was learnt: nothing to restrict
    assert light.coefficients.grad is None
