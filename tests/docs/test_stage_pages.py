"""docs/stages has a page for each stage, and its table of files is the stage's own."""

from __future__ import annotations

import re
from pathlib import Path

import pytest

from stages.registry import EVERY

ROOT = Path(__file__).resolve().parents[2]
ROW = re.compile(r"^\| `([\w/]+\.py)` \| \S", re.M)
CHECKS = re.compile(r"^\| (\w+) \| `([^`]+)` \|", re.M)
NAMES = [s.name for s in EVERY]


def page(name: str) -> str:
    return (ROOT / f"docs/stages/{name}.md").read_text()


def files(name: str) -> set[str]:
    folder = ROOT / "stages" / name
    return {p.relative_to(folder).as_posix() for p in folder.rglob("*.py") if p.name != "__init__.py"}


def test_there_is_a_page_for_each_stage_and_no_other() -> None:
    assert {p.stem for p in (ROOT / "docs/stages").glob("*.md")} == set(NAMES)


@pytest.mark.parametrize("name", NAMES)
def test_a_page_lists_every_file_of_its_stage_once_and_none_that_is_not_there(name: str) -> None:
    listed = ROW.findall(page(name).partition("## Files")[2])
    assert sorted(listed) == sorted(files(name))


@pytest.mark.parametrize("name", NAMES)
def test_a_page_names_no_python_file_that_is_not_there(name: str) -> None:
    for path in re.findall(r"`([\w/]+\.py)`", page(name)):
        assert (ROOT / "stages" / name / path).is_file() or (ROOT / path).is_file(), path


@pytest.mark.parametrize("name", NAMES)
def test_a_page_names_every_check_of_its_stage(name: str) -> None:
    own = {check for stage, check in CHECKS.findall((ROOT / "docs/verdict.md").read_text()) if stage == name}
    text = page(name).partition("## Checks")[2].partition("## Limits")[0]
    assert own <= set(re.findall(r"`([\w*]+)`", text))


@pytest.mark.parametrize("name", NAMES)
def test_a_page_names_only_settings_that_there_are(name: str) -> None:
    known = {f"{s.name}.{key}" for s in EVERY for key in s.config.model_fields}
    stages = "|".join(NAMES)
    named = re.findall(rf"`((?:{stages})\.[a-z]\w*)(?:=[^`]*)?`", page(name))
    assert {n for n in named if not n.endswith((".py", ".npz"))} <= known


@pytest.mark.parametrize("name", NAMES)
def test_a_page_names_only_fields_of_its_manifest(name: str) -> None:
    stage = next(s for s in EVERY if s.name == name)
    output = page(name).partition("## Output")[2].partition("## Settings")[0]
    assert f"`{stage.output.__name__}`" in output
    table = output.partition("| field |")[2]
    for row in re.findall(r"^\| (`[^|]*`) \|", table, re.M):
        for field in re.findall(r"`(\w+)`", row):
            assert field in stage.output.model_fields, field
