"""`neuface run --dry-run`: what would run and why, the time, the disk and the memory; nothing is written."""

from __future__ import annotations

import dataclasses
import json
from pathlib import Path
from typing import Any

import pytest

from workflows.cli.main import main
from workflows.run import estimate, needs
from workflows.run.plan import Step, make_plan
from workflows.run.request import RunRequest

pytestmark = pytest.mark.usefixtures("toys")


def neuface(photos: Path, *options: str) -> None:
    assert main(["run", str(photos), "--out", str(photos.parent / "out"), *options]) == 0


def planned(photos: Path, capsys: pytest.CaptureFixture[str], *options: str) -> tuple[dict[str, str], str]:
    """Stage -> the rest of its line; and the whole text."""
    capsys.readouterr()
    neuface(photos, "--dry-run", *options)
    text = capsys.readouterr().out
    rows = (line.partition(" ") for line in text.splitlines()[:3])
    return {name: rest.strip() for name, _, rest in rows}, text


def test_what_is_new_what_is_reused_and_what_changed(photos: Path, capsys: pytest.CaptureFixture[str]) -> None:
    rows, _ = planned(photos, capsys)
    assert all(row.startswith("made ") and row.endswith(" new") for row in rows.values())
    neuface(photos)
    rows, text = planned(photos, capsys)
    assert all(row.startswith("reused ") for row in rows.values()) and "everything is in the store" in text
    rows, _ = planned(photos, capsys, "--set", "second.plus=3")
    assert rows["first"].startswith("reused")
    assert rows["second"].endswith("setting changed: second.plus 0 -> 3")
    assert rows["third"].endswith("input changed: second")
    rows, _ = planned(photos, capsys, "--from-stage", "third")
    assert rows["third"].endswith("asked for with --from-stage") and rows["second"].startswith("reused")
    (photos / "c.jpg").write_bytes(b"another photo")
    rows, _ = planned(photos, capsys)
    assert rows["first"].endswith("the photos changed, or the program did")
    assert rows["second"].endswith("input changed: first")


def test_another_number_of_threads_is_named(
    photos: Path, capsys: pytest.CaptureFixture[str], monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setenv("NUMBA_NUM_THREADS", "2")
    neuface(photos)
    monkeypatch.setenv("NUMBA_NUM_THREADS", "1")
    rows, _ = planned(photos, capsys)
    assert rows["first"].endswith("number of threads changed: 2 -> 1")
    monkeypatch.setenv("NUMBA_NUM_THREADS", "2")
    rows, _ = planned(photos, capsys)
    assert all(row.startswith("reused ") for row in rows.values())


def test_what_left_the_store_and_what_is_damaged(photos: Path, capsys: pytest.CaptureFixture[str]) -> None:
    import shutil

    neuface(photos)
    store = photos.parent / "out/.store"
    next((store / "second").glob("*/manifest.json")).write_text("{")
    shutil.rmtree(next(p for p in (store / "third").iterdir() if len(p.name) == 64))
    rows, _ = planned(photos, capsys)
    assert rows["second"].endswith("what the store has is damaged")
    assert rows["third"].endswith("input changed: second")


def test_a_checkpoint_is_told(photos: Path, capsys: pytest.CaptureFixture[str]) -> None:
    neuface(photos, "--until", "first")
    plan = make_plan(RunRequest(capture=str(photos), out=str(photos.parent / "out")))
    from workflows.run.plan import preview

    key = preview(plan)[1].key
    assert key is not None
    scratch = plan.store.scratch("second", key)
    scratch.mkdir(parents=True)
    (scratch / "step.txt").write_text("4")
    rows, _ = planned(photos, capsys)
    assert rows["second"].endswith("new; goes on from its checkpoint")


def test_settings_that_are_not_the_presets(photos: Path, capsys: pytest.CaptureFixture[str]) -> None:
    _, text = planned(photos, capsys)
    assert "settings: those of the preset draft" in text
    _, text = planned(photos, capsys, "--set", "first.plus=2", "--seed", "7")
    assert "first.plus = 2 (preset: 0)" in text and "third.seed = 7 (preset: 0)" in text


def test_time_disk_and_memory(
    photos: Path, capsys: pytest.CaptureFixture[str], monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setitem(estimate.SECONDS, "draft", {"first": 20.0, "second": 700.0})
    monkeypatch.setattr(needs, "KEPT_MB", {"first": 40, "second": 50})
    rows, text = planned(photos, capsys)
    assert rows["second"].split("  ")[0] == "made" and "12 min" in rows["second"]
    assert "time: about 12 min (measured on two cores); not known for third" in text
    assert "disk: about 91 MB; " in text and "memory: about 2.7 GB; " in text  # 1 MB for what is not known
    assert not (photos.parent / "out").exists()


def test_earlier_runs_beside_this_one_tell_the_time(photos: Path, capsys: pytest.CaptureFixture[str]) -> None:
    assert main(["run", str(photos), "--out", str(photos.parent / "before")]) == 0
    for path in (photos.parent / "before/.store").glob("*/*/run.json"):
        path.write_text(json.dumps({**json.loads(path.read_text()), "seconds": 100.0, "peak_memory_mb": 512.0}))
    _, text = planned(photos, capsys)
    assert "time: about 5 min (earlier runs here)" in text and "memory: about 0.5 GB" in text


def test_the_plan_for_programs(photos: Path, capsys: pytest.CaptureFixture[str]) -> None:
    neuface(photos, "--dry-run", "--json", "--set", "first.plus=2")
    plan: dict[str, Any] = json.loads(capsys.readouterr().out)
    assert plan["event"] == "plan"
    assert [(s["stage"], s["action"], s["why"]) for s in plan["stages"]] == [
        (name, "made", "new") for name in ("first", "second", "third")]  # fmt: skip
    assert plan["settings"] == {"first.plus": {"value": 2, "preset": 0}}
    assert {"disk_bytes", "memory_mb"} <= plan.keys()


def test_a_shared_file_counts_once_and_a_page_that_was_given_up_counts(tmp_path: Path) -> None:
    (tmp_path / "bake").mkdir()
    (tmp_path / "usd").mkdir()
    (tmp_path / "bake/map.exr").write_bytes(b"x" * 100)
    (tmp_path / "usd/map.exr").hardlink_to(tmp_path / "bake/map.exr")
    (tmp_path / "usd/head.glb").write_bytes(b"x" * 7)
    listed = [{"path": "page.html", "size": 1000}, {"path": "head.glb", "size": 7}, {"path": "x"}, 3]
    (tmp_path / "usd/manifest.json").write_text(manifest := json.dumps({"files": listed}))
    seen: set[int] = set()
    assert needs._bytes_of(tmp_path / "bake", seen) == 100
    assert needs._bytes_of(tmp_path / "usd", seen) == 7 + len(manifest) + 1000


@pytest.mark.parametrize(
    ("options", "added"), [((), 45 + 15), (("--keep-all",), 45 + 30), (("--store", "else"), 90 + 30)]
)
def test_the_results_count_twice_where_they_are_copied(
    options: tuple[str, ...], added: int, photos: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    """Asset and page, of which OUT has copies unless its own store has the same files."""
    changes: dict[str, Any] = {"keep_all": "--keep-all" in options}
    changes |= {"store": str(photos.parent / "else")} if "--store" in options else {}
    plan = make_plan(RunRequest(capture=str(photos), out=str(photos.parent / "out"), **changes))
    monkeypatch.setattr(needs, "records", lambda *_: iter(()))
    steps = [estimate.Expected(Step(n, None, "made"), None, "table") for n in ("usd", "report")]
    monkeypatch.setattr(needs, "_kept", lambda _, name: 1e6 * needs.KEPT_MB[name])
    plan = dataclasses.replace(plan, configs={"usd": plan.configs["first"], "report": plan.configs["first"]})
    assert needs.needs(plan, steps).disk == added * 1e6
