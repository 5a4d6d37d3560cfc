"""Tables of docs/benchmarks are those of the JSON files beside them, and figures of the README are too."""

from __future__ import annotations

import json
from collections.abc import Callable
from pathlib import Path
from typing import Any

import pytest

from benchmarks import kill_batch, kill_matrix, kill_pool, soak_record
from stages.registry import REGISTRY
from workflows.bench import ablations, speed, tradeoff
from workflows.bench.captures import read_table
from workflows.bench.captures_table import markdown
from workflows.bench.tradeoff_measure import Measured
from workflows.bench.tradeoff_plot import plot

FOLDER = Path(__file__).resolve().parents[2] / "docs" / "benchmarks"


def content(name: str) -> Any:
    return json.loads((FOLDER / f"{name}.json").read_text())


def points() -> dict[str, Measured]:
    return {name: Measured(**point) for name, point in content("tradeoff")["points"].items()}


def tradeoff_page() -> str:
    found = content("tradeoff")
    return "\n".join(tradeoff.report(found["machine"], found["budget"], points())) + "\n"


PAGES: dict[str, Callable[[], str]] = {
    "captures.md": lambda: markdown(read_table(FOLDER / "captures.json")),
    "speed.md": lambda: "\n".join(speed.report(content("speed"))) + "\n",
    "tradeoff.md": tradeoff_page,
    "tradeoff.svg": lambda: plot({k: (m.seconds, m.psnr) for k, m in points().items()}, tradeoff.front(points())),
}


@pytest.mark.parametrize("name", PAGES)
def test_the_page_is_made_of_its_record(name: str) -> None:
    """A figure that was changed by hand on one side alone is found, and a table that the code would write otherwise."""
    assert (FOLDER / name).read_text() == PAGES[name]()


def test_the_tables_of_the_ablations_are_made_of_their_record() -> None:
    """Made by: neuface bench ablations CAPTURE --out DIR. Lines are wrapped on the page."""
    found = content("ablations")
    made = "\n".join(ablations.report(found["budget"], {k: ablations.Result(**v) for k, v in found["rows"].items()}))
    _, *tables = made.split("\n**")
    page = (FOLDER.parent / "model.md").read_text()
    flat = " ".join(page[page.index("## Ablations on head_a") : page.index("## Accuracy of the")].split())
    assert len(tables) == len(ablations.TABLES)
    for table in tables:
        for block in f"**{table}".split("\n\n"):
            assert " ".join(block.split()) in flat, block
    assert set(found["rows"]) == {row.name for row in ablations.unique(ablations.TABLES)}
    assert found["commit"] in flat and found["date"] in flat


def test_the_table_of_signals_is_made_of_its_record_and_has_no_fault() -> None:
    """Made by: python -m benchmarks.kill_matrix FOLDER --write"""
    columns = kill_matrix.recorded()
    assert kill_matrix.table(columns) in kill_matrix.PAGE.read_text()
    names = {m.name for m in kill_matrix.moments({s.name: 1.0 for s in REGISTRY})}
    assert all(names <= set(columns[n].cells) for n in ("INT", "TERM", "HUP", "KILL"))
    assert not [(n, m) for n, c in columns.items() for m, cell in c.cells.items() if cell.is_fault()]


def test_the_table_of_a_batch_is_made_of_its_record_and_has_no_fault() -> None:
    """Made by: python -m benchmarks.kill_batch FOLDER --write"""
    columns = kill_batch.recorded()
    assert kill_batch.part(columns) in kill_matrix.PAGE.read_text()
    names = {*(m.name for m in kill_batch.MOMENTS), kill_batch.LAST}
    assert len(names) > 15 and all(set(columns[n].cells) == names for n in ("INT", "TERM", "HUP", "KILL"))
    for column in columns.values():
        assert set(column.cells) <= names and kill_batch.LAST in column.cells
        assert not any(cell.is_fault() for cell in column.cells.values())


def test_the_table_of_a_pool_s_workers_is_made_of_its_record_and_has_no_fault() -> None:
    """Made by: python -m benchmarks.kill_pool FOLDER --write"""
    columns = kill_pool.recorded()
    assert kill_pool.part(columns) in kill_matrix.PAGE.read_text()
    assert set(columns) == {"INT", "TERM", "HUP", "KILL"}
    names = {*(m.name for m in kill_pool.MOMENTS), kill_pool.LAST}
    for column in columns.values():
        assert len(names) > 15 and set(column.cells) == names
        assert not any(cell.is_fault() for cell in column.cells.values())


def test_the_soak_is_that_of_its_record_and_has_no_fault() -> None:
    """Made by: python -m benchmarks.soak FOLDER --write"""
    found = soak_record.recorded()
    assert soak_record.PAGE.read_text() == soak_record.page(found)
    assert not found.faults and found.captures >= 40 and found.stored == 3 * found.captures


# ------------------------------------------------------------------ the README
README = FOLDER.parents[1] / "README.md"


def row_of(text: str, start: str) -> list[str]:
    """The cells of the one row of a table that starts with this."""
    (found,) = [line for line in text.splitlines() if line.startswith(f"| {start}")]
    return [cell.strip() for cell in found.strip("|").split("|")]


def test_figures_of_the_readme_are_those_of_the_captures() -> None:
    """The draft's row, and each figure of the sentences below the table."""
    text = README.read_text()
    rows = content("captures")["rows"]
    figures = {name: row["figures"] for name, row in rows.items()}
    said = " ".join(text.split())
    names = ["one", "two", "three", "four", "five", "six", "seven", "eight", "nine", "ten", "eleven", "twelve"]
    assert row_of(text, "draft |")[2] == f"{figures['head_a']['asset_psnr']:.1f}"
    assert f"captures.md` has {names[len(rows) - 1]} captures" in said
    assert f"his face within {figures['person_e']['depth_median_mm']:.1f} mm (median)" in said
    for name, level, sentence in (
        ("selfie_man", "usable", "from the front is {level}, at {psnr} dB."),
        ("selfie_woman", "usable", "in front of a bright wall has {psnr} dB"),
        ("person_e", "usable", "A rendered man in a rig is {level},"),
        ("skull_studio", "usable", "A skull in a studio is {level}, at {psnr} dB:"),
    ):
        assert rows[name]["verdict"]["level"] == level
        assert sentence.format(level=level, psnr=f"{figures[name]['asset_psnr']:.1f}") in said, name


@pytest.mark.parametrize(
    ("readme", "benchmarks"),
    [
        ("`--budget 10m` | 9", "the same | `--budget 10m`"),
        ("studio, at twice the resolution", "the same, scored at 1024 px, the others at 512 | studio"),
        ("film, at twice the resolution", "the same, scored at 1024 px | film"),
        ("draft, photos alone without cameras", "the same photos alone, cameras solved | draft"),
    ],
)
def test_rows_that_have_no_record_agree_on_both_pages(readme: str, benchmarks: str) -> None:
    """PSNR of the asset, and the median distance, of runs that were made before figures were kept as JSON."""
    ours = row_of(README.read_text(), readme)
    theirs = row_of((FOLDER.parent / "benchmarks.md").read_text(), benchmarks)
    assert ours[2] == theirs[4] and ours[3] == theirs[5].partition("/")[0].strip()
