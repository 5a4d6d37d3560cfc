"""The whole pipeline, every stage real, on a small demo capture: the asset, what runs again, what SIGKILL leaves."""

from __future__ import annotations

import json
import shutil
import subprocess
import sys
from pathlib import Path

import pytest

from pipeline.artifacts import Capture, Located
from pipeline.demo.capture import write_demo_capture
from tests.support.points import PATIENCE, kill

pytestmark = pytest.mark.slow

SMALL = {
    "inverse_rendering.steps": 240,
    "inverse_rendering.batch": 1024,
    "inverse_rendering.grid_cells": 72,
    "inverse_rendering.levels": 2,
    "inverse_rendering.hash_log2_size": 14,
    "inverse_rendering.hash_fine": 0.003,
    "surface.resolution": 96,
    "uv.target_faces": 3000,
    "uv.proxy_faces": 800,
    "bake.size": 256,
    "usd.preview_size": 128,
}
STAGES = ["capture", "poses", "masks", "inverse_rendering", "surface", "uv", "bake", "usd", "report"]


@pytest.fixture(scope="module")
def capture(tmp_path_factory: pytest.TempPathFactory) -> Path:
    folder = tmp_path_factory.mktemp("demo") / "capture"
    write_demo_capture(folder, views=16, size=96, samples=8, mesh_step=0.003)
    return folder


def start(
    environment: dict[str, str], capture: Path, out: Path, program: str = "workflows.cli", **changes: object
) -> subprocess.Popen[bytes]:
    sets = [f"--set={k}={v}" for k, v in {**SMALL, **changes}.items()]
    command = [sys.executable, "-m", program, "run", str(capture), "--out", str(out), "--preset", "draft"]
    return subprocess.Popen(
        [*command, "--holdout", "every:5:2", *sets],
        env=environment,
        stdout=subprocess.DEVNULL,
        stderr=subprocess.PIPE,
        start_new_session=True,
    )


def run(environment: dict[str, str], capture: Path, out: Path, **changes: object) -> dict[str, object]:
    child = start(environment, capture, out, **changes)
    _, err = child.communicate(timeout=PATIENCE)
    assert child.returncode == 0, err.decode()
    record: dict[str, object] = json.loads((out / "run.json").read_text())
    return record


def again(record: dict[str, object]) -> list[str]:
    """The stages that were made and not reused."""
    stages = record["stages"]
    assert isinstance(stages, dict)
    return [s for s in STAGES if not stages[s]["reused"]]


@pytest.fixture(scope="module")
def done(capture: Path, child_environment: dict[str, str], tmp_path_factory: pytest.TempPathFactory) -> Path:
    """A run that nothing disturbs, and that compiles every kernel anew, as the first run on a machine does."""
    out = tmp_path_factory.mktemp("undisturbed") / "out"
    run({**child_environment, "NUMBA_CACHE_DIR": str(tmp_path_factory.mktemp("kernels"))}, capture, out)
    shutil.copy(out / "run.json", out.parent / "undisturbed.json")  # other tests run into this folder again
    return out


def test_the_asset_is_valid_and_close_to_the_truth(done: Path, capture: Path) -> None:
    from stages.usd.check.validate import validate
    from workflows.evaluation.demo import measure

    assert not [f for f in validate(done / "asset/head.usd") if f.level == "error"]
    record = json.loads((done / "run.json").read_text())
    folder = done / ".store/capture" / record["stages"]["capture"]["key"]
    manifest = Capture.model_validate_json((folder / "manifest.json").read_bytes())
    figures = measure(done, capture, Located(manifest, folder).artifact)
    assert figures.psnr > 24 and figures.psnr_asset > 22
    assert figures.accuracy_median < 2.5 and figures.completeness_mean < 5


def test_everything_promised_is_there(done: Path) -> None:
    promised = ["asset/lookdev.usda", "asset/head.usdz", "asset/environment.exr", "asset/light.json", "run.json"]
    promised += ["report/index.html", "report/metrics.json", "report/views/2.exr", "report/asset_views/2.exr"]
    maps = ["albedo.exr", "albedo.png", "specular_coefficients.exr", "shininess.exr", "inv_kappa.exr", "normal.png"]
    promised += [f"asset/textures/head_{m}" for m in [*maps, "specular_intensity.exr", "basis_lut.exr", "f0.exr"]]
    assert [p for p in promised if not (done / p).is_file()] == []
    page = (done / "report/index.html").read_text()
    assert "http://" not in page.replace("http://www.w3.org", "") and "https://" not in page


def test_only_what_depends_on_a_setting_runs_again(
    done: Path, capture: Path, child_environment: dict[str, str]
) -> None:
    assert again(run(child_environment, capture, done)) == []
    changed = run(child_environment, capture, done, **{"bake.size": 320})
    assert again(changed) == ["bake", "usd", "report"]


def test_a_changed_photo_runs_everything_again(
    done: Path, capture: Path, child_environment: dict[str, str], tmp_path: Path
) -> None:
    """Up to the masks, which is where the chain that follows is seen to begin anew."""
    copy = tmp_path / "capture"
    shutil.copytree(capture, copy)
    shutil.copy(copy / "1.png", copy / "0.png")
    command = [sys.executable, "-m", "workflows.cli", "run", str(copy), "--out", str(tmp_path / "out")]
    command += ["--holdout", "every:5:2", "--until", "poses", "--store", str(done / ".store")]
    subprocess.run(command, env=child_environment, check=True, capture_output=True, timeout=PATIENCE)
    before, after = (len(list((done / ".store" / s).glob("*[0-9a-f]"))) for s in ("masks", "capture"))
    assert (before, after) == (1, 2)


@pytest.fixture(scope="module")
def killed(capture: Path, child_environment: dict[str, str], tmp_path_factory: pytest.TempPathFactory) -> Path:
    """SIGKILL to the whole process group: after the first stage, after the fit's 20th checkpoint, after the UVs."""
    out = tmp_path_factory.mktemp("killed") / "out"
    for name, sign in (
        ("capture.end", "capture/*"),
        ("fit.checkpoint@20", "inverse_rendering/*.scratch/checkpoint.pt"),
        ("uv.end", "uv/*"),
    ):
        point = kill(name, out.parent / name)
        child = start({**child_environment, **point.environment()}, capture, out, "tests.support.points")
        said = child.communicate(timeout=PATIENCE)
        assert child.returncode == -9 and point.reached() == [child.pid], said
        assert list((out / ".store").glob(sign))
        assert not (out / "asset").exists()
        finished = [p for p in (out / ".store").glob("*/*") if p.is_dir() and len(p.name) == 64]
        assert all((p / "manifest.json").is_file() for p in finished)
    run(child_environment, capture, out)
    return out


def manifest(record: Path, out: Path, stage: str) -> str:
    """The manifest that a run left of a stage."""
    key = json.loads(record.read_text())["stages"][stage]["key"]
    return (out / ".store" / stage / key / "manifest.json").read_text()


def test_a_run_killed_three_times_ends_in_a_valid_asset(done: Path, killed: Path) -> None:
    from stages.usd.check.validate import validate

    assert not [f for f in validate(killed / "asset/head.usd") if f.level == "error"]
    assert not list((killed / ".store").glob("*/*.partial-*"))


def test_a_run_killed_three_times_has_the_same_asset(done: Path, killed: Path) -> None:
    """Every stage from the photos to the asset, bit by bit."""
    for stage in STAGES[:-1]:
        before = manifest(done.parent / "undisturbed.json", done, stage)
        assert before == manifest(killed / "run.json", killed, stage), stage
