"""Plans, the runner without Prefect, the folders it writes to, and what is published."""

from __future__ import annotations

import errno
import json
import shutil
from pathlib import Path
from typing import Any

import pytest

from pipeline.artifacts import Artifact, FileRef, HeldOutView, Located
from pipeline.asset_artifacts import UsdAsset
from pipeline.contract import Done, execute
from pipeline.errors import Cancelled, StageError, UsageError
from workflows.run.output_dirs import writable
from workflows.run.plan import make_plan, preview
from workflows.run.publish import asset_hash, publish
from workflows.run.published import LIST
from workflows.run.replace import swap
from workflows.run.request import RunRequest
from workflows.run.runner import run_stages
from workflows.run.session import Session

pytestmark = pytest.mark.usefixtures("toys")


def request(photos: Path, **changes: Any) -> RunRequest:
    return RunRequest(capture=str(photos), out=str(photos.parent / "out"), **changes)


def run(photos: Path, **changes: Any) -> list[Done[Any]]:
    plan = make_plan(request(photos, **changes))
    return run_stages(plan)


# ------------------------------------------------------------------ plans
def test_until_and_from_stage(photos: Path) -> None:
    plan = make_plan(request(photos, until="second", from_stage="second"))
    assert [s.name for s in plan.stages] == ["first", "second"]
    assert plan.anew == {"second"}
    assert not Path(plan.request.out).exists()  # planning writes nothing


@pytest.mark.parametrize(
    ("changes", "told"),
    [
        ({"until": "secnod"}, "did you mean second?"),
        ({"from_stage": "x"}, "first, second, third"),
        ({"from_stage": "third", "until": "first"}, "nothing would run"),
        ({"device": "gpu"}, "auto, cpu, cuda"),
        ({"preset": "best"}, "draft, studio, film"),
        ({"out": " "}, "no folder is named"),
    ],
)
def test_requests_that_make_no_sense(photos: Path, changes: dict[str, str], told: str) -> None:
    with pytest.raises(UsageError) as e:
        make_plan(RunRequest(**{"capture": str(photos), "out": str(photos.parent / "out"), **changes}))
    assert told in str(e.value)


def test_results_never_land_among_the_photos(photos: Path) -> None:
    with pytest.raises(UsageError, match="among the photos"):
        make_plan(RunRequest(capture=str(photos), out=str(photos / ".." / "photos")))


def test_preview_tells_what_the_run_then_does(photos: Path) -> None:
    def told(**changes: Any) -> list[str]:
        return [s.action for s in preview(make_plan(request(photos, **changes)))]

    assert told() == ["made", "made", "made"]
    run(photos)
    assert told() == ["reused"] * 3
    assert told(from_stage="second") == ["reused", "made anew", "made"]
    assert told(sets=("third.plus=1",)) == ["reused", "reused", "made"]
    assert told(sets=("first.plus=1",)) == ["made"] * 3
    assert [d.reused for d in run(photos, sets=("third.plus=1",))] == [True, True, False]


def test_from_stage_makes_anew_what_is_there(photos: Path) -> None:
    run(photos)
    assert [d.reused for d in run(photos, from_stage="second")] == [True, False, False]
    assert [d.reused for d in run(photos)] == [True, True, True]


def test_a_stopped_run_goes_on_where_it_left_off(photos: Path) -> None:
    watch = Session()
    plan = make_plan(request(photos))

    def stop_after_first(*args: Any, **options: Any) -> Any:
        done = execute(*args, **options)
        watch.stop.set()
        return done

    with pytest.raises(Cancelled):
        run_stages(plan, watch, stop_after_first)
    assert [d.reused for d in run(photos)] == [True, False, False]


def test_relative_paths(photos: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.chdir(photos.parent)
    plan = make_plan(RunRequest(capture="photos", out="deep/out"))
    assert [d.reused for d in run_stages(plan)] == [False] * 3
    assert plan.out == photos.parent / "deep/out"
    absolute = make_plan(RunRequest(capture=str(photos), out=str(photos.parent / "deep/out")))
    assert [d.reused for d in run_stages(absolute)] == [True] * 3


# ------------------------------------------------------------------ folders
def test_failure_leaves_no_folder_that_was_not_there(tmp_path: Path) -> None:
    out = tmp_path / "new" / "deep"
    with pytest.raises(ZeroDivisionError), writable(out, out / ".store"):
        (out / ".store" / ".locks").mkdir()
        (out / ".store" / "first" / "k.partial-1").mkdir(parents=True)
        raise ZeroDivisionError
    assert list(tmp_path.iterdir()) == []


def test_failure_keeps_finished_stages_and_the_users_files(tmp_path: Path) -> None:
    kept, mine = tmp_path / "kept", tmp_path / "mine"
    with pytest.raises(ZeroDivisionError), writable(kept, kept / ".store"):
        (kept / ".store" / "first" / "k").mkdir(parents=True)
        raise ZeroDivisionError
    assert (kept / ".store" / "first" / "k").is_dir()
    mine.mkdir()
    (mine / "notes.txt").write_text("mine")
    with pytest.raises(ZeroDivisionError), writable(mine, mine / ".store"):
        raise ZeroDivisionError
    assert [p.name for p in mine.iterdir()] == ["notes.txt"]


def test_a_file_that_came_into_a_new_store_is_not_swept(tmp_path: Path) -> None:
    out = tmp_path / "out"
    with pytest.raises(ZeroDivisionError), writable(out, out / ".store"):
        (out / ".store" / ".locks").mkdir()
        (out / ".store" / "first" / "k.partial-1").mkdir(parents=True)
        (out / ".store" / "notes.txt").write_text("mine")
        raise ZeroDivisionError
    left = {p.relative_to(out).as_posix() for p in out.rglob("*") if p.is_file()}
    assert left == {".store/notes.txt"}
    assert not (out / ".store/first").exists() and not (out / ".store/.locks").exists()


def test_a_store_of_others_is_never_swept(tmp_path: Path) -> None:
    shared = tmp_path / "shared"
    (shared / "first").mkdir(parents=True)
    with pytest.raises(ZeroDivisionError), writable(tmp_path / "out", shared):
        raise ZeroDivisionError
    assert (shared / "first").is_dir()
    assert not (tmp_path / "out").exists()


@pytest.mark.parametrize("where", ["file", "/proc/neuface"])
def test_folders_that_cannot_be_written(tmp_path: Path, where: str) -> None:
    (tmp_path / "file").write_text("")
    out = Path(where) if where.startswith("/") else tmp_path / where
    with pytest.raises(StageError) as e, writable(out, tmp_path / "store"):
        pytest.fail("work began")
    assert str(out) in str(e.value)
    assert not (tmp_path / "store").exists()


# ------------------------------------------------------------------ publishing
def fake_done(folder: Path, stage: str, artifact: Artifact) -> Done[Any]:
    return Done(stage, "k" * 64, Located(artifact, folder), False, {"seconds": 2.0, "peak_memory_mb": 5.0})


def usd_done(folder: Path, text: str = "#usda 1.0", extra: str = "textures/a.png") -> Done[Any]:
    (folder / "asset/textures").mkdir(parents=True, exist_ok=True)
    (folder / "views").mkdir(exist_ok=True)
    (folder / "asset/head.usd").write_text(text)
    (folder / "asset/textures/a.png").write_bytes(b"png")
    (folder / "asset" / extra).write_bytes(b"png")
    (folder / "preview.png").write_bytes(b"not of the asset")
    (folder / "views/x.exr").write_bytes(b"exr")
    (folder / "views/x.png").write_bytes(b"png")
    names = {"asset/head.usd", "asset/textures/a.png", f"asset/{extra}", "preview.png"}
    refs = tuple(FileRef.of(folder, f) for f in sorted(names))
    view = HeldOutView(index=7, exr=FileRef.of(folder, "views/x.exr"), png=FileRef.of(folder, "views/x.png"), scale=1)
    asset = UsdAsset(name="head", root="asset/head.usd", files=refs, views=(view,), checks=1)
    return fake_done(folder, "usd", asset)


def listing(folder: Path) -> set[str]:
    return {p.relative_to(folder).as_posix() for p in folder.rglob("*") if p.is_file()}


def test_publish_asset_views_and_record(photos: Path, tmp_path: Path) -> None:
    plan = make_plan(request(photos, seed=3))
    plan.out.mkdir()
    record = publish(plan, [usd_done(tmp_path / "art")])
    known = {"asset/head.usd", "asset/textures/a.png", "report/asset_views/7.png", "run.json", LIST}
    assert {p for p in listing(plan.out) if not p.startswith(".store/")} == known | {"report/asset_views/7.exr"}
    publish(
        make_plan(request(photos, seed=3, no_exr_views=True)), [usd_done(tmp_path / "art")]
    )  # and without it the EXR goes
    assert {p for p in listing(plan.out) if not p.startswith(".store/")} == known
    record = publish(plan, [usd_done(tmp_path / "art")])
    assert json.loads((plan.out / "run.json").read_text()) == json.loads(json.dumps(record))
    assert record["asset"] == "asset/head.usd"
    assert record["seed"] == 3
    assert record["stages"]["usd"]["seconds"] == 2.0
    assert len(record["asset_hash"]) == 64


def test_publishing_again_leaves_nothing_of_the_old(photos: Path, tmp_path: Path) -> None:
    plan = make_plan(request(photos))
    plan.out.mkdir()
    publish(plan, [usd_done(tmp_path / "old", extra="stale.usd")])
    assert "asset/stale.usd" in listing(plan.out)
    publish(plan, [usd_done(tmp_path / "art")])
    assert "asset/stale.usd" not in listing(plan.out)
    assert {p.name for p in plan.out.iterdir() if p.name.startswith(".")} == {".store", LIST}  # nothing half-made


@pytest.mark.parametrize("fails_at", [1, 2, 4])
def test_a_full_disk_while_publishing_keeps_what_was_there(
    photos: Path, tmp_path: Path, monkeypatch: pytest.MonkeyPatch, fails_at: int
) -> None:
    plan = make_plan(request(photos, store=str(tmp_path / "shared")))  # of such a store everything is copied
    plan.out.mkdir()
    publish(plan, [usd_done(tmp_path / "old")])
    calls = 0

    def copy(source: Path, target: Path) -> None:
        nonlocal calls
        calls += 1
        if calls == fails_at:
            target.write_bytes(b"half")
            raise OSError(errno.ENOSPC, "No space left on device", str(target))
        target.write_bytes(source.read_bytes())

    monkeypatch.setattr(shutil, "copyfile", copy)
    with pytest.raises(StageError, match="no space is left"):
        publish(plan, [usd_done(tmp_path / "new", "#usda 1.0 new")])
    assert {p.name for p in plan.out.iterdir() if p.name.startswith(".")} == {LIST}  # nothing half-made
    assert (plan.out / "asset/head.usd").read_text() == "#usda 1.0"  # not the new asset beside the old report
    assert b"half" not in {p.read_bytes() for p in plan.out.rglob("*") if p.is_file()}


def test_swap_puts_the_old_one_back_if_the_new_one_can_not_take_its_place(tmp_path: Path) -> None:
    (tmp_path / "asset").mkdir()
    (tmp_path / "asset" / "x").write_text("old")
    with pytest.raises(OSError):
        swap(tmp_path / "not there", tmp_path / "asset")
    assert (tmp_path / "asset" / "x").read_text() == "old"


def test_asset_hash_is_of_content_and_names() -> None:
    a, b = FileRef(path="a", sha256="1", size=1), FileRef(path="b", sha256="2", size=1)
    assert asset_hash([a, b]) == asset_hash([b, a])
    others = [[a], [a, FileRef(path="b", sha256="3", size=1)], [a, FileRef(path="c", sha256="2", size=1)]]
    assert len({asset_hash([a, b]), *(asset_hash(o) for o in others)}) == 4
