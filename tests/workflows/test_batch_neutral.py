"""Measured expressions and the average head of a batch whose runs left heads that are known."""

from __future__ import annotations

import csv
import json
import os
import shutil
import time
from pathlib import Path
from typing import Any

import numpy as np
import pytest

from pipeline.errors import Cancelled, UsageError
from pipeline.registration.measured import dense
from pipeline.registration.shapes import load_shapes
from pipeline.store import Store
from tests.support.faked_heads import SHARES, Faked, face_tree
from tests.support.persons import expression, template
from tests.support.scripted_batch import BAD
from workflows.batch import average_picture
from workflows.batch.captures import Item
from workflows.batch.expressions import FACESCAPE, expression_name, is_called, shape_name
from workflows.batch.loop import run_batch
from workflows.batch.neutral import subjects
from workflows.batch.request import BatchRequest
from workflows.batch.state import Entry
from workflows.cli.main import main
from workflows.run.plan import check_settings
from workflows.store.gc import belongings, garbage, purge

CAPTURES = ("1/1_neutral", "1/2_smile", "1/3_mouth_stretch", "2/1_neutral", "2/16_grin")


@pytest.fixture
def tree(tmp_path: Path) -> Path:
    return face_tree(tmp_path, CAPTURES)


@pytest.fixture(autouse=True)
def small_pictures(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(average_picture, "SIDE", 32)


def asked(tree: Path, **changes: Any) -> BatchRequest:
    given = {"neutral": "1", **changes}
    return BatchRequest(root=str(tree), out=str(tree.parent / "out"), **given)


def faked(request: BatchRequest, **more: Any) -> Faked:
    return Faked(Path(request.out), request.store_path, **more)


def go(tree: Path, stopped: Any = lambda: False, **changes: Any) -> tuple[Any, Faked]:
    how = {n: changes.pop(n) for n in ("script", "levels", "unregistered", "unseen") if n in changes}
    request = asked(tree, **changes)
    runner = faked(request, **how)
    return run_batch(request, runner, stopped=stopped), runner


def runs_of(runner: Faked) -> list[tuple[str, str]]:
    """Each started run, and the setting with its measured expressions."""
    return [(n, next((s for s in sets if s.startswith("usd.measured=")), "")) for n, _, sets in runner.started]


# ------------------------------------------------------------------ names
def test_facescapes_names_lose_their_number_and_others_stay() -> None:
    assert len(FACESCAPE) == 20 and [int(n.partition("_")[0]) for n in FACESCAPE] == list(range(1, 21))
    assert expression_name("2_smile") == "smile" and expression_name("20_brow_lower") == "brow_lower"
    assert [expression_name(n) for n in ("2", "02_smile", "laughing", "21_smile")] == [
        "2",
        "02_smile",
        "laughing",
        "21_smile",
    ]
    assert shape_name("3_mouth_stretch") == "measured_mouth_stretch" and shape_name("a b.c") == "measured_a_b_c"


@pytest.mark.parametrize(
    ("folder", "wanted", "is_it"),
    [("1_neutral", "1", True), ("1_neutral", "01", True), ("10_dimpler", "1", False), ("1_neutral", "neutral", True),
     ("1_neutral", "1_neutral", True), ("rest", "rest", True), ("rest", "1", False), ("neutral", "neutral", True)],
)  # fmt: skip
def test_the_neutral_is_named_by_number_or_name(folder: str, wanted: str, is_it: bool) -> None:
    assert is_called(folder, wanted) == is_it


def test_people_and_expressions_come_from_lists_too(tmp_path: Path) -> None:
    items = [
        Item(name="a/1", capture=tmp_path),
        Item(name="b", capture=tmp_path, subject="a", expression="2_smile"),
        Item(name="c", capture=tmp_path, subject="a", expression="smile"),
        Item(name="single", capture=tmp_path),
    ]
    found = {p.name: p for p in subjects([(i, Entry(name=i.name, capture="x")) for i in items], "1")}
    assert set(found) == {"a", "single"} and found["single"].neutral is None
    assert found["a"].neutral is not None and found["a"].neutral.name == "a/1"
    assert list(found["a"].others) == ["measured_smile"] and found["a"].twice == ["c"]


# ------------------------------------------------------------------ settings
@pytest.mark.parametrize(
    ("changes", "said"),
    [
        ({"sets": ("uv.mesh=scan",)}, "uv.mesh"),
        ({"config": {"uv": {"mesh": "scan"}}}, "uv.mesh"),
        ({"sets": ("template.enabled=false",)}, "template.enabled"),
        ({"sets": ("usd.expressions=false",)}, "usd.expressions"),
        ({"until": "bake"}, "--until"),
        ({"neutral": None, "average": True, "until": "template"}, "--until"),
        ({"neutral": "laughing"}, "laughing"),
    ],
)
def test_settings_that_leave_no_head_are_refused_before_anything_runs(
    tree: Path, changes: dict[str, Any], said: str
) -> None:
    request = asked(tree, **changes)
    runner = faked(request)
    with pytest.raises(UsageError, match=said):
        run_batch(request, runner)
    assert not runner.started and not Path(request.out).exists()


@pytest.mark.parametrize(
    ("changes", "mesh"),
    [({}, "template"), ({"sets": ("uv.mesh=both",)}, "both"), ({"config": {"uv": {"mesh": "both"}}}, "both"),
     ({"neutral": None}, "auto"),
     ({"neutral": None, "average": True}, "template"), ({"config": {"uv": {"rest": False}}}, "template")],
)  # fmt: skip
def test_the_asset_is_made_from_the_template_if_nothing_was_said(
    tree: Path, changes: dict[str, Any], mesh: str
) -> None:
    configs = check_settings(asked(tree, **changes).run_request(tree / "1/1_neutral", "1/1_neutral", (), {}))
    assert configs["uv"].mesh == mesh  # type: ignore[attr-defined]
    assert configs["uv"].rest == ("rest" not in str(changes))  # type: ignore[attr-defined]


def test_a_capture_named_average_is_in_the_way(tmp_path: Path) -> None:
    tree = face_tree(tmp_path, ("average/1_neutral", "1/1_neutral"))
    with pytest.raises(UsageError, match="--average"):
        run_batch(asked(tree, average=True), faked(asked(tree)))


# ------------------------------------------------------------------ measured expressions
def test_the_neutral_is_run_again_with_the_others_as_shapes(tree: Path) -> None:
    summary, runner = go(tree)
    assert summary.failed == 0 and [bool(m) for _, m in runs_of(runner)] == [False] * 5 + [True] * 2
    assert [n for n, m in runs_of(runner) if m] == ["1/1_neutral", "2/1_neutral"]
    made = {m.subject: m for m in summary.measured}
    assert made["1"].shapes == {"measured_smile": "1/2_smile", "measured_mouth_stretch": "1/3_mouth_stretch"}
    assert made["2"].shapes == {"measured_grin": "2/16_grin"} and not made["1"].left_out
    shapes = load_shapes(Path(made["1"].file))
    lips = np.unique(template().quads[template().regions["lips"]])
    for offsets, called in zip(dense(shapes, 5040), ("2_smile", "3_mouth_stretch"), strict=True):
        assert 1000 * np.linalg.norm(offsets - expression(SHARES[called]), axis=1)[lips].max() < 0.3
    page = (Path(runner.out) / "batch/index.html").read_text()
    assert "measured_mouth_stretch" in page and "Measured expressions" in page
    rows = {r["name"]: r["measured"] for r in csv.DictReader((runner.out / "batch/summary.csv").open())}
    assert rows["1/2_smile"] == "measured_smile" and rows["1/1_neutral"] == "neutral, with 2 measured"


def test_the_same_command_again_runs_nothing(tree: Path) -> None:
    go(tree)
    key = sorted((asked(tree).store_path / "measured").glob("*/measured.npz"))
    before = [p.stat().st_mtime_ns for p in key]
    summary, runner = go(tree)
    assert runner.started == [] and len(summary.measured) == 2 and [p.stat().st_mtime_ns for p in key] == before


def test_a_new_expression_writes_one_asset_again(tree: Path) -> None:
    go(tree)
    (tree / "2/2_smile").mkdir()
    (tree / "2/2_smile/params.json").write_text("{}")
    (tree / "2/2_smile/0.jpg").write_bytes(b"new")
    _, runner = go(tree)
    assert [(n, bool(m)) for n, m in runs_of(runner)] == [("2/2_smile", False), ("2/1_neutral", True)]


def test_without_the_option_the_asset_is_written_without_shapes(tree: Path) -> None:
    go(tree, sets=("uv.mesh=template",))
    _, runner = go(tree, neutral=None, sets=("uv.mesh=template",))
    assert runs_of(runner) == [("1/1_neutral", ""), ("2/1_neutral", "")]
    assert (runner.out / "1/1_neutral/asset/head.usd").read_text() == ""


def test_expressions_that_can_t_be_used_are_left_out_and_named(tree: Path) -> None:
    summary, runner = go(
        tree,
        script={"1/2_smile": [BAD]},
        unregistered=("2/16_grin",),
        unseen=("1/3_mouth_stretch",),
    )
    made = {m.subject: m for m in summary.measured}
    assert made["1"].left_out["1/2_smile"] == "its run failed: bad photo"
    assert "both captures show only 0 %" in made["1"].left_out["1/3_mouth_stretch"]
    assert made["1"].reason == "no expression could be measured"
    assert "no face was found" in made["2"].left_out["2/16_grin"]
    assert made["2"].reason == "no other expression has a head"
    assert not any(m for _, m in runs_of(runner))
    page = (runner.out / "batch/index.html").read_text()
    assert "left out: its run failed: bad photo" in page and "no face was found" in page


def test_an_unusable_expression_is_left_out_and_the_others_stay(tree: Path) -> None:
    summary, _ = go(tree, levels={"1/2_smile": "unusable"})
    made = next(m for m in summary.measured if m.subject == "1")
    assert list(made.shapes) == ["measured_mouth_stretch"]
    assert made.left_out["1/2_smile"].startswith("its result is unusable")


@pytest.mark.parametrize(
    ("how", "said"),
    [
        ({"script": {"1/1_neutral": [BAD]}}, "its run failed: bad photo"),
        ({"unregistered": ("1/1_neutral",)}, "no face was found"),
        ({"levels": {"1/1_neutral": "unusable"}}, "unusable"),
    ],
)
def test_a_person_without_a_neutral_head_is_named_and_the_others_go_on(
    tree: Path, how: dict[str, Any], said: str
) -> None:
    summary, runner = go(tree, **how)
    made = {m.subject: m for m in summary.measured}
    assert said in made["1"].reason and not made["1"].shapes and list(made["2"].shapes) == ["measured_grin"]
    assert [n for n, m in runs_of(runner) if m] == ["2/1_neutral"]
    assert said in (runner.out / "batch/index.html").read_text()


def test_a_person_without_the_neutral_expression_is_named(tmp_path: Path) -> None:
    tree = face_tree(tmp_path, ("1/1_neutral", "1/2_smile", "2/2_smile"))
    summary, _ = go(tree)
    assert {m.subject: m.reason for m in summary.measured}["2"] == "there is no capture of the neutral expression"


def test_a_damaged_head_is_named_and_costs_no_other(tree: Path) -> None:
    _, runner = go(tree, neutral=None, sets=("uv.mesh=template",))
    record = json.loads((runner.out / "1/2_smile/run.json").read_text())
    head = runner.store / "template" / record["stages"]["template"]["key"] / "head.npz"
    head.write_bytes(head.read_bytes()[:1000])
    summary, _ = go(tree, sets=("uv.mesh=template",))
    made = {m.subject: m for m in summary.measured}
    assert "gone from the store, or was damaged" in made["1"].left_out["1/2_smile"]
    assert list(made["1"].shapes) == ["measured_mouth_stretch"] and list(made["2"].shapes) == ["measured_grin"]


def test_a_stop_in_between_is_resumed(tree: Path) -> None:
    request = asked(tree)
    runner = faked(request)
    with pytest.raises(Cancelled):
        run_batch(request, runner, stopped=lambda: len(runner.started) >= 6)
    assert [bool(m) for _, m in runs_of(runner)].count(True) >= 1
    again = faked(request)
    summary = run_batch(request, again)
    assert summary.failed == 0 and all(m for _, m in runs_of(again)) and len(again.started) <= 2
    assert all((Path(request.out) / f"{s}/1_neutral/asset/head.usd").read_text() for s in "12")


# ------------------------------------------------------------------ the average
def test_the_average_of_the_neutrals(tree: Path) -> None:
    summary, runner = go(tree, average=True)
    folder = runner.out / "average"
    assert {p.name for p in folder.iterdir()} == {
        "average.obj", "average.mtl", "average.png", "average.json",
        "average_albedo.1001.png", "average_albedo.1002.png",
    }  # fmt: skip
    record = json.loads((folder / "average.json").read_text())
    assert record["captures"] == ["1/1_neutral", "2/1_neutral"] and record["heads"] == 2 and record["metric"]
    assert record["sharpness"]["all"] == pytest.approx(1.0, abs=0.05)  # stripes that agree
    assert record["deviation_mm"]["face"]["median_mm"] > 0.5
    assert "average_albedo.1001.png" in (folder / "average.mtl").read_text()
    lines = (folder / "average.obj").read_text().splitlines()
    assert sum(x.startswith("f ") for x in lines) > 4000 and "mtllib average.mtl" in lines
    page = (runner.out / "batch/index.html").read_text()
    assert "Of 2 heads" in page and "../average/average.png" in page
    assert summary.average is not None and summary.average.captures == ("1/1_neutral", "2/1_neutral")


@pytest.mark.slow
def test_without_neutral_every_capture_counts_and_who_has_no_head_is_named(tree: Path) -> None:
    summary, runner = go(tree, neutral=None, average=True, unregistered=("1/2_smile",))
    assert len(summary.average.captures) == 4 and "no face" in summary.average.left_out["1/2_smile"]
    assert not any(m for _, m in runs_of(runner)) and summary.measured == []


def test_a_single_head_has_no_average(tree: Path) -> None:
    summary, runner = go(tree, average=True, subjects="1")
    assert summary.average.reason == "1 of 1 captures have a head with maps; an average takes 2"
    assert not (runner.out / "average").exists()
    assert "an average takes 2" in (runner.out / "batch/index.html").read_text()


@pytest.mark.slow
def test_the_average_is_reused_and_the_user_s_files_stay(tree: Path) -> None:
    _, runner = go(tree, average=True)
    folder = runner.out / "average"
    before = {p.name: p.stat().st_mtime_ns for p in folder.iterdir()}
    go(tree, average=True)
    assert {p.name: p.stat().st_mtime_ns for p in folder.iterdir()} == before
    (folder / "mine.txt").write_text("mine")
    (folder / "average.obj").write_text("edited")
    go(tree, average=True)
    assert (folder / "mine.txt").read_text() == "mine"
    assert any(p.read_text() == "edited" for p in folder.glob("average.obj.yours-*"))
    assert (folder / "average.obj").read_text().startswith("# Captured head")


# ------------------------------------------------------------------ purge, gc, preview
def test_purging_a_person_takes_the_average_and_the_shapes_along(tree: Path) -> None:
    _, runner = go(tree, average=True)
    out, store = runner.out, Store(runner.store)
    assert len(list((store.root / "measured").iterdir())) == 2 and len(list((store.root / "average").iterdir())) == 1
    assert purge(belongings("1", out, store), store) == []
    assert not (out / "average").exists() and not (out / "1/1_neutral/run.json").exists()
    assert len(list((store.root / "measured").iterdir())) == 1 and not list((store.root / "average").iterdir())
    assert (out / "2/1_neutral/asset/head.usd").is_file()
    summary, again = go(tree, average=True, subjects="2")
    assert again.started == [] and "takes 2" in summary.average.reason


def test_purging_one_expression_takes_the_asset_that_has_its_shape(tree: Path) -> None:
    _, runner = go(tree, average=True)
    out, store = runner.out, Store(runner.store)
    assert purge(belongings("1/2_smile", out, store), store) == []
    assert not (out / "1/1_neutral/run.json").exists() and (out / "2/1_neutral/run.json").exists()
    assert (out / "average/average.json").is_file()  # it holds the neutrals alone
    shutil.rmtree(tree / "1/2_smile")
    summary, again = go(tree, average=True)
    assert ("1/1_neutral", True) in [(n, bool(m)) for n, m in runs_of(again)]
    assert {m.subject: list(m.shapes) for m in summary.measured}["1"] == ["measured_mouth_stretch"]


@pytest.mark.slow
def test_a_file_of_the_user_s_beside_the_average_is_named_and_stays(tree: Path) -> None:
    _, runner = go(tree, average=True)
    (runner.out / "average/mine.txt").write_text("mine")
    found = belongings("1", runner.out, Store(runner.store))
    assert runner.out / "average/mine.txt" in found.users
    purge(found, Store(runner.store))
    assert [p.name for p in (runner.out / "average").iterdir()] == ["mine.txt"]


def test_gc_keeps_the_shapes_that_a_published_asset_has(tree: Path) -> None:
    _, runner = go(tree)
    then = time.time() - 30 * 86400
    for path in runner.store.glob("[a-z]*/*"):
        os.utime(path, (then, then))
    kinds = {p.path.parent.name for p in garbage(Store(runner.store), 86400)}
    assert "measured" not in kinds and "usd" in kinds  # the assets without shapes


def test_a_dry_run_says_what_would_happen_and_writes_nothing(tree: Path, capsys: pytest.CaptureFixture[str]) -> None:
    out = tree.parent / "out"
    options = ["batch", str(tree), "--out", str(out), "--neutral", "neutral", "--average", "--dry-run"]
    assert main(options) == 0
    said = capsys.readouterr().out
    assert "1/2_smile" in said and "runs (attempt 1)" in said and "of up to 2 heads" in said
    assert "measured on 1/1_neutral: measured_smile, measured_mouth_stretch" in said and not out.exists()
    go(tree, neutral="neutral", average=True)
    assert main(options) == 0
    assert "done before" in (said := capsys.readouterr().out) and "runs" not in said
