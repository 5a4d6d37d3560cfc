"""A file of the user's own in a published folder is never deleted, whatever it is called and whenever a run dies."""

from __future__ import annotations

import errno
import json
import os
import shutil
from collections.abc import Iterator
from pathlib import Path
from typing import Any

import pytest

from pipeline.artifacts import FileRef, HeldOutView, Located
from pipeline.asset_artifacts import UsdAsset
from pipeline.contract import Done
from pipeline.errors import StageError
from workflows.run import replace
from workflows.run.plan import Plan, make_plan
from workflows.run.publish import publish
from workflows.run.published import LIST
from workflows.run.request import RunRequest

pytestmark = pytest.mark.usefixtures("toys")


@pytest.fixture
def plan(photos: Path) -> Plan:
    made = make_plan(RunRequest(capture=str(photos), out=str(photos.parent / "out")))
    made.out.mkdir()
    return made


def usd(plan: Plan, text: str, files: tuple[str, ...] = ("head.usd", "textures/a.png")) -> Done[Any]:
    """A finished usd stage in the store whose files hold `text`, with one held-out view."""
    key = text.encode().hex().rjust(64, "0")
    folder = plan.store.folder("usd", key)
    for name in (*(f"asset/{f}" for f in files), "views/7.exr", "views/7.png"):
        (folder / name).parent.mkdir(parents=True, exist_ok=True)
        (folder / name).unlink(missing_ok=True)  # a store never writes into a finished file
        (folder / name).write_text(f"{text} {name}")
    exr, png = (FileRef.of(folder, f"views/7.{kind}") for kind in ("exr", "png"))
    refs = tuple(FileRef.of(folder, f"asset/{f}") for f in files)
    view = HeldOutView(index=7, exr=exr, png=png, scale=1)
    asset = UsdAsset(name="head", root="asset/head.usd", files=refs, views=(view,), checks=1)
    (folder / "manifest.json").write_text(asset.model_dump_json())
    return Done("usd", key, Located(asset, folder), False, {"seconds": 2.0})


def put(plan: Plan, *done: Done[Any]) -> tuple[dict[str, Any], list[str]]:
    notes: list[str] = []
    return publish(plan, done, notes.append), notes


def listing(folder: Path) -> dict[str, str]:
    """path -> content of all files in asset/ and report/."""
    return {p.relative_to(folder).as_posix(): p.read_text() for n in ("asset", "report")
            for p in sorted((folder / n).rglob("*")) if p.is_file()}  # fmt: skip


OURS = {"asset/head.usd", "asset/textures/a.png", "report/asset_views/7.exr", "report/asset_views/7.png"}


def test_foreign_files_stay_where_they_are(plan: Plan) -> None:
    mine = {
        "asset/my_scene.txt": "x",
        "report/thesis.txt": "y",
        "asset/textures/mine.png": "z",
        "report/own/deep/a.txt": "a",
    }
    for name, text in mine.items():  # before any run, as in the audit
        (plan.out / name).parent.mkdir(parents=True, exist_ok=True)
        (plan.out / name).write_text(text)
    (plan.out / "asset/empty").mkdir()
    (plan.out / "asset/link").symlink_to("../nowhere")
    for text in ("one", "two"):
        record, notes = put(plan, usd(plan, text))
        found = listing(plan.out)
        assert {k: found[k] for k in mine} == mine
        assert set(found) == OURS | set(mine)
        assert found["asset/head.usd"] == f"{text} asset/head.usd"
        assert (plan.out / "asset/link").readlink() == Path("../nowhere")
        assert (plan.out / "asset/empty").is_dir()
        assert notes == [] and "moved_aside" not in record


def test_an_edited_file_is_kept_aside_and_told(plan: Plan) -> None:
    put(plan, usd(plan, "one"))
    (plan.out / "asset/head.usd").write_text("edited")
    record, notes = put(plan, usd(plan, "two"))
    found = listing(plan.out)
    assert found["asset/head.usd"] == "two asset/head.usd"
    assert found["asset/head.usd.yours-1"] == "edited"
    assert record["moved_aside"] == {"asset/head.usd": "asset/head.usd.yours-1"}
    assert json.loads((plan.out / "run.json").read_text())["moved_aside"] == record["moved_aside"]
    assert len(notes) == 1 and "head.usd.yours-1" in notes[0]
    (plan.out / "asset/head.usd").write_text("edited again")
    put(plan, usd(plan, "two"))  # the same asset again
    found = listing(plan.out)
    assert found["asset/head.usd.yours-1"] == "edited" and found["asset/head.usd.yours-2"] == "edited again"


def test_the_asset_shares_its_bytes_with_outs_own_store_and_with_no_other(plan: Plan, tmp_path: Path) -> None:
    """Also its held-out views: all that an edit in place can cost is the stage usd."""
    done = usd(plan, "one")
    put(plan, done)
    stored = done.located.folder
    assert (plan.out / "asset/head.usd").samefile(stored / "asset/head.usd")
    assert (plan.out / "report/asset_views/7.exr").samefile(stored / "views/7.exr")
    shared = make_plan(plan.request.model_copy(update={"out": str(tmp_path / "b"), "store": str(plan.store.root)}))
    shared.out.mkdir()
    put(shared, done)
    assert not (shared.out / "asset/head.usd").samefile(stored / "asset/head.usd")
    (plan.out / "asset/head.usd").write_text("edited")
    assert (shared.out / "asset/head.usd").read_text() == "one asset/head.usd"


def test_an_edit_in_place_is_kept_and_the_stored_result_is_known_as_damaged(plan: Plan) -> None:
    done = usd(plan, "one")
    put(plan, done)
    assert plan.store.load("usd", done.key, UsdAsset) is not None
    (plan.out / "asset/textures/a.png").write_text("edited")
    assert plan.store.load("usd", done.key, UsdAsset) is None  # so that the stage makes it again
    put(plan, usd(plan, "one"))
    found = listing(plan.out)
    assert found["asset/textures/a.png"] == "one asset/textures/a.png"
    assert found["asset/textures/a.png.yours-1"] == "edited"


def test_an_edited_file_that_is_published_no_more_stays(plan: Plan) -> None:
    put(plan, usd(plan, "one", ("head.usd", "a.txt", "b.txt")))
    (plan.out / "asset/a.txt").write_text("edited")
    record, _ = put(plan, usd(plan, "two", ("head.usd",)))
    found = listing(plan.out)
    assert found["asset/a.txt"] == "edited" and "asset/b.txt" not in found
    assert "moved_aside" not in record


@pytest.mark.parametrize(
    ("mine", "kept"),
    [
        ("asset/head.usd", "asset/head.usd.yours-1"),
        ("asset/textures", "asset/textures.yours-1"),  # a file where a folder comes
        ("asset/head.usd/deep/x", "asset/head.usd.yours-1/deep/x"),  # a folder where a file comes
        ("asset", "asset.yours-1"),
        ("report", "report.yours-1"),
    ],
)
def test_a_name_that_a_published_file_needs(plan: Plan, mine: str, kept: str) -> None:
    (plan.out / mine).parent.mkdir(parents=True, exist_ok=True)
    (plan.out / mine).write_text("mine")
    record, notes = put(plan, usd(plan, "one"))
    assert (plan.out / kept).read_text() == "mine"
    assert set(listing(plan.out)) >= OURS
    assert len(record["moved_aside"]) == len(notes) == 1


def test_a_linked_folder_is_left_alone(plan: Plan, tmp_path: Path) -> None:
    elsewhere = tmp_path / "elsewhere"
    elsewhere.mkdir()
    (elsewhere / "mine").write_text("x")
    (plan.out / "asset").symlink_to(elsewhere)
    put(plan, usd(plan, "one"))
    assert [p.name for p in elsewhere.iterdir()] == ["mine"]
    assert (plan.out / "asset.yours-1").readlink() == elsewhere


@pytest.mark.parametrize("store", ["there", "gone"])
def test_a_folder_of_an_older_version_without_a_list(plan: Plan, store: str) -> None:
    put(plan, usd(plan, "one", ("head.usd", "stale.usd")))
    (plan.out / LIST).unlink()
    (plan.out / "asset/mine.txt").write_text("mine")
    (plan.out / "asset/head.usd").write_text("edited")
    if store == "gone":
        shutil.rmtree(plan.store.root / "usd")
    put(plan, usd(plan, "two"))
    found = listing(plan.out)
    assert found["asset/mine.txt"] == "mine" and found["asset/head.usd.yours-1"] == "edited"
    assert found["asset/head.usd"] == "two asset/head.usd"
    assert ("asset/stale.usd" in found) == (store == "gone")  # nobody knows whose it is: kept
    assert ("report/asset_views/7.png.yours-1" in found) == (store == "gone")


def test_the_same_content_is_not_kept_twice(plan: Plan) -> None:
    put(plan, usd(plan, "one"))
    (plan.out / LIST).unlink()
    (plan.out / "run.json").unlink()
    put(plan, usd(plan, "one"))
    assert set(listing(plan.out)) == OURS


def failing(name: str, at: int) -> Any:
    calls, real = 0, getattr(os, name)

    def fail(*args: Any, **more: Any) -> Any:
        nonlocal calls
        calls += 1
        if calls == at:
            raise OSError(errno.ENOSPC, "No space left on device", "there")
        return real(*args, **more)

    return fail


@pytest.mark.parametrize("at", range(1, 11))
def test_a_full_disk_loses_nothing_of_the_users(plan: Plan, monkeypatch: pytest.MonkeyPatch, at: int) -> None:
    put(plan, usd(plan, "one"))
    (plan.out / "asset/mine.txt").write_text("mine")
    (plan.out / "report/asset_views/7.png").write_text("edited")
    with monkeypatch.context() as m:
        m.setattr(os, "fsync", failing("fsync", at))
        with pytest.raises(StageError, match="no space is left"):
            put(plan, usd(plan, "two"))
    found = listing(plan.out)
    assert found["asset/mine.txt"] == "mine"
    assert "edited" in found.values()
    put(plan, usd(plan, "two"))
    found = listing(plan.out)
    assert set(found) == OURS | {"asset/mine.txt", "report/asset_views/7.png.yours-1"}
    assert {p.name for p in plan.out.iterdir() if p.name.startswith(".")} == {".store", LIST}


class Died(BaseException):
    """Stands for SIGKILL: nothing that is done on an exception may count."""


def steps(monkeypatch: pytest.MonkeyPatch, dies_at: int | None, exchange: bool) -> Iterator[str]:
    """Every rename, link and removal of a publishing, one after the other; dies at one of them."""
    done: list[str] = []

    def wrapped(where: Any, name: str) -> None:
        real = getattr(where, name)

        def call(*args: Any, **more: Any) -> Any:
            if dies_at is not None and len(done) >= dies_at:
                raise Died
            done.append(name)
            return real(*args, **more)

        monkeypatch.setattr(where, name, call)

    for where, name in ((os, "link"), (os, "rename"), (os, "fsync"), (shutil, "rmtree"), (replace, "_exchange")):
        wrapped(where, name)
    if not exchange:
        monkeypatch.setattr(replace, "_exchange", lambda a, b: False)
    return iter(done)


@pytest.mark.parametrize("exchange", [True, False])
def test_a_run_that_dies_at_any_step_loses_nothing_of_the_users(
    plan: Plan, monkeypatch: pytest.MonkeyPatch, exchange: bool
) -> None:
    at, ended = 0, False
    while not ended:
        shutil.rmtree(plan.out)
        plan.out.mkdir()
        put(plan, usd(plan, "one"))
        (plan.out / "asset/mine.txt").write_text("mine")
        (plan.out / "asset/head.usd").write_text("edited")
        with monkeypatch.context() as m:
            steps(m, at, exchange)
            try:
                put(plan, usd(plan, "two"))
                ended = True
            except Died:
                pass
        everything = [p.read_text() for p in plan.out.rglob("*") if p.is_file() and ".store" not in p.parts]
        assert "mine" in everything and "edited" in everything, at
        put(plan, usd(plan, "two"))
        found = listing(plan.out)
        assert set(found) == OURS | {"asset/mine.txt", "asset/head.usd.yours-1"}, at
        assert found["asset/mine.txt"] == "mine" and found["asset/head.usd.yours-1"] == "edited"
        assert {p.name for p in plan.out.iterdir() if p.name.startswith(".")} == {".store", LIST}, at
        at += 1
    assert at > 15


def test_a_file_that_comes_while_a_run_publishes(plan: Plan, monkeypatch: pytest.MonkeyPatch) -> None:
    put(plan, usd(plan, "one"))
    real = replace.swap

    def late(new: Path, final: Path) -> Path | None:
        if final.name == "asset":
            (final / "late.txt").write_text("late")
            (final / "head.usd").write_text("edited late")
        return real(new, final)

    monkeypatch.setattr(replace, "swap", late)
    record, notes = put(plan, usd(plan, "two"))
    found = listing(plan.out)
    assert found["asset/late.txt"] == "late" and found["asset/head.usd.yours-1"] == "edited late"
    assert found["asset/head.usd"] == "two asset/head.usd"
    assert len(notes) == 2
