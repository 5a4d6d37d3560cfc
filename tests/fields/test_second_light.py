"""A model under two lights is, for either capture, that of its light alone; files of one capture are as ever."""

from __future__ import annotations

import json
from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest
import torch

from pipeline.fields.calibration import Calibration
from pipeline.fields.face import FaceModel, load_model
from pipeline.fields.spec import OF_SECOND, FaceSpec
from pipeline.maths.light_frame import Stations
from tests.fields.test_face import ball_model, sphere_points


def both(seed: int = 0, **changes: object) -> FaceModel:
    model = ball_model(seed, second_views=3, second_light_start=(0.5, 1.0, 2.0), **changes)
    assert model.second is not None
    with torch.no_grad():
        for light in (model.light, model.second.light):
            light.coefficients.add_(torch.randn(light.coefficients.shape) * 0.1)  # type: ignore[union-attr, operator, arg-type]
        if model.second.shadowing is not None:
            model.second.shadowing.ratio[:] = 0.5
    return model


@pytest.mark.parametrize("changes", [{}, {"specular": False}, {"shadows": True}])
def test_each_ray_is_shaded_under_the_light_of_its_capture(changes: dict[str, object]) -> None:
    model = both(**changes)
    n = sphere_points(60)
    wo = torch.nn.functional.normalize(n + 0.5 * sphere_points(60).flip(0), dim=-1)
    second = torch.arange(60) % 3 == 0
    found = model.shade(0.1 * n, n, wo, Stations(2 * wo, torch.eye(3).expand(60, 3, 3), second))
    one, other = (model.of_light(second=flag).shade(0.1 * n, n, wo) for flag in (False, True))
    for name in ("total", "diffuse", "specular", "albedo"):
        wanted = torch.where(second[:, None], getattr(other, name), getattr(one, name))
        assert torch.equal(getattr(found, name), wanted), name
    assert not torch.allclose(one.total, other.total, rtol=1e-2)


def test_without_a_capture_named_the_light_is_the_first() -> None:
    model, n = both(), sphere_points(10)
    assert torch.equal(model.shade(0.1 * n, n, n).total, model.of_light(second=False).shade(0.1 * n, n, n).total)


def test_a_model_of_one_light_has_a_file_like_any_other(tmp_path: Path) -> None:
    model = both(shadows=True)
    for flag, views in ((False, 4), (True, 3)):
        one = model.of_light(second=flag)
        one.save(tmp_path / "one.npz")
        read = load_model(tmp_path / "one.npz")
        n = sphere_points(10)
        assert torch.equal(read.shade(0.1 * n, n, n).total, one.shade(0.1 * n, n, n).total)
        assert read.spec.views == views == len(read.calibration()) and read.second is None
        plain = ball_model(shadows=True)
        assert read.state_dict().keys() == plain.state_dict().keys()
    assert torch.equal(model.light(), model.of_light(second=False).light())  # a copy was taken apart


def test_the_file_of_one_capture_does_not_know_of_a_second(tmp_path: Path) -> None:
    ball_model().save(tmp_path / "f.npz")
    with np.load(tmp_path / "f.npz") as file:
        spec = json.loads(bytes(file["spec"]).decode())
        assert not [k for k in (*spec, *file.files) if k in OF_SECOND or "second" in k]
    two = replace(ball_model().spec, second_views=2, second_light_start=(1.0, 2.0, 3.0))
    assert FaceSpec.from_stored(json.loads(json.dumps(two.stored()))) == two


def test_the_colours_of_each_capture_have_a_mean_of_their_own() -> None:
    torch.manual_seed(0)
    found = Calibration(4, 3, (True, True))
    torch.nn.init.normal_(found.net[-1].weight, std=0.3)  # type: ignore[arg-type]
    eye = torch.eye(3)
    assert torch.allclose(found()[:4].mean(0), eye, atol=1e-6) and torch.allclose(found()[4:].mean(0), eye, atol=1e-6)
    assert not torch.allclose(found()[0], eye, atol=1e-3)
    for second, rows in ((False, slice(4)), (True, slice(4, None))):
        assert torch.allclose(found.of(second)(), found()[rows], atol=1e-6)
    found.own = (False, True)
    assert torch.equal(found()[:4], eye.expand(4, 3, 3)) and torch.equal(found.of(False)(), eye.expand(4, 3, 3))
    assert not torch.allclose(found()[4], eye, atol=1e-3)
