"""The systems that the paper is compared with, on a ball whose every property is known."""

from __future__ import annotations

from pathlib import Path
from typing import Any

import numpy as np
import pytest
import torch

from pipeline.errors import StageError
from pipeline.fields.face import FaceModel, FittedField, load_model
from stages.inverse_rendering.config import Config
from stages.inverse_rendering.paper.comparison import new_compared_trainer, sphere_start
from stages.inverse_rendering.paper.config import PaperConfig
from stages.inverse_rendering.training_loop import run_fit
from tests.support.small_ball import RADIUS, SMALL, ball_start, ball_view, hooks

COMPARED = PaperConfig(**{**SMALL.model_dump(), "preset": "comparison"})


SYSTEMS: dict[str, dict[str, Any]] = {
    "phong": {"shading": "phong", "attenuation": "phong"},
    "disney": {"shading": "disney", "light": "cubemap"},
    "disney under harmonics": {"shading": "disney"},
    "cubemap": {"light": "cubemap"},
    "direct": {"integral": "direct"},
    "feature": {"integral": "feature"},
    "k = 8": {"rank": 8},
    "the bases' inputs of the paper": {"basis_inputs": "paper", "basis_width": 32},
}


@pytest.mark.slow
@pytest.mark.parametrize("name", SYSTEMS)
def test_every_system_fits_saves_and_loads(name: str, tmp_path: Path) -> None:
    """One code, other settings: each learns the ball, every parameter of it moves, and its file gives it back."""
    views = [ball_view(i) for i in range(0, 12, 2)]
    t = new_compared_trainer(
        views, ball_start(), COMPARED.changed(steps=40, batch=512, levels=1, **SYSTEMS[name]), True, "cpu"
    )
    t.advance()
    first = t.error
    before = {n: p.detach().clone() for n, p in t.model.named_parameters()}
    run_fit(t, hooks())
    assert t.error < first and t.guard.dropped == 0
    idle = ("calibration", "geometry")
    unused = {"phong": ("basis",), "disney": ("basis",), "disney under harmonics": ("basis",)}.get(name, ())
    still = [n for n, p in t.model.named_parameters() if torch.equal(p, before[n])]
    assert [n for n in still if not n.startswith((*idle, *unused))] == []
    t.model.save(tmp_path / "field.npz")
    again = load_model(tmp_path / "field.npz")
    n = torch.nn.functional.normalize(torch.randn(30, 3), dim=-1)
    assert torch.equal(t.model.shade(RADIUS * n, n, n).total, again.shade(RADIUS * n, n, n).total)
    field = FittedField(again)
    if name in ("direct", "feature", "disney", "disney under harmonics"):
        with pytest.raises(StageError, match="no specular bases"):
            field.basis(n.numpy(), n.numpy())
    else:
        b, m = field.basis(n.numpy(), n.numpy()), field.material(RADIUS * n.numpy())
        assert b.shape == m.coefficients.shape == (30, field.rank)


def model_of(**changes: Any) -> FaceModel:
    return new_compared_trainer([ball_view(0)], ball_start(), COMPARED.changed(**changes), False, "cpu").model


def test_disney_splits_energy_by_metal() -> None:
    """A metal has no diffuse part, a dielectric reflects at least 4 % of an even light along the normal."""
    model = model_of(shading="disney")
    n = torch.nn.functional.normalize(torch.randn(20, 3), dim=-1)
    last = model.spatial.net[-1]
    assert isinstance(last, torch.nn.Linear)
    with torch.no_grad():
        model.light.coefficients.zero_()
        model.light.coefficients[0] = (4 * torch.pi) ** 0.5
        for bias, metal in ((-30.0, False), (30.0, True)):
            last.weight[3], last.bias[3] = 0, bias
            got = model.shade(RADIUS * n, n, n)
            if metal:
                assert got.diffuse.abs().max() < 1e-6 and torch.allclose(got.specular, 0.35 + 0 * n, atol=0.12)
            else:
                assert torch.allclose(got.specular, 0.036 + 0 * n, atol=0.006)
            assert got.total.max() <= 1 + 1e-5


def test_phong_is_one_lobe_times_rho() -> None:
    model = model_of(shading="phong", attenuation="phong")
    n = torch.nn.functional.normalize(torch.randn(20, 3), dim=-1)
    got = model.shade(RADIUS * n, n, n)
    _, rho, _, _ = model.spatial(RADIUS * n)
    even = float(model.light.coefficients[0, 0].detach()) / (4 * torch.pi) ** 0.5
    assert torch.allclose(got.specular, (rho * even)[:, None].expand(-1, 3), rtol=1e-4)


def test_without_a_prior_the_grid_starts_as_a_sphere() -> None:
    start = sphere_start(0.2, 48, 2)
    i = np.stack(np.meshgrid(*[np.arange(n) for n in start.values.shape], indexing="ij"), -1)
    x = start.lo + start.cell * i
    assert np.allclose(start.values, np.linalg.norm(x, axis=-1) - 0.12, atol=1e-6)
    assert start.lo.max() < -0.2 and start.cell == pytest.approx(0.4 / 48 * 2)


@pytest.mark.parametrize(
    ("values", "message"),
    [
        ({"preset": "paper", "refine_geometry": "off"}, "refine_geometry = off"),
        ({"preset": "paper", "seconds": 10.0}, "seconds needs"),
        ({"preset": "comparison", "appearance": "sinusoidal"}, "needs method paper"),
        ({"preset": "comparison", "prior": "sphere", "stereo": True}, "needs prior hull"),
        ({"preset": "comparison", "prior": "sphere", "resolution": "auto"}, "resolution = auto"),
    ],
)
def test_settings_that_only_one_method_knows_are_refused(values: dict[str, Any], message: str) -> None:
    with pytest.raises(ValueError, match=message):
        PaperConfig(**values)


def test_the_comparison_is_our_own_fit_with_other_settings_for_its_parts() -> None:
    """Without a setting of its own it has the values of the draft; each part that differs from ours is refused by the
    model selection."""
    ours, compared = Config(prior="hull"), PaperConfig(preset="comparison")
    assert {k: v for k, v in compared.model_dump().items() if k in Config.model_fields and k != "preset"} == {
        k: v for k, v in ours.model_dump().items() if k != "preset"
    }
    assert ours.has_open_parts and ours.estimates_light and compared.has_open_parts and compared.estimates_light
    for part in ({"shading": "phong"}, {"light": "cubemap"}, {"integral": "direct"}, {"method": "paper"}):
        other = PaperConfig(preset="comparison", **part)
        assert not other.has_open_parts and not other.estimates_light, part
    other = PaperConfig(preset="comparison", basis_inputs="paper")
    assert other.has_open_parts and not other.estimates_light
    sphere = PaperConfig(preset="comparison", prior="sphere")
    assert sphere.stereo == "off" and sphere.resolution == "given"
