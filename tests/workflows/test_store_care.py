"""Clearing up a store, and removing all that came from one person's photos."""

from __future__ import annotations

import os
import time
from pathlib import Path
from typing import Any

import pytest

from pipeline.artifacts import sha256_of
from pipeline.contract import execute, inputs_from
from pipeline.errors import Cancelled
from pipeline.store import LINEAGE, Store, lineage
from stages.registry import of_second
from tests.support.toy_stages import FIRST, source
from workflows.batch.state import BatchState, Entry
from workflows.cli.console import Console
from workflows.cli.main import main
from workflows.live.folder import LiveFolder
from workflows.run.plan import make_plan
from workflows.run.publish import publish
from workflows.run.published import note_published
from workflows.run.request import RunRequest
from workflows.run.run_lock import exclusive_run
from workflows.run.runner import run_stages
from workflows.store.gc import belongings, garbage, purge, remove

pytestmark = pytest.mark.usefixtures("toys")


def run(photos: Path, out: Path, store: Path, **changes: Any) -> None:
    plan = make_plan(RunRequest(capture=str(photos), out=str(out), store=str(store), **changes))
    plan.out.mkdir(parents=True, exist_ok=True)
    publish(plan, run_stages(plan))


def age(store: Path, days: float = 30) -> None:
    then = time.time() - 86400 * days
    for path in store.glob("[a-z]*/*"):
        os.utime(path, (then, then))


def finished(store: Path) -> list[str]:
    return sorted(p.parent.name for p in store.glob("[a-z]*/*") if len(p.name) == 64)


# ------------------------------------------------------------------ gc
def test_what_a_published_folder_names_stays_and_the_rest_goes(photos: Path, tmp_path: Path) -> None:
    store = tmp_path / "store"
    run(photos, tmp_path / "out", store)
    run(photos, tmp_path / "out", store, sets=("second.plus=1",))  # replaces what was published
    assert finished(store) == ["first", "second", "second", "third", "third"]
    assert garbage(Store(store), older_than=3600) == []  # used just now
    age(store)
    found = garbage(Store(store), older_than=3600)
    assert sorted(p.path.parent.name for p in found) == ["second", "third"]
    assert all(p.size > 0 for p in found)
    remove(Store(store), found)
    assert finished(store) == ["first", "second", "third"]
    assert garbage(Store(store), older_than=0) == []
    run(photos, tmp_path / "out", store, sets=("second.plus=1",))  # what stayed is whole
    assert len(list((store / LINEAGE).glob("*.json"))) == 3


def test_a_published_folder_that_is_gone_holds_nothing(photos: Path, tmp_path: Path) -> None:
    run(photos, tmp_path / "out", tmp_path / "store")
    age(tmp_path / "store")
    (tmp_path / "out/run.json").unlink()
    assert len(garbage(Store(tmp_path / "store"), 60)) == 3


def test_leftovers_of_dead_processes_go_those_of_living_ones_stay(tmp_path: Path) -> None:
    store, key, other = Store(tmp_path), "a" * 64, "b" * 64
    for name in (f"{key}.partial-0a1b2c3d", f"{key}.scratch", f"{other}.partial-0a1b2c3d", f"{other}.scratch"):
        (tmp_path / "second" / name).mkdir(parents=True)
    age(tmp_path)
    with store.lock("second", key):  # a stage was at work here
        pass
    with store.lock("second", other):
        found = garbage(store, 3600)
    assert sorted(p.path.name for p in found) == [f"{key}.partial-0a1b2c3d", f"{key}.scratch"]


def test_while_a_run_is_under_way_a_day_is_the_least(photos: Path, tmp_path: Path) -> None:
    """It has not said yet which artifacts it needs."""
    store = Store(tmp_path / "store")
    run(photos, tmp_path / "out", store.root)
    (tmp_path / "out/run.json").unlink()
    age(store.root, days=0.5)
    with exclusive_run(store.root, tmp_path / "other", lambda: False, print):
        assert garbage(store, 3600) == []
    assert len(garbage(store, 3600)) == 3


def test_what_a_process_took_up_meanwhile_stays(photos: Path, tmp_path: Path) -> None:
    store = Store(tmp_path / "store")
    run(photos, tmp_path / "out", store.root)
    (tmp_path / "out/run.json").unlink()
    found = garbage(store, 0)
    with store.lock("second", found[1].path.name):
        remove(store, found)
    assert finished(store.root) == ["second"]


def test_gc_command(photos: Path, tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    store = tmp_path / "store"
    run(photos, tmp_path / "out", store)
    run(photos, tmp_path / "out", store, sets=("third.plus=1",))
    age(store)
    assert main(["store", "gc", str(store), "--dry-run"]) == 0
    assert "1 pieces" in capsys.readouterr().out
    assert len(finished(store)) == 4
    assert main(["store", "gc", str(store), "--older-than", "40d"]) == 0
    assert len(finished(store)) == 4
    assert main(["store", "gc", str(store)]) == 0
    assert len(finished(store)) == 3
    assert main(["store", "gc", str(tmp_path / "none")]) == 1


def test_a_link_in_the_store_is_never_followed(tmp_path: Path) -> None:
    precious = tmp_path / "precious"
    precious.mkdir()
    (precious / "a").write_text("mine")
    (tmp_path / "store/second").mkdir(parents=True)
    (tmp_path / "store/second" / ("a" * 64)).symlink_to(precious)
    assert garbage(Store(tmp_path / "store"), 0) == []


# ------------------------------------------------------------------ purge
@pytest.fixture
def two_subjects(tmp_path: Path) -> Path:
    """A batch's OUT with subjects 4 and 40; a third capture of 4 never came further than its second stage."""
    out = tmp_path / "out"
    for name in ("4/1_neutral", "4/2_smile", "40/1_neutral"):
        photos = tmp_path / "tree" / name
        photos.mkdir(parents=True)
        (photos / "a.jpg").write_bytes(name.encode() * 9)
        until = "second" if name == "4/2_smile" else None
        plan = make_plan(RunRequest(capture=str(photos), out=str(out / name), store=str(out / ".store"), until=until))
        plan.out.mkdir(parents=True)
        done = run_stages(plan)
        if until is None:
            publish(plan, done)
        BatchState(out / "batch").write(Entry(name=name, capture=str(photos)))
    (out / "batch/logs").mkdir()
    (out / "batch/logs/4__1_neutral.log").write_text("x")
    (out / "batch/index.html").write_text("4 and 40")
    return out


def test_all_of_a_subject_goes_and_nothing_of_another(two_subjects: Path) -> None:
    out, store = two_subjects, Store(two_subjects / ".store")
    scratch = next(p for p in (out / ".store/second").iterdir())
    found = belongings("4", out, store)
    assert [p.name for p in found.photos] == ["1_neutral", "2_smile"]
    assert purge(found, store) == []
    assert finished(out / ".store") == ["first", "second", "third"]
    assert not (out / "4").exists() and (out / "40/1_neutral/run.json").is_file()
    assert [p.name for p in (out / "batch/captures").iterdir()] == ["40__1_neutral.json"]
    left = "".join(p.read_text() for p in out.rglob("*") if p.is_file() and p.suffix in (".json", ".html", ".log"))
    assert "tree/4/" not in left and "tree/40/" in left
    assert (out.parent / "tree/4/1_neutral/a.jpg").is_file()  # the photos are the user's
    assert scratch is not None


def test_checkpoints_of_unfinished_work_go_too(two_subjects: Path) -> None:
    store = Store(two_subjects / ".store")
    origin = next(p for p in (store.root / LINEAGE).glob("third-*") if lineage(p))
    key = origin.stem.rpartition("-")[2]
    (store.root / "third" / f"{key}.scratch").mkdir()
    (store.root / "third" / f"{key}.partial-01234567").mkdir()
    for subject in ("4", "40"):
        purge(belongings(subject, two_subjects, store), store)
    assert [p for p in store.root.glob("[a-z]*/*")] == []
    assert list((store.root / LINEAGE).iterdir()) == []


def test_purge_leaves_the_users_own_files_and_names_them(
    two_subjects: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    out = two_subjects / "4/1_neutral"
    (out / "asset").mkdir()
    (out / "asset/head.usd").write_text("published, then edited")
    (out / "asset/old.usd").write_text("published")
    note_published(out, {"asset/head.usd": ["0" * 64], "asset/old.usd": [sha256_of(out / "asset/old.usd")]})
    (out / "report/mine").mkdir(parents=True)
    (out / "report/mine/thesis.txt").write_text("mine")
    (out / "notes.txt").write_text("mine")
    for dry in (["--dry-run"], []):
        assert main(["store", "purge", "4", "--out", str(two_subjects), *dry]) == 0
        said = capsys.readouterr().out
        for name in ("asset/head.usd", "report/mine/thesis.txt", "notes.txt"):
            assert f"a file of your own, yours to remove: {out / name}\n" in said
            assert (out / name).is_file()
        assert (out / "asset/old.usd").exists() == (out / "run.json").exists() == bool(dry)
    left = {p.relative_to(out).as_posix() for p in out.rglob("*") if p.is_file()}
    assert left == {"asset/head.usd", "report/mine/thesis.txt", "notes.txt"}
    assert not (two_subjects / "4/2_smile").exists()


def test_the_same_photos_from_two_folders_are_found_from_both(photos: Path, tmp_path: Path) -> None:
    copy = tmp_path / "copy"
    copy.mkdir()
    for p in photos.iterdir():
        (copy / p.name).write_bytes(p.read_bytes())
    run(photos, tmp_path / "a", tmp_path / "store")
    run(copy, tmp_path / "b", tmp_path / "store")
    purge(belongings("copy", tmp_path / "b", Store(tmp_path / "store")), Store(tmp_path / "store"))
    assert finished(tmp_path / "store") == []


def test_the_second_capture_of_a_run_goes_with_the_first(
    photos: Path, tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    """Both show one person; the stages before the fit read the second one under names of their own."""
    second, out = tmp_path / "second_light", tmp_path / "out"
    second.mkdir()
    (second / "a.jpg").write_bytes(b"the same head under another light")
    plan = make_plan(RunRequest(capture=str(photos), out=str(out)))
    out.mkdir()
    stage = of_second(FIRST)
    also = execute(stage, inputs_from(stage, {"also_source": source(second)}), stage.config(), plan.store)
    publish(plan, [*run_stages(plan), also])
    assert "also_first" in finished(out / ".store")
    assert main(["store", "purge", "photos", "--out", str(out)]) == 0
    assert finished(out / ".store") == [] and second.is_dir()
    said = capsys.readouterr().out
    assert all(f"the photos themselves are yours to remove: {p}\n" in said for p in (photos, second))


def test_a_run_that_was_started_with_relative_paths(
    photos: Path, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.chdir(tmp_path)
    run(Path("photos"), Path("out"), Path("out/.store"))
    monkeypatch.chdir("/")
    found = belongings("photos", tmp_path / "out", Store(tmp_path / "out/.store"))
    assert found.photos == (photos,)
    assert purge(found, Store(tmp_path / "out/.store")) == []
    assert finished(tmp_path / "out/.store") == []


def test_purge_command_of_a_single_run(photos: Path, tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    out = tmp_path / "out"
    run(photos, out, out / ".store")
    (out / "notes.txt").write_text("mine")
    assert main(["store", "purge", "nobody", "--out", str(out)]) == 1
    assert "nothing is known of this subject" in capsys.readouterr().err
    assert main(["store", "purge", "photos", "--out", str(out), "--dry-run"]) == 0
    assert "would be removed" in capsys.readouterr().out and (out / "run.json").is_file()
    with exclusive_run(out / ".store", out, lambda: False, print):
        assert main(["store", "purge", "photos", "--out", str(out)]) == 1
    assert "under way" in capsys.readouterr().err and (out / "run.json").is_file()
    assert main(["store", "purge", "photos", "--out", str(out)]) == 0
    assert str(photos) in capsys.readouterr().out
    assert finished(out / ".store") == [] and not (out / "run.json").exists()
    assert (out / "notes.txt").is_file() and photos.is_dir()


def test_purge_takes_what_a_stopped_run_left_in_its_store(
    photos: Path, tmp_path: Path, monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str]
) -> None:
    """Its first stage was finished: it has copies of the photos. The command was given with relative paths."""

    def stopped(console: Console, *given: object, **figures: float) -> None:
        raise Cancelled("stopped by the user")

    monkeypatch.chdir(tmp_path)
    with monkeypatch.context() as patch:
        patch.setattr(Console, "progress", stopped)
        assert main(["run", "photos", "--out", "out"]) == 130
    assert finished(tmp_path / "out/.store") == ["first"]
    monkeypatch.chdir("/")
    assert main(["store", "purge", "photos", "--out", str(tmp_path / "out")]) == 0
    assert finished(tmp_path / "out/.store") == [] and photos.is_dir()
    assert f"yours to remove: {photos}\n" in capsys.readouterr().out


def test_purge_takes_what_a_stopped_run_told(photos: Path, tmp_path: Path) -> None:
    """Nothing was published, so that no list names the folder; a file of the user's in it stays."""
    out, store = tmp_path / "out", Store(tmp_path / "store")
    out.mkdir()
    live = LiveFolder(out)
    live.state({"run": "abc", "stages": [], "capture": str(photos)})
    live.write("fit.jpg", b"a face")
    (out / "live/mine.txt").write_text("mine")
    assert belongings("somebody", out, store).paths == ()
    found = belongings(photos.name, out, store)
    assert {p.name for p in found.paths} == {"state.json", "fit.jpg", ".published.json"}
    assert found.users == (out / "live/mine.txt",)
    assert purge(found, store) == []
    assert [p.name for p in (out / "live").iterdir()] == ["mine.txt"]
    (out / "live/mine.txt").unlink()
    LiveFolder(out).state({"run": "abc", "stages": [], "capture": str(photos)})
    assert purge(belongings(photos.name, out, store), store) == [] and not out.exists()
