"""`neuface validate` and `neuface render` on an exported asset."""

from __future__ import annotations

import json
import sys
from pathlib import Path

import numpy as np
import pytest

sys.path.insert(0, str(Path(__file__).resolve().parents[1]))

from support.synthetic_asset import write_inputs  # noqa: E402

from pipeline.contract import Context  # noqa: E402
from pipeline.images import read_exr, write_exr  # noqa: E402
from workflows.cli.main import main  # noqa: E402


@pytest.fixture(scope="module")
def run_folder(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """A folder as a run leaves it: asset/, run.json, and the asset's render of view 3 in asset_views/."""
    from stages.usd.stage import STAGE, Config, Inputs

    folder = tmp_path_factory.mktemp("run")
    inputs = write_inputs(folder / "in")
    named = {n: getattr(inputs, n) for n in Inputs.__slots__}
    STAGE.run(Inputs(**named), Config(preview_size=64, environment_width=64), Context(folder, folder / "scratch"))
    turn = np.array([[0, 0, 1.0], [0, 1, 0], [-1, 0, 0]])
    matrix = np.eye(4)
    matrix[:3, :3], matrix[:3, 3] = 1000 * turn, [5, 6, 7]  # a capture in millimetres, turned and moved
    (folder / "run.json").write_text(json.dumps({"capture_from_asset": matrix.ravel().tolist()}))
    params = {}
    for camera in inputs.poses.artifact.cameras:
        pose = np.array(camera.world_from_cam)
        moved = np.eye(4)
        moved[:3, :3], moved[:3, 3] = turn @ pose[:3, :3], matrix[:3, :3] @ pose[:3, 3] + matrix[:3, 3]
        K = np.array(camera.K)
        K[:2, 2] -= 0.5
        said = {"K": K, "Rt": np.linalg.inv(moved)[:3], "distortion": np.array(camera.distortion)}
        params |= {f"{camera.index}_{k}": v.tolist() for k, v in said.items()}
        params |= {f"{camera.index}_width": camera.width, f"{camera.index}_height": camera.height}
        params |= {f"{camera.index}_valid": True}
    (folder / "params.json").write_text(json.dumps(params))
    return folder


def test_validate_writes_json(run_folder: Path, tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    asset = run_folder / "asset/head.usd"
    assert main(["validate", str(asset), "--json", str(tmp_path / "found.json")]) == 0
    found = json.loads((tmp_path / "found.json").read_text())
    assert found["accepted"] is True and found["counts"]["error"] == 0 and found["checks"] >= 30
    capsys.readouterr()
    assert main(["validate", str(asset), "--json", "-"]) == 0
    assert json.loads(capsys.readouterr().out)["accepted"] is True


def test_render_shows_the_held_out_views_as_the_run_did(run_folder: Path, tmp_path: Path) -> None:
    """By default, and from the capture's own cameras: through another world and back."""
    assert main(["render", str(run_folder), "--out", str(tmp_path / "a")]) == 0
    assert sorted(p.name for p in (tmp_path / "a").glob("[!.]*")) == ["3.exr", "3.png", "9.exr", "9.png"]
    wanted = read_exr(run_folder / "asset_views/3.exr")[0]
    np.testing.assert_allclose(read_exr(tmp_path / "a/3.exr")[0], wanted, atol=2e-3)
    given = ["--cameras", str(run_folder / "params.json"), "--views", "3"]
    assert main(["render", str(run_folder), "--out", str(tmp_path / "b"), *given]) == 0
    np.testing.assert_allclose(read_exr(tmp_path / "b/3.exr")[0], wanted, atol=2e-3)


def test_render_under_the_exported_dome_is_close_to_the_closed_form(run_folder: Path, tmp_path: Path) -> None:
    """The same light as a picture, on a nearly convex body: two ways through the renderer that share little."""
    dome = str(run_folder / "asset/environment.exr")
    assert main(["render", str(run_folder), "--out", str(tmp_path), "--env", dome, "--views", "3"]) == 0
    found, wanted = read_exr(tmp_path / "3.exr")[0], read_exr(run_folder / "asset_views/3.exr")[0]
    inside = (found[..., 3] == 1) & (wanted[..., 3] == 1)
    assert np.abs(found - wanted)[inside].mean() < 0.03 * wanted[inside].mean()


def test_turntable_and_width(run_folder: Path, tmp_path: Path) -> None:
    assert main(["render", str(run_folder / "asset"), "--out", str(tmp_path), "--turntable", "3", "--width", "40"]) == 0
    assert len(list(tmp_path.glob("turn_*.exr"))) == 3
    assert read_exr(tmp_path / "turn_001.exr")[0].shape == (40, 40, 4)


@pytest.mark.parametrize(
    "options, code, said",
    [
        (["--views", "4"], 2, "no such view"),
        (["--views", "a"], 2, "can't be read"),
        (["--env", "gone.hdr"], 1, "light can't be read"),
        (["--env", "params.json"], 1, "light can't be read"),
    ],
)
def test_wrong_requests_say_so(
    run_folder: Path, tmp_path: Path, options: list[str], code: int, said: str, capsys: pytest.CaptureFixture[str]
) -> None:
    assert main(["render", str(run_folder), "--out", str(tmp_path), *options]) == code
    assert said in capsys.readouterr().err


def test_a_light_that_is_no_lat_long(run_folder: Path, tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    write_exr(tmp_path / "square.exr", np.ones((8, 8, 3), np.float32))
    assert main(["render", str(run_folder), "--out", str(tmp_path), "--env", str(tmp_path / "square.exr")]) == 1
    assert "twice as wide" in capsys.readouterr().err
