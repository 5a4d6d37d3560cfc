"""docs/settings.md has every setting as the stages' configs have it."""

from __future__ import annotations

from pathlib import Path

from benchmarks import settings_page
from benchmarks.generated import print_or_write
from stages.settings import Setting


def test_the_page_has_the_tables_that_the_code_makes() -> None:
    """Make them anew with: python -m benchmarks.settings_page --write"""
    assert settings_page.tables() in settings_page.PAGE.read_text()


def test_a_row_keeps_a_bar_in_its_cell() -> None:
    s = Setting("capture", "rule", "a | b", "photos", "1 or 2", 1, {"draft": 1, "film": 2})
    assert settings_page.row(s) == "| `rule` | 1 photos | 1 or 2 | film 2 | a \\| b |"


def test_writing_mends_a_stale_page_and_keeps_the_rest(tmp_path: Path) -> None:
    page = tmp_path / "settings.md"
    page.write_text(f"above\n{settings_page.BEGIN}\nstale\n{settings_page.END}\nbelow\n")
    assert print_or_write(["--write"], page, settings_page.tables()) == 0
    assert page.read_text() == f"above\n{settings_page.tables()}\nbelow\n"
