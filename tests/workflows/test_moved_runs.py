"""A folder of results that was moved with its own store: it keeps its results, and its report can be made again."""

from __future__ import annotations

import json
from dataclasses import replace
from pathlib import Path
from typing import Any

import pytest

import workflows.cli.report
import workflows.run.plan
from pipeline.artifacts import FileRef
from pipeline.errors import StageError
from pipeline.store import LINEAGE, Store
from stages import registry
from tests.support.toy_stages import FIRST, SECOND, THIRD, Number, _write
from workflows.cli.main import main
from workflows.cli.report import check_alone
from workflows.run.plan import make_plan
from workflows.run.request import RunRequest
from workflows.store.gc import garbage
from workflows.store.roots import ROOTS

pytestmark = pytest.mark.usefixtures("toys")


class Page(Number):
    """As much of the report's manifest as publishing needs."""

    files: tuple[FileRef, ...] = ()


def page(inputs: Any, config: Any, context: Any) -> Page:
    return Page(**_write(context, 1).model_dump())


@pytest.fixture(autouse=True)
def with_report(toys: None, monkeypatch: pytest.MonkeyPatch) -> None:
    report = replace(THIRD, name="report", output=Page, run=page)
    monkeypatch.setattr(registry, "REGISTRY", (FIRST, SECOND, report))


@pytest.fixture
def moved(photos: Path, tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> Path:
    """The run was started with relative paths; now its folder is elsewhere, and so is the user."""
    monkeypatch.chdir(tmp_path)
    assert main(["run", "photos", "--out", "runs/anna"]) == 0
    (tmp_path / "runs").rename(tmp_path / "archive")
    (tmp_path / "elsewhere").mkdir()
    monkeypatch.chdir(tmp_path / "elsewhere")
    return tmp_path / "archive/anna"


def record(out: Path) -> dict[str, Any]:
    found: dict[str, Any] = json.loads((out / "run.json").read_text())
    return found


def reused(out: Path) -> dict[str, bool]:
    return {n: s["reused"] for n, s in record(out)["stages"].items()}


def refused(out: Path, capsys: pytest.CaptureFixture[str]) -> str:
    """What `neuface report` says; it writes nothing, neither here nor at the former place."""
    before = {p: p.stat().st_mtime_ns for p in out.rglob("*")}
    assert main(["report", str(out)]) == 1
    assert {p: p.stat().st_mtime_ns for p in out.rglob("*")} == before
    assert not (out.parent.parent / "runs").exists()
    return capsys.readouterr().err


# ------------------------------------------------------------------ store
def test_gc_keeps_what_a_moved_folder_is_from(moved: Path) -> None:
    assert garbage(Store(moved / ".store"), older_than=0) == []
    (moved / "run.json").unlink()
    assert len(garbage(Store(moved / ".store"), older_than=0)) == 3


def test_a_folder_from_another_store_holds_nothing_here(moved: Path, photos: Path, tmp_path: Path) -> None:
    """Its run.json lies beside this store, but has none of its keys."""
    (photos / "c.jpg").write_bytes(b"a new photo")
    assert main(["run", str(photos), "--out", str(tmp_path / "new")]) == 0
    (tmp_path / "new/run.json").replace(moved / "run.json")
    assert len(garbage(Store(moved / ".store"), older_than=0)) == 3


def test_purge_of_a_moved_folder(moved: Path, photos: Path, capsys: pytest.CaptureFixture[str]) -> None:
    assert main(["store", "purge", "photos", "--out", str(moved)]) == 0
    assert str(photos) in capsys.readouterr().out
    folders = (moved / ".store" / name for name in ("first", "second", "report", LINEAGE, ROOTS))
    left = [p for folder in folders for p in folder.glob("*")]
    assert left == [] and not (moved / "run.json").exists()


# ------------------------------------------------------------------ report
def test_run_json_has_the_whole_paths_of_what_was_read(moved: Path, photos: Path) -> None:
    assert record(moved)["request"]["capture"] == str(photos)


def test_the_report_of_a_moved_folder_is_made_from_its_own_store(moved: Path) -> None:
    assert main(["report", str(moved)]) == 0
    assert reused(moved) == {"first": True, "second": True, "report": False}
    assert record(moved)["store"] == str(moved / ".store") and not (moved.parent.parent / "runs").exists()


def test_a_stage_that_is_gone_is_not_made_by_the_report(moved: Path, capsys: pytest.CaptureFixture[str]) -> None:
    for folder in (moved / ".store/second").iterdir():
        folder.rename(moved / "aside")
    assert "second would be made again (second: no longer in the store)" in refused(moved, capsys)


def test_changed_photos_do_not_begin_the_run_anew(
    moved: Path, photos: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    (photos / "a.jpg").write_bytes(b"another")
    said = refused(moved, capsys)
    assert "first, second would be made again" in said and f"neuface run {photos} ..." in said


def test_a_store_that_is_gone(moved: Path, capsys: pytest.CaptureFixture[str]) -> None:
    (moved / ".store").rename(moved / "kept")
    assert "the store is gone" in refused(moved, capsys)


@pytest.mark.parametrize("request_", [{"capture": "x", "sharpness": 3}, {}, [], None, {"capture": "x", "budget": -1}])
def test_a_request_of_another_version(moved: Path, request_: Any, capsys: pytest.CaptureFixture[str]) -> None:
    (moved / "run.json").write_text(json.dumps(record(moved) | {"request": request_}))
    assert "a request that this version does not know" in refused(moved, capsys)


def test_a_run_by_the_clock_is_known_by_its_keys(moved: Path, monkeypatch: pytest.MonkeyPatch, photos: Path) -> None:
    """Its settings from the fit on are not known before the run comes there."""
    for module in (workflows.run.plan, workflows.cli.report):
        monkeypatch.setattr(module, "FIT", "second")
    asked = RunRequest(capture=str(photos), out=str(moved), budget=600, from_stage="report")
    check_alone(make_plan(asked), record(moved))
    next((moved / ".store/second").iterdir()).rename(moved / "aside")
    with pytest.raises(StageError, match="second would be made again"):
        check_alone(make_plan(asked), record(moved))
