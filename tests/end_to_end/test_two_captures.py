"""Two captures of the demo's head under two lights, as `neuface run A --also B` has them: through every stage before
the end of the fit, a second time from the store, and with a capture of something else."""

from __future__ import annotations

from pathlib import Path
from typing import Any

import numpy as np
import pytest

from pipeline.artifacts import FittedFace
from pipeline.contract import Done
from pipeline.demo import light
from pipeline.demo.capture import write_demo_capture
from pipeline.errors import StageError
from pipeline.fields.face import load_face
from tests.support.textured_ball import camera_on_orbit, write_facescape
from workflows.run.plan import make_plan
from workflows.run.request import RunRequest
from workflows.run.runner import run_stages

pytestmark = pytest.mark.slow
SETS = (
    "inverse_rendering.steps=60", "inverse_rendering.image_side=96", "inverse_rendering.grid_cells=64",
    "inverse_rendering.batch=512", "inverse_rendering.stereo=sweep", "inverse_rendering.hash_log2_size=14",
)  # fmt: skip


@pytest.fixture(scope="module")
def heads(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """a and b: the head under the studio's light, and under its mirror image, warmer."""
    folder = tmp_path_factory.mktemp("two")
    write_demo_capture(folder / "a", views=16, size=96, samples=4, mesh_step=0.003)
    usual = light.studio_coefficients
    with pytest.MonkeyPatch.context() as patch:
        n = np.array([[0.3, 0.5, 0.8], [-0.7, 0.1, 0.7], [0.6, -0.6, 0.5], [0.2, 0.9, -0.4]])
        left, right = (light.real_basis(x / np.linalg.norm(x, axis=1, keepdims=True)) for x in (n, n * [-1, 1, 1]))
        mirrored = np.where(np.abs(left + right).max(0) < np.abs(left - right).max(0), -1.0, 1.0)
        colour = np.array([1.1, 1.0, 0.8])
        patch.setattr(light, "studio_coefficients", lambda e: usual(e) * mirrored[:, None] * colour)
        write_demo_capture(folder / "b", views=16, size=96, samples=4, mesh_step=0.003)
    return folder


def run(folder: Path, also: str | None, **changes: Any) -> list[Done[Any]]:
    request = RunRequest(
        capture=str(folder / "a"),
        also=None if also is None else str(folder / also),
        out=str(folder / "out"),
        holdout="every:5:2",
        device="cpu",
        sets=SETS,
        until="inverse_rendering",
        force=True,
        **changes,
    )
    return run_stages(make_plan(request))


def test_both_captures_are_fitted_and_the_store_has_all_of_it(heads: Path) -> None:
    done = run(heads, "b")
    placed, fitted = done[-2].located.artifact, done[-1].located
    assert placed.source == "the common world" and placed.agreement > 0.97
    assert np.allclose(placed.first_from_second, np.eye(4), atol=0.02)  # each is centred by itself
    face: FittedFace = fitted.artifact
    assert face.second is not None and len(face.second.held_out) == 3 == len(face.held_out)
    assert len(face.second.photos) == 13 == len(face.photos) and {p.index for p in face.photos} == set(
        face.fitted_views
    )
    assert face.second.psnr_held_out is not None and face.second.psnr_held_out > 18
    assert face.model["second_capture"]["psnr_held_out"] == face.second.psnr_held_out
    for view in face.second.held_out:
        assert fitted.path(view.exr).is_file()
    field = load_face(fitted.path(face.field))
    assert field.model.second is None and len(field.colour_responses) == 13  # type: ignore[arg-type]
    again = run(heads, "b")
    assert all(d.reused for d in again) and [d.key for d in again] == [d.key for d in done]
    alone = run(heads, None)
    assert [d.reused for d in alone] == [True, True, True, False] and alone[-1].located.artifact.second is None
    assert "second" not in alone[-1].located.artifact.canonical_json()


def test_a_capture_of_something_else_is_refused_before_the_fit(heads: Path) -> None:
    K = np.array([[200.0, 0, 48], [0, 200, 48], [0, 0, 1]])
    poses = [camera_on_orbit(45 * i, 20 * (i % 2), 0.6, np.zeros(3)) for i in range(8)]
    write_facescape(heads / "ball", poses, K, (96, 96))
    with pytest.raises(StageError, match="do not show the same subject") as said:
        run(heads, "ball")
    assert "--also" in str(said.value) and "0.93" in str(said.value)
