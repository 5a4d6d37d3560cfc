"""docs/troubleshooting.md and docs/photographing.md name checks and settings by the names that they have."""

from __future__ import annotations

import re
from pathlib import Path

import pytest

from stages.registry import REGISTRY

DOCS = Path(__file__).resolve().parents[2] / "docs"
CHECK = re.compile(r"^\| \w+ \| `([^`]+)` \|", re.M)
SNAKE = re.compile(r"`([a-z][a-z0-9*]*(?:_[a-z0-9*]+)+)`")
STAGES = "|".join(s.name for s in REGISTRY)
SETTING = re.compile(rf"\b((?:{STAGES})\.[a-z]\w*)")
NOT_CHECKS = {"clean_plate", "neuface_basis"}
PAGES = ("troubleshooting.md", "photographing.md")


def checks() -> set[str]:
    return set(CHECK.findall((DOCS / "verdict.md").read_text()))


def test_each_check_under_a_heading_of_checks_is_in_the_table() -> None:
    text = (DOCS / "troubleshooting.md").read_text()
    lists = re.findall(r"\*\*Checks?:\*\*(.*?)(?:\n\n|$)", text, re.S)
    named = {name for part in lists for name in re.findall(r"`([a-z]\w*\*?)`", part) if "." not in name}
    assert len(lists) >= 10 and named - checks() == set()


def test_every_check_is_somewhere_on_the_page() -> None:
    text = (DOCS / "troubleshooting.md").read_text()
    assert {c for c in checks() if f"`{c}`" not in text} == set()


def test_every_check_says_itself_what_to_do() -> None:
    """The last column of the table is what a run prints after "What to do:"."""
    rows = [r for r in (DOCS / "verdict.md").read_text().splitlines() if CHECK.match(r)]
    assert len(rows) > 80 and [r for r in rows if len(r.strip(" |").rsplit("|", 1)[1].split()) < 2] == []


@pytest.mark.parametrize("page", PAGES)
def test_a_page_names_no_check_that_there_is_not(page: str) -> None:
    assert set(SNAKE.findall((DOCS / page).read_text())) - checks() - NOT_CHECKS == set()


@pytest.mark.parametrize("page", PAGES)
def test_a_page_names_no_setting_that_there_is_not(page: str) -> None:
    known = {f"{s.name}.{key}" for s in REGISTRY for key in s.config.model_fields}
    named = SETTING.findall(re.sub(r"\]\([^)]*\)", "]", (DOCS / page).read_text()))
    assert set(named) - known == set()
