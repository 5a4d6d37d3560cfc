"""The comparison of material and light: the truth's parts against closed forms, the model's against known ones."""

from __future__ import annotations

import json
import math
from pathlib import Path

import numpy as np
import pytest
import torch

from pipeline.demo import head, light, skin
from pipeline.maths import microfacet, sh
from tests.fields.test_face import ball_model
from workflows.evaluation import demo_material as tm


@pytest.fixture
def folder(tmp_path: Path) -> Path:
    (tmp_path / "truth").mkdir()
    about = {"coefficients": light.studio_coefficients(0.5).tolist()}
    (tmp_path / "truth" / "light.json").write_text(json.dumps(about))
    (tmp_path / "demo.json").write_text(json.dumps({"seed": 0}))
    return tmp_path


def on_the_head(n: int = 60) -> tuple[np.ndarray, np.ndarray]:
    """Points and normals of the demo's surface, by Newton steps from a sphere."""
    d = np.random.default_rng(0).normal(size=(n, 3))
    p = 0.11 * d / np.linalg.norm(d, axis=1, keepdims=True)
    for _ in range(30):
        s, g = head.distance_and_gradient(p)
        p = p - (s / (g * g).sum(1))[:, None] * g
    s, g = head.distance_and_gradient(p)
    near = np.abs(s) < 1e-5
    return p[near], (g / np.linalg.norm(g, axis=1, keepdims=True))[near]


def test_the_truths_parts(folder: Path) -> None:
    """Diffuse is albedo / pi times the irradiance of the coefficients, by code that the demo does not share."""
    p, n = on_the_head()
    assert len(p) > 30
    looks = tm.true_looks(folder, p, n, n)
    c = torch.from_numpy(light.studio_coefficients(0.5))
    expected = looks.albedo / math.pi * sh.irradiance(c, torch.from_numpy(n)).numpy()
    off = np.abs(looks.diffuse - expected) / expected.mean()
    assert off.mean() < 0.005 and off.max() < 0.06
    assert np.array_equal(looks.f0, skin.material(p, 0).f0)
    assert (looks.specular > 0).all() and 0.03 < looks.specular.mean() / looks.diffuse.mean() < 0.4


def test_the_models_parts() -> None:
    """Seen in a capture that is turned, moved and scaled: the nearest surface, the same view, F0 and roughness."""
    model = ball_model()
    turn = np.linalg.qr(np.random.default_rng(1).normal(size=(3, 3)))[0]
    turn *= np.sign(np.linalg.det(turn))
    place = np.eye(4)
    place[:3, :3], place[:3, 3] = 2.0 * turn, [0.3, -1, 2]
    n = torch.nn.functional.normalize(torch.randn(40, 3, generator=torch.Generator().manual_seed(0)), dim=-1)
    wo = torch.nn.functional.normalize(n + 0.4 * n.flip(0), dim=-1)
    off = 0.103 * n.double().numpy()  # 3 mm outside
    found = tm.fitted_looks(model, off @ place[:3, :3].T + place[:3, 3], wo.double().numpy() @ turn.T, place)
    with torch.no_grad():
        own = model.shade(0.1 * n, n, wo)
        _, rho, c, s = model.spatial(0.1 * n)
        strength = rho * (c * model.basis(n, n)).sum(-1)
    assert np.allclose(found.diffuse, own.diffuse.numpy(), rtol=0.02, atol=1e-3)
    assert np.allclose(found.specular, own.specular.numpy(), rtol=0.05, atol=1e-3)
    assert np.allclose(found.f0, microfacet.f0_from_lobe(strength.numpy(), s.numpy()), rtol=0.02)
    assert np.allclose(found.roughness, microfacet.roughness_from_inv_kappa(s.numpy()), rtol=0.02)


def test_agreement() -> None:
    a = np.array([1.0, 2.0, 3.0])
    found = tm.agreement(2 * a, a)
    assert found.correlation == pytest.approx(1) and found.error == 2 and (found.found_mean, found.true_mean) == (4, 2)
    assert tm.agreement(-a, a).correlation == pytest.approx(-1)
    assert math.isnan(tm.agreement(np.ones(3), a).correlation)


def test_the_gauge_is_one_gain(folder: Path) -> None:
    """The true light times k, with albedo over k, scores as the truth itself."""
    model = ball_model()
    c = torch.from_numpy(light.studio_coefficients(0.5)).float()
    for k in (1.0, 1.7):
        with torch.no_grad():
            model.light.coefficients.copy_(k * c)
        whole, low, error = tm._lights(model, folder, np.eye(4), k)
        assert whole == pytest.approx(1, abs=1e-5) and low == pytest.approx(1, abs=1e-5) and error < 1e-5
    turn = np.diag([1.0, -1, -1, 1])
    with torch.no_grad():
        model.light.coefficients.copy_(c)
    assert tm._lights(model, folder, turn, 1.0)[0] < 0.9, "the frame of the capture is not looked at"


def test_figures_and_lines() -> None:
    rng = np.random.default_rng(0)
    true = tm.Looks(*(rng.uniform(0.1, 0.9, s) for s in ((50, 3), (50,), (50,), (50, 3), (50, 3))))
    mine = tm.Looks(true.albedo / 1.25, true.f0, true.roughness, true.diffuse, true.specular)
    figures = tm._figures(mine, true, 1.25, 0.9, 0.95, 0.1)
    assert figures.albedo.correlation == pytest.approx(1) and figures.albedo.error < 1e-12
    assert figures.specular_share == pytest.approx(figures.true_specular_share)
    text = "\n".join(figures.lines())
    assert "albedo: correlation 1.000" in text and "specular share" in text and "gain 1.250" in text


def test_exported_maps_are_read_at_the_nearest_vertex() -> None:
    """Maps whose value is their own u and v, against the vertices' texture coordinates."""
    from tests.support.render_stand_ins import asset
    from workflows.evaluation.demo_maps import at_points

    u, v = np.meshgrid((np.arange(256) + 0.5) / 256, 1 - (np.arange(256) + 0.5) / 256)
    maps = {"f0": u[..., None].astype(np.float32), "roughness": v[..., None].astype(np.float32)}
    shown = asset(**maps)
    mesh = shown.mesh
    uv = np.zeros((len(mesh.vertices), 2))
    uv[mesh.faces] = mesh.uvs[mesh.uv_faces]
    near = mesh.vertices.astype(np.float64) * (1 + 1e-6)
    f0, roughness = at_points(shown, near)
    inside = ((uv > 0.01) & (uv < 0.99)).all(1)
    assert inside.any() and np.allclose(f0[inside], uv[inside, 0], atol=1e-3)
    assert np.allclose(roughness[inside], uv[inside, 1], atol=1e-3)
