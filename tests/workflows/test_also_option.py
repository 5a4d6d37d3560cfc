"""--also: the second capture's stages in plans, previews and the command, before anything is written."""

from __future__ import annotations

import json
from pathlib import Path
from types import SimpleNamespace
from typing import Any

import numpy as np
import pytest

from pipeline.artifacts import FileRef, HeldOutView, Located, SecondFitted
from pipeline.errors import UsageError
from stages import registry
from tests.support.textured_ball import camera_on_orbit, write_facescape
from workflows.cli.main import main
from workflows.run.plan import check_settings, make_plan, preview
from workflows.run.publish import report_files
from workflows.run.request import RunRequest
from workflows.server.access import ROOTS, check_folders

SECOND = ["also_capture", "also_poses", "also_masks", "together"]


@pytest.fixture
def two(tmp_path: Path) -> Any:
    K = np.array([[80.0, 0, 32], [0, 80, 32], [0, 0, 1]])
    for name, turn in (("a", 0), ("b", 7)):
        poses = [camera_on_orbit(360 * i / 5 + turn, 10, 0.5, np.zeros(3)) for i in range(5)]
        write_facescape(tmp_path / name, poses, K, (64, 64))

    def request(**changes: Any) -> RunRequest:
        named = {"capture": str(tmp_path / "a"), "out": str(tmp_path / "out"), "also": str(tmp_path / "b")}
        return RunRequest(**{**named, **changes})

    return request


def test_a_plan_has_the_second_captures_stages_before_the_fit(two: Any) -> None:
    plan, alone = make_plan(two()), make_plan(two(also=None))
    names = [s.name for s in plan.stages]
    assert [n for n in names if n not in SECOND] == [s.name for s in alone.stages]
    assert names.index("together") + 1 == names.index(registry.FIT) and names[3:7] == SECOND
    assert plan.configs["also_masks"] == plan.configs["masks"] and set(plan.configs) >= set(names)
    fit = plan.stages[names.index(registry.FIT)]
    assert fit.version == next(s for s in alone.stages if s.name == registry.FIT).version
    assert set(plan.sources) == {"source", "also_source"} and set(alone.sources) == {"source"}


def test_a_run_without_it_has_the_keys_that_it_had(two: Any) -> None:
    """What a plan of one capture depends on does not name the second one."""
    before, after = (preview(make_plan(two(also=a))) for a in (None, two().also))
    assert before[0] == after[0]  # the first capture's own stage is shared
    assert not [s for s in before if s.stage in SECOND]
    assert not any(f.startswith("also") for s in registry.REGISTRY for f in s.inputs.__dataclass_fields__)


def test_settings_of_the_stage_are_known_with_it_alone(two: Any) -> None:
    sets = ("together.align=outlines", "masks.threshold=0.4")
    found = check_settings(two(sets=sets))
    assert found["together"].align == "outlines"  # type: ignore[attr-defined]
    assert found["also_masks"].threshold == 0.4  # type: ignore[attr-defined]
    with pytest.raises(UsageError, match="unknown stage"):
        check_settings(two(also=None, sets=sets))
    with pytest.raises(UsageError, match="outside its limits"):
        check_settings(two(sets=("together.least_agreement=2",)))


@pytest.mark.parametrize("also", ["", "a"])
def test_no_folder_and_the_same_folder_are_refused(two: Any, tmp_path: Path, also: str) -> None:
    named = str(tmp_path / also) if also else " "
    with pytest.raises(UsageError, match="--also") as said:
        make_plan(two(also=named))
    assert ("no folder is named" if not also else "the second capture is the first") in str(said.value)
    assert not (tmp_path / "out").exists()


def test_dry_run_shows_both_captures(two: Any, tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    out = ["--out", str(tmp_path / "out"), "--also", str(tmp_path / "b"), "--dry-run"]
    assert main(["run", str(tmp_path / "a"), *out]) == 0
    told = capsys.readouterr().out
    assert all(name in told for name in SECOND) and "settings: those of the preset draft" in told
    assert main(["run", str(tmp_path / "a"), *out, "--json"]) == 0
    event = json.loads(capsys.readouterr().out.splitlines()[-1])
    assert [s["stage"] for s in event["stages"]][3:7] == SECOND


def test_a_missing_folder_is_named(two: Any, tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    code = main(["run", str(tmp_path / "a"), "--out", str(tmp_path / "out"), "--also", str(tmp_path / "no")])
    assert code in (1, 2) and str(tmp_path / "no") in capsys.readouterr().err


@pytest.mark.parametrize("exr", [True, False])
def test_what_is_known_of_the_second_capture_is_published(exr: bool, tmp_path: Path) -> None:
    file = FileRef(path="second/x", sha256="", size=0)
    view = HeldOutView(index=4, exr=file, png=file, scale=1)
    for second in (None, SecondFitted(light=file, held_out=(view,))):
        face = SimpleNamespace(held_out=(), second=second)
        done: Any = SimpleNamespace(located=Located(face, tmp_path))  # type: ignore[type-var, arg-type]
        wanted = {"second/light.json", "second/views/4.png"} | ({"second/views/4.exr"} if exr else set())
        assert set(report_files({"inverse_rendering": done}, exr=exr)) == (wanted if second else set())


def test_a_server_guards_its_folder_too(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setenv(ROOTS, str(tmp_path))
    check_folders({"capture": str(tmp_path / "a"), "also": str(tmp_path / "b")})
    with pytest.raises(UsageError, match="also"):
        check_folders({"capture": str(tmp_path / "a"), "also": "/etc"})
