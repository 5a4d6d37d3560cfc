"""What the table and the page of a batch say."""

from __future__ import annotations

import csv
import json
import time
from pathlib import Path

import pytest

from tests.support.scripted_batch import Scripted, capture_tree, go, request
from workflows.batch.failures import Failure
from workflows.batch.loop import run_batch
from workflows.batch.page import ODD, Row, ranked, write_page
from workflows.batch.request import BatchRequest
from workflows.batch.state import Entry, Summary


@pytest.fixture
def tree(tmp_path: Path) -> Path:
    return capture_tree(tmp_path)


def rows(figures: list[float]) -> list[Row]:
    return [Row(f"c{i}", "done", 1, figures={"psnr": v}) for i, v in enumerate(figures)]


def test_failed_first_then_the_odd_ones_then_by_name() -> None:
    table = [*rows([30, 31, 30.5, 12, 30.2, 29.8, 47]), Row("z", "failed", 1, fault="x")]
    assert [r.name for r in ranked(table)] == ["z", "c3", "c6", "c0", "c1", "c2", "c4", "c5"]


def test_the_verdict_comes_before_odd_figures() -> None:
    table = rows([30, 31, 30.5, 12, 30.2, 29.8, 47])
    table[5].level, table[4].level, table[6].level, table[0].level = "unusable", "usable", "usable", "good"
    assert [r.name for r in ranked([*table, Row("z", "failed", 1)])] == ["z", "c5", "c6", "c4", "c3", "c0", "c1", "c2"]


def test_the_page_shows_and_counts_verdicts(tree: Path) -> None:
    asked = request(tree)
    out = Path(asked.out)
    run_batch(asked, Scripted(out, {}, levels={"2/1_neutral": "unusable", "1/1_neutral": "good"}))
    finding = {"stage": "masks", "said": "36 <of> 40 masks are empty."}
    (out / "2/1_neutral/run.json").write_text(json.dumps({"verdict": {"level": "unusable", "findings": [finding]}}))
    run_batch(asked, Scripted(out, {}))
    page = (out / "batch/index.html").read_text()
    assert "1 unusable, 0 usable, 1 good" in page and '<td class="level unusable">unusable</td>' in page
    assert "36 &lt;of&gt; 40 masks are empty." in page and "36 <of>" not in page
    assert page.index("2/1_neutral") < page.index("1/1_neutral")
    assert "<h1>5 of 5 captures done</h1>" in page
    table = list(csv.DictReader((out / "batch/summary.csv").open()))
    assert (table[0]["verdict"], table[0]["state"], table[0]["reason"]) == ("unusable", "unusable", finding["said"])
    assert json.loads((out / "batch/summary.json").read_text())["levels"] == {"unusable": 1, "usable": 0, "good": 1}


def test_robust_score_against_its_definition() -> None:
    values = [30.0, 31, 30.5, 12, 30.2, 29.8]
    found = {r.name: r.odd for r in ranked(rows(values))}
    # median 30.1; deviations .1 .9 .4 18.1 .1 .3 -> median .35
    assert found["c3"] == pytest.approx(0.6745 * 18.1 / 0.35, abs=0.01)
    assert found["c1"] == pytest.approx(0.6745 * 0.9 / 0.35, abs=0.01)


def test_equal_figures_and_few_of_them_are_never_odd() -> None:
    assert all(r.odd < ODD for r in ranked(rows([30.0] * 9 + [30.01])))
    assert all(r.odd == 0 for r in ranked(rows([1.0, 1.0, 99.0])))


def test_the_page_escapes_and_links(tree: Path) -> None:
    evil = Failure(kind="capture", message="<script>alert(1)</script> in a.jpg")
    out = tree.parent / "out"
    for name in ("asset/thumbnails/default.png", "report/index.html"):
        (out / "1/1_neutral" / name).parent.mkdir(parents=True)
        (out / "1/1_neutral" / name).write_bytes(b"x")
    go(tree, {"2/1_neutral": [evil]})
    page = (out / "batch/index.html").read_text()
    assert page.count("<script") == 1 and "<script>alert" not in page and "&lt;script&gt;" in page
    assert 'src="../1/1_neutral/asset/thumbnails/default.png"' in page
    assert 'href="../1/1_neutral/report/index.html"' in page
    assert page.index("2/1_neutral") < page.index("1/1_neutral")
    table = list(csv.DictReader((out / "batch/summary.csv").open()))
    assert [r["state"] for r in table] == ["failed", "done", "done", "done", "done"]


@pytest.mark.slow
def test_a_table_of_the_whole_data_set_takes_as_much_for_each_capture(tmp_path: Path) -> None:
    """7,180 captures: the page is written every few seconds while the batch runs. Ten times the captures of another
    table may take sixty times as long on a busy machine; work that grows with their square would take a hundred."""
    asked = BatchRequest(root=str(tmp_path), out=str(tmp_path / "out"))

    def seconds(subjects: int) -> float:
        entries = [Entry(name=f"{s}/{e}", capture="/c") for s in range(subjects) for e in range(20)]
        begin = time.process_time()
        write_page(asked, Summary(entries))
        return time.process_time() - begin

    few = min(seconds(36) for _ in range(3))
    assert min(seconds(359) for _ in range(3)) < 60 * few
    assert (asked.folder / "index.html").stat().st_size < 8e6
