"""A light that is known before the fit: from a file, from a stage's lamps, and what the fit makes of it."""

from __future__ import annotations

from dataclasses import replace
from pathlib import Path
from typing import Any

import numpy as np
import pytest
import torch
from pydantic import ValidationError
from scipy.spatial.transform import Rotation

from pipeline.artifacts import CameraSet
from pipeline.capture_artifacts import Capture, LightStage, StageLight
from pipeline.errors import UsageError
from pipeline.images import write_exr
from pipeline.maths.latlong import latlong_directions
from pipeline.maths.sh import irradiance
from pipeline.transforms import rows
from stages.inverse_rendering.config import Config
from stages.inverse_rendering.fit import Trainer
from stages.inverse_rendering.given_light import LEAST_SHARE, STAGE, GivenLight, given_light
from stages.inverse_rendering.initialise import new_trainer, put
from stages.inverse_rendering.judge import Fitted, choices
from stages.inverse_rendering.model_selection import given_model, select_model
from stages.inverse_rendering.paper.config import PaperConfig
from stages.inverse_rendering.training_loop import run_fit
from tests.support.light_stage import make_stage
from tests.support.small_ball import RADIUS, SMALL, ball_start, ball_view, hooks

TURN = Rotation.from_euler("xyz", [15, 70, -30], degrees=True).as_matrix()


def poses(source: str = "given", scale: float = 1.0, shift: tuple[float, ...] = (0, 0, 0)) -> CameraSet:
    world = np.eye(4)
    world[:3, :3], world[:3, 3] = scale * TURN, shift
    return CameraSet(source=source, metric=True, capture_from_asset=rows(world), roi_radius=0.2, cameras=())  # type: ignore[arg-type]


def env(folder: Path, towards: np.ndarray) -> Path:
    d = latlong_directions(128, 64)
    write_exr(folder / "env.exr", np.repeat(np.exp(20 * (d @ towards - 1))[..., None], 3, 2).astype(np.float32))
    return folder / "env.exr"


def main_direction(found: GivenLight) -> np.ndarray:
    c = found.coefficients[:4, 0]
    return c[[3, 1, 2]] / np.linalg.norm(c[1:])


def test_a_file_stands_in_the_captures_world(tmp_path: Path) -> None:
    axis = np.array([0.6, 0.0, 0.8])  # in asset coordinates
    config = Config(light_file=str(env(tmp_path, TURN @ axis)), light_order=3)
    found = given_light(Capture(kind="facescape", views=()), poses(scale=3.0), config)
    assert found is not None and found.coefficients.shape == (16, 3)
    assert found.source == "env.exr" and not found.scaled
    np.testing.assert_allclose(main_direction(found), axis, atol=2e-3)
    config = Config(light_file=str(env(tmp_path, axis)))  # of solved cameras it stands as the asset does
    found = given_light(Capture(kind="photos", views=()), poses("colmap"), config)
    assert found is not None and found.coefficients.shape == (121, 3)
    np.testing.assert_allclose(main_direction(found), axis, atol=2e-3)
    scaled = given_light(Capture(kind="photos", views=()), poses("colmap"), config.changed(light_scale=2.5))
    assert scaled is not None and scaled.scaled
    np.testing.assert_allclose(scaled.coefficients, 2.5 * found.coefficients)


def stage_of(centre: np.ndarray) -> LightStage:
    made = make_stage(1, 60)
    lights = tuple(
        StageLight(index=n, position=tuple(p + centre), axis=tuple(-p / 1.3), intensity=tuple(i), frame=n)
        for n, (p, i) in enumerate(zip(made.positions, made.intensities, strict=True))
    )
    return LightStage(lights=lights, frames=(), gain=0.25, share=0.8)


def test_a_stages_lamps_give_the_irradiance_at_its_centre() -> None:
    """Oracle: sum of g I n.l / (s d^2) over the lamps that a facet faces, by hand."""
    centre = np.array([0.3, -0.1, 0.2])
    stage = stage_of(centre)
    capture = Capture(kind="olat", views=(), stage=stage)
    found = given_light(capture, poses(scale=2.0, shift=tuple(centre)), Config(light_from="stage"))
    assert found is not None and found.scaled and found.source == STAGE
    n = np.random.default_rng(1).normal(size=(20, 3))
    n /= np.linalg.norm(n, axis=1, keepdims=True)
    expected = np.zeros((20, 3))
    for light in stage.lights:
        away = np.array(light.position) - centre
        distance = np.linalg.norm(away)
        cosine = np.maximum((n @ TURN.T) @ away / distance, 0)
        expected += 0.25 / 0.8 * cosine[:, None] * np.array(light.intensity) / distance**2
    made = irradiance(torch.from_numpy(found.coefficients), torch.from_numpy(n)).numpy()
    np.testing.assert_allclose(made, expected, rtol=0.02)  # SH of order 10 of a cosine


def test_a_stages_lamps_are_its_light_unless_they_are_too_few_or_it_is_said_otherwise() -> None:
    """The maps of the single lights have the level of the lamps: an estimated environment would have another one."""

    def found(share: float, **settings: Any) -> GivenLight | None:
        stage = stage_of(np.zeros(3)).model_copy(update={"share": share})
        return given_light(Capture(kind="olat", views=(), stage=stage), poses(), Config(**settings))

    assert (lamps := found(LEAST_SHARE)) is not None and lamps.source == STAGE and lamps.scaled
    assert found(LEAST_SHARE - 0.01) is None
    assert found(LEAST_SHARE - 0.01, light_from="stage") is not None
    assert found(1.0, light_from="lobe") is None
    assert found(1.0, light_frame="camera") is None


def test_where_there_is_nothing_to_take(tmp_path: Path) -> None:
    plain = Capture(kind="photos", views=())
    assert given_light(plain, poses(), Config()) is None
    assert (
        given_light(Capture(kind="olat", views=(), stage=stage_of(np.zeros(3))), poses(), Config(light_from="lobe"))
        is None
    )
    with pytest.raises(UsageError, match="no lamps"):
        given_light(plain, poses(), Config(light_from="stage"))
    path = str(env(tmp_path, np.eye(3)[2]))
    with pytest.raises(ValidationError, match="light_from must be auto"):
        Config(light_file=path, light_from="lobe")
    with pytest.raises(ValidationError, match="estimate the light"):
        PaperConfig(light_file=path)


def test_the_files_content_is_part_of_the_key_and_its_place_is_not(tmp_path: Path) -> None:
    first = Config(light_file=str(env(tmp_path, np.eye(3)[2]))).model_dump()
    (tmp_path / "other").mkdir()
    moved = Config(light_file=str(env(tmp_path / "other", np.eye(3)[2]))).model_dump()
    changed = Config(light_file=str(env(tmp_path, np.eye(3)[0]))).model_dump()
    assert first == moved and first != changed and "light_file" not in first


def of_the_ball(scaled: bool = True, factor: float = 1.0) -> GivenLight:
    """The light of tests.support.small_ball: E / pi = 0.7 + 0.3 n_y."""
    c = np.zeros((121, 3))
    c[0], c[1] = 0.7 * np.sqrt(4 * np.pi), 0.45 / np.sqrt(3 / (4 * np.pi))
    return GivenLight(factor * c, "env.exr", scaled)


def trainer(light: GivenLight) -> Trainer:
    views = [ball_view(i) for i in range(12) if i != 5]
    return new_trainer(views, ball_start(), SMALL.changed(light_order=10), False, "cpu", light=light)


def test_without_a_scale_the_light_is_as_bright_as_a_uniform_one_would_be() -> None:
    spec = trainer(of_the_ball()).model.spec
    c, albedo = put(of_the_ball(scaled=False, factor=123.0), replace(spec, albedo_start=(0.4, 0.3, 0.2)))
    assert c[0].mean() / np.sqrt(4 * np.pi) == pytest.approx(spec.light_start) and c[1, 0] / c[0, 0] > 0.3
    np.testing.assert_allclose(albedo, (0.4, 0.3, 0.2), rtol=1e-6)


def test_the_fit_keeps_a_given_light_and_finds_the_albedo_under_it() -> None:
    """Oracle: the ball's albedo itself, also its level, which an estimated light does not tell."""
    t = trainer(of_the_ball())
    before = t.model.light().detach().clone()
    run_fit(t, hooks())
    assert torch.equal(t.model.light().detach(), before) and not t.skin_asked
    x = RADIUS * torch.tensor([[0.6, 0.2, 0.77], [-0.6, 0.2, 0.77], [0.7, -0.3, -0.65], [-0.7, -0.3, -0.65]])
    with torch.no_grad():
        albedo = t.model.spatial(x)[0].numpy()
    red, blue = [0.6, 0.3, 0.3], [0.25, 0.3, 0.6]
    np.testing.assert_allclose(albedo, [red, blue, red, blue], atol=0.06)
    fact = t.choices.facts["light"] if t.choices else {}
    assert fact["from"] == "env.exr" and fact["why"] == "given" and fact["order"] == 10 and len(before) == 121
    none = Fitted((), None, None, (), {"light": fact})  # type: ignore[arg-type]
    assert [f.said for f in choices(none) if f.check == "light_given"] == [
        "the light is given (env.exr) and was not estimated"
    ]


def test_a_given_light_is_told_without_validation_views_too() -> None:
    t = trainer(of_the_ball())
    t.validation = ()
    found, estimate = select_model(t)
    assert estimate is None and found.light_known and found.facts["light"]["from"] == "env.exr"
    assert not given_model(SMALL, calibrated=False).light_known
