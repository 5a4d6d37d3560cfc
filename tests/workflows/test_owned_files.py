"""Files that commands write beside the user's own: a foreign or edited one is renamed, never lost."""

from __future__ import annotations

import json
import os
from contextlib import suppress
from pathlib import Path
from typing import Any

import numpy as np
import pytest

from pipeline.errors import Cancelled, UsageError
from pipeline.images import write_exr
from pipeline.store import LINEAGE, LOCKS, Store
from workflows.batch.page import TABLES, write_page
from workflows.batch.request import BatchRequest
from workflows.batch.state import Summary
from workflows.cli.main import main
from workflows.cli.render import given_cameras, put_file
from workflows.run import replace
from workflows.run.owned import write_owned
from workflows.run.plan import Plan, make_plan
from workflows.run.publish import publish
from workflows.run.published import LIST
from workflows.run.request import RunRequest
from workflows.run.runner import run_stages
from workflows.store.gc import belongings, garbage, purge

pytestmark = pytest.mark.usefixtures("toys")


def visible(folder: Path) -> dict[str, str]:
    return {p.name: p.read_text() for p in folder.iterdir() if p.is_file() and not p.name.startswith(".")}


# ------------------------------------------------------------------ one file
def test_our_own_file_is_replaced_and_the_users_renamed(tmp_path: Path) -> None:
    assert write_owned(tmp_path, "a.txt", "one") is None
    assert write_owned(tmp_path, "a.txt", "two") is None
    (tmp_path / "a.txt").write_text("edited")
    assert write_owned(tmp_path, "a.txt", "three") == "a.txt.yours-1"
    (tmp_path / "a.txt").write_text("edited again")
    assert write_owned(tmp_path, "a.txt", "three") == "a.txt.yours-2"
    assert visible(tmp_path) == {"a.txt": "three", "a.txt.yours-1": "edited", "a.txt.yours-2": "edited again"}
    assert [p.name for p in tmp_path.iterdir() if ".partial" in p.name] == []


@pytest.mark.parametrize("kind", ["file", "folder", "link", "dangling link"])
def test_whatever_lies_in_the_way_is_kept(tmp_path: Path, kind: str) -> None:
    (tmp_path / "elsewhere").write_text("mine")
    path = tmp_path / "deep/run.json"
    path.parent.mkdir()
    if kind == "file":
        path.write_text("mine")
    elif kind == "folder":
        path.mkdir()
        (path / "x").write_text("mine")
    else:
        path.symlink_to("../elsewhere" if kind == "link" else "../nowhere")
    assert write_owned(tmp_path, "deep/run.json", "ours") == "deep/run.json.yours-1"
    assert path.read_text() == "ours" and not path.is_symlink()
    kept = tmp_path / "deep/run.json.yours-1"
    assert (
        (kept / "x").read_text() == "mine"
        if kind == "folder"
        else kind == "dangling link" or (kept.read_text() == "mine")
    )
    assert (tmp_path / "elsewhere").read_text() == "mine"


def test_the_same_content_is_ours(tmp_path: Path) -> None:
    (tmp_path / "a").write_text("same")
    assert write_owned(tmp_path, "a", b"same") is None


def test_a_process_that_dies_on_the_way_leaves_nothing_that_looks_foreign(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    write_owned(tmp_path, "a", "one")
    real = Path.replace
    for at in range(1, 10):
        left = at

        def dies(self: Path, target: Path) -> Path:
            nonlocal left
            left -= 1
            if left == 0:
                raise KeyboardInterrupt
            return real(self, target)

        with monkeypatch.context() as m, suppress(KeyboardInterrupt):
            m.setattr(Path, "replace", dies)
            write_owned(tmp_path, "a", f"text {at}")
        assert write_owned(tmp_path, "a", f"next {at}") is None, at
    assert visible(tmp_path) == {"a": "next 9"}


# ------------------------------------------------------------------ a run
def ran(photos: Path, out: Path, notes: list[str] | None = None, **changes: Any) -> Plan:
    plan = make_plan(RunRequest(capture=str(photos), out=str(out), **changes))
    plan.out.mkdir(exist_ok=True)
    publish(plan, run_stages(plan), (notes if notes is not None else []).append)
    return plan


def test_a_foreign_run_json_is_kept_and_told(photos: Path, tmp_path: Path) -> None:
    out, notes = tmp_path / "out", list[str]()
    out.mkdir()
    (out / "run.json").write_text('{"mine": 1}')
    ran(photos, out, notes)
    assert (out / "run.json.yours-1").read_text() == '{"mine": 1}'
    assert any("run.json.yours-1" in n for n in notes)
    ran(photos, out, notes)
    assert not (out / "run.json.yours-2").exists()
    (out / "run.json").write_text((out / "run.json").read_text() + " ")  # edited
    ran(photos, out)
    assert (out / "run.json.yours-2").read_text().endswith(" ")


def test_a_run_json_of_a_version_without_lists_is_ours(photos: Path, tmp_path: Path) -> None:
    out = tmp_path / "out"
    ran(photos, out)
    (out / LIST).unlink()
    ran(photos, out)
    assert sorted(visible(out)) == ["run.json"]


def test_a_run_stopped_while_it_publishes_replaces_nothing(photos: Path, tmp_path: Path) -> None:
    out = tmp_path / "out"
    plan = ran(photos, out)
    before = (out / "run.json").read_bytes()
    with pytest.raises(Cancelled):
        publish(plan, run_stages(plan), stopped=lambda: True)
    assert (out / "run.json").read_bytes() == before
    assert not [p for p in out.iterdir() if ".partial" in p.name or ".swap" in p.name]


def test_an_error_after_the_swap_does_not_remove_the_old_folder(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    """It holds the user's files; what changed meanwhile was not rescued yet."""

    def fill(folder: Path) -> None:
        (folder / "new").write_text("new")

    (tmp_path / "asset").mkdir()
    (tmp_path / "asset/mine").write_text("mine")
    made = replace.prepare(tmp_path, "asset", fill, {})
    (tmp_path / "asset/late").write_text("late")

    def fails(*_: Any) -> Any:
        raise OSError(5, "Input/output error")

    with monkeypatch.context() as m, pytest.raises(OSError):
        m.setattr(replace, "_rescue", fails)
        replace.put(made)
    replace.drop(made)
    assert {p.read_text() for p in tmp_path.rglob("*") if p.is_file()} == {"new", "mine", "late"}
    replace.tidy(tmp_path, "asset", {"asset/new": frozenset()})
    assert {p.name for p in (tmp_path / "asset").iterdir()} == {"new", "mine", "late"}


@pytest.mark.parametrize("name", [".asset.partial-mine", ".asset.old-backup", ".asset.swap-0", ".run.json.partial-x"])
def test_hidden_names_of_the_users_own_are_left_alone(photos: Path, tmp_path: Path, name: str) -> None:
    out = tmp_path / "out"
    (out / name).mkdir(parents=True)
    (out / name / "x").write_text("mine")
    ran(photos, out)
    assert (out / name / "x").read_text() == "mine"


def test_the_store_lies_apart(photos: Path, tmp_path: Path) -> None:
    (tmp_path / "link").symlink_to(photos)
    for store in (photos, tmp_path / "link", tmp_path / "out/asset", tmp_path / "out/report/deep"):
        with pytest.raises(UsageError, match="--store"):
            make_plan(RunRequest(capture=str(photos), out=str(tmp_path / "out"), store=str(store)))
    make_plan(RunRequest(capture=str(photos), out=str(tmp_path / "out"), store=str(photos / ".store")))


# ------------------------------------------------------------------ batch, render, bench
def test_a_batchs_tables(tmp_path: Path) -> None:
    request = BatchRequest(root=str(tmp_path), out=str(tmp_path))
    request.folder.mkdir()
    (request.folder / "index.html").write_text("my page")
    for _ in range(3):
        write_page(request, Summary())
    assert (request.folder / "index.html.yours-1").read_text() == "my page"
    assert sorted(visible(request.folder)) == sorted([*TABLES, "index.html.yours-1"])
    (request.folder / LIST).unlink()  # as an older version left it
    write_page(request, Summary())
    assert sorted(visible(request.folder)) == sorted([*TABLES, "index.html.yours-1"])


def test_pictures_rendered_among_the_photos(tmp_path: Path) -> None:
    (tmp_path / "2.exr").write_text("a photo")
    notes: list[str] = []
    for _ in range(2):
        put_file(tmp_path, "2.exr", write_exr, np.zeros((4, 4, 4), np.float32), notes.append)
    assert len(notes) == 1 and "2.exr.yours-1" in notes[0]
    assert (tmp_path / "2.exr.yours-1").read_text() == "a photo"
    assert sorted(p.name for p in tmp_path.iterdir()) == [LIST, "2.exr", "2.exr.yours-1"]


def test_cameras_that_are_not_there(tmp_path: Path) -> None:
    with pytest.raises(UsageError, match="--cameras"):
        given_cameras(tmp_path / "params.json", tmp_path)


# ------------------------------------------------------------------ store
def test_gc_takes_nothing_from_a_folder_that_is_no_store(tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    other = tmp_path / "cache/blobs" / ("a" * 64)  # as other programs name theirs
    other.mkdir(parents=True)
    (other / "mine").write_text("x")
    os.utime(other, (0, 0))
    assert main(["store", "gc", str(tmp_path / "cache")]) == 1
    assert "there is no store" in capsys.readouterr().err
    (tmp_path / "cache" / LOCKS).mkdir()  # a store in a folder that has other things
    assert garbage(Store(tmp_path / "cache"), 0) == []
    assert (other / "mine").is_file()


def test_purge_keeps_what_is_the_users(photos: Path, tmp_path: Path) -> None:
    out = tmp_path / "parent/out"
    out.parent.mkdir()
    plan = ran(photos, out)
    mine = {"truth/own.txt", "truth.json", ".notes.partial-x"}
    for name in mine:
        (out / name).parent.mkdir(exist_ok=True)
        (out / name).write_text("mine")
    write_owned(out, "truth/ours.json", "{}")
    (plan.store.root / LINEAGE / "second-.json").write_text(json.dumps({"source": [str(photos)]}))  # no key: all of it
    others = plan.store.root / "second/others"
    others.mkdir()
    (out / "mine/empty").mkdir(parents=True)
    found = belongings(photos.name, out, plan.store)
    assert purge(found, plan.store) == []
    assert others.is_dir() and (out / "mine/empty").is_dir()
    assert {n for n in mine if (out / n).exists()} == mine and not (out / "run.json").exists()
    assert not (out / "truth/ours.json").exists()
    assert {p.relative_to(out).as_posix() for p in found.users} >= {"truth/own.txt", "truth.json"}


def test_purge_leaves_the_parent_of_the_named_folder(photos: Path, tmp_path: Path) -> None:
    out, store = tmp_path / "parent/out", tmp_path / "store"
    out.parent.mkdir()
    plan = ran(photos, out, store=str(store))
    purge(belongings(photos.name, out, plan.store), plan.store)
    assert out.parent.is_dir()


def test_purge_unlinks_no_link(photos: Path, tmp_path: Path) -> None:
    out, elsewhere = tmp_path / "out", tmp_path / "elsewhere"
    plan = ran(photos, out)
    elsewhere.mkdir()
    (out / "asset").symlink_to(elsewhere)
    purge(belongings(photos.name, out, plan.store), plan.store)
    assert (out / "asset").is_symlink()


def test_purge_of_a_batch_keeps_a_foreign_table(photos: Path, tmp_path: Path) -> None:
    from workflows.batch.captures import RECORDS
    from workflows.store.gc import _tables

    folder = tmp_path / RECORDS
    write_owned(folder, "summary.csv", "ours")
    (folder / "index.html").write_text("mine")
    assert _tables(folder) == ({folder / "summary.csv"}, {folder / "index.html"})
