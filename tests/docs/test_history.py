"""Tables of measurements in README.md and docs are those of docs/benchmarks/history.json, and none is without a record.

How old those of kind "current" may be: tests/docs/test_record_ages.py.
"""

from __future__ import annotations

from collections import Counter
from dataclasses import replace
from pathlib import Path

import pytest

from benchmarks.history import PAGES, ROOT, Table, cells, filled, found, recorded

# Tables with a column of numbers that are no measurements, or have a record of their own: page, begin of the header
NOT_MEASURED = {
    ("README.md", "exit code, meaning"),
    ("docs/architecture.md", "#, call"),  # steps of a run
    ("docs/licences.md", "package, version"),
    ("docs/licences.md", "part, version"),
    ("docs/model.md", "share of the steps, what happens"),  # the schedule of the fit
    ("docs/model.md", "system, PSNR"),  # docs/benchmarks/ablations.json
    ("docs/operations.md", "exit code, meaning"),
    ("docs/photographing.md", "what, good"),  # limits of checks
    ("docs/settings.md", "setting, default"),
    ("docs/troubleshooting.md", "exit code, meaning"),
    ("docs/usd.md", "name, tile"),
    ("docs/verdict.md", "code, `neuface run`, `demo`, `report`"),  # exit codes
}
TABLE = Table("README.md", "kept", "0123456", "2026-01-02", "", ["stages"], ["", "dB"], [["a", "1.0"], ["", r"2 \| 3"]])
TEXT = (
    "Before.\n\n  <!-- table: one -->\n  | | dB |\n  |---|---|\n  | a | 1.0 |\n  | | 2 \\| 3 |\n\n| b |\n|---|\n| c |\n"
)


@pytest.mark.parametrize("page", PAGES, ids=lambda page: page.name)
def test_the_tables_of_a_page_are_those_of_their_records(page: Path) -> None:
    """Made by: python -m benchmarks.history --write"""
    text = page.read_text()
    assert filled(text, recorded()) == text


def test_each_record_has_one_place_on_its_page() -> None:
    places = [(t.name, str(page.relative_to(ROOT))) for page in PAGES for t in found(page.read_text()) if t.name]
    assert sorted(places) == sorted((name, table.page) for name, table in recorded().items())
    assert sum(page.read_text().count("<!-- table: ") for page in PAGES) == len(places)  # none is away from its table


def test_each_table_of_figures_has_a_record() -> None:
    """A new table of measurements needs a record; one that is no measurement a line in NOT_MEASURED."""
    unnamed = {
        (str(page.relative_to(ROOT)), ", ".join(cells(table.lines[0])[:2]))
        for page in PAGES
        for table in found(page.read_text())
        if not table.name and table.has_figures()
    }
    assert unnamed == NOT_MEASURED


def test_each_record_says_what_it_is() -> None:
    """What is current can be measured again; only what is kept can have been replaced."""
    for name, table in recorded().items():
        assert table.kind in ("kept", "current"), name
        assert table.code and all((ROOT / path).exists() for path in table.code), name
        assert len(table.date) == len("2026-01-02") and len(table.commit) == 10, name
        assert all(len(row) == len(table.header) for row in table.rows), name
        if table.kind == "current":
            assert table.command and not table.newer, name
        assert not table.newer or (ROOT / table.newer).is_file(), name


def test_a_change_on_either_side_is_found() -> None:
    assert filled(TEXT, {"one": TABLE}) == TEXT
    assert filled(TEXT.replace("1.0", "1.1"), {"one": TABLE}) == TEXT
    changed = replace(TABLE, rows=[["a", "1.1"], TABLE.rows[1]])
    assert filled(TEXT, {"one": changed}) == TEXT.replace("1.0", "1.1")
    with pytest.raises(KeyError):
        filled(TEXT, {})


def test_tables_of_figures_are_told_by_a_column_of_numbers() -> None:
    one, other = found(TEXT)
    assert (one.name, other.name) == ("one", "") and one.has_figures() and not other.has_figures()
    first, *_ = found("| stage | limit |\n|---|---|\n| fit | at most 3 |\n| usd | none |\n")
    assert not first.has_figures()
    counted = Counter(t.has_figures() for t in found("| a | b |\n|-|-|\n| x | .5 dB |\n| y | - |\n| z | -3 mm |\n"))
    assert counted == {True: 1}
