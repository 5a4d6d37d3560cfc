"""docs/architecture.md is a map of the code that leaves nothing out, and its flow of a run names what exists."""

from __future__ import annotations

import re
from pathlib import Path

import pytest

ROOT = Path(__file__).resolve().parents[2]
PAGE = ROOT / "docs/architecture.md"
FILE = re.compile(r"^\| `(\w+\.py)` \| \S", re.M)
STEP = re.compile(r"^\| \d+ \| (.+?) \| `([\w/]+\.py)` \|", re.M)
FOLDERS = {
    "pipeline": "## pipeline/: the core",
    "pipeline/maths": "### pipeline/maths/",
    "pipeline/fields": "### pipeline/fields/",
    "pipeline/faces": "### pipeline/faces/",
    "pipeline/template": "### pipeline/template/",
    "pipeline/demo": "### pipeline/demo/",
    "stages": "## stages/",
    "workflows": "## workflows/",
    "workflows/cli": "### workflows/cli/",
    "workflows/run": "### workflows/run/",
    "workflows/live": "### workflows/live/",
    "workflows/server": "### workflows/server/",
    "workflows/batch": "### workflows/batch/",
    "workflows/compare": "### workflows/compare/",
    "workflows/store": "### workflows/store/",
    "workflows/bench": "### workflows/bench/",
    "workflows/evaluation": "### workflows/evaluation/",
}


def section(heading: str) -> str:
    """What follows a heading, up to the next one."""
    text = PAGE.read_text()
    assert text.count(f"\n{heading}\n") == 1, heading
    return re.split(r"^#", text.partition(f"\n{heading}\n")[2], maxsplit=1, flags=re.M)[0]


@pytest.mark.parametrize("folder", FOLDERS)
def test_every_file_of_a_folder_has_one_row_and_no_row_is_of_nothing(folder: str) -> None:
    there = sorted(p.name for p in (ROOT / folder).glob("*.py") if p.name != "__init__.py")
    assert sorted(FILE.findall(section(FOLDERS[folder]))) == there


def test_the_flow_of_a_run_names_functions_where_they_are() -> None:
    steps = STEP.findall(PAGE.read_text())
    assert len(steps) >= 10
    for calls, file in steps:
        code = (ROOT / file).read_text()
        for name in re.findall(r"`(\w+)`", calls):
            assert re.search(rf"\b(def|import) {name}\b", code), (name, file)


def test_every_path_on_the_page_exists() -> None:
    for path in re.findall(r"`((?:pipeline|stages|workflows)/[\w/]+\.py)`", PAGE.read_text()):
        assert (ROOT / path).is_file(), path
    for link in re.findall(r"\]\(([\w/]+\.md)\)", PAGE.read_text()):
        assert (ROOT / "docs" / link).is_file(), link
