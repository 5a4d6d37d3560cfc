"""No figure of docs/benchmarks is older than so many changes of the code that it is about."""

from __future__ import annotations

import subprocess
from pathlib import Path

import pytest

from benchmarks import record_ages
from benchmarks.record_ages import CONCERNED, FOLDER, MOST, ROOT, Made, all_made, changes, has_history, made


def test_every_record_has_its_code_and_its_day() -> None:
    """mutations.json has no days: tests/docs/test_mutations.py makes each of its changes in the present text."""
    assert {p.stem for p in FOLDER.glob("*.json")} - {"mutations"} == set(CONCERNED)
    assert all((ROOT / path).exists() for paths in CONCERNED.values() for path in paths)
    found = all_made()
    assert all(CONCERNED[m.record] or m.code for m in found)
    assert {m.record for m in found} == set(CONCERNED) and all(len(m.date) == 10 for m in found)


@pytest.mark.skipif(not has_history(), reason="this is no repository with its history")
def test_no_record_is_too_old() -> None:
    assert [f"{m.record} {m.row}: {n} changes" for m in all_made() if (n := changes(m)) is not None and n > MOST] == []


def test_records_of_each_form_are_read() -> None:
    assert list(made("soak", {"made": "2 cores, 2026-11-24, load; commit 423301bf91; Postgres"})) == [
        Made("soak", "", "2026-11-24", "423301bf91")
    ]
    assert list(made("captures", {"format": 1, "rows": {"a": {"date": "2026-01-02", "commit": "abc1234+"}}})) == [
        Made("captures", "a", "2026-01-02", "abc1234")
    ]
    assert list(made("speed", {"machine": {"date": "2026-01-02"}, "sh": {}})) == [Made("speed", "", "2026-01-02")]
    assert list(made("signals", {"INT": {"made": "on 2026-01-02; before", "cells": {}}})) == [
        Made("signals", "INT", "2026-01-02")
    ]
    table = {"date": "2026-01-02", "commit": "abc1234", "code": ["stages"], "rows": [["1"]]}
    tables = {"a": {"kind": "current", **table}, "b": {"kind": "kept", **table}}  # what is kept has no age
    assert list(made("history", tables)) == [Made("history", "a", "2026-01-02", "abc1234", ("stages",))]


def test_changes_are_those_of_the_code_concerned(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    """In a repository made here: three changes of the code and one of something else; two since the record's commit."""

    def git(*words: str) -> str:
        settings = ["-c", "user.name=a", "-c", "user.email=a@b", "-c", "commit.gpgsign=false"]
        return subprocess.run(
            ["git", *settings, *words], cwd=tmp_path, check=True, capture_output=True, text=True
        ).stdout.strip()

    git("init", "-q")
    names = []
    for n, path in enumerate(["code", "code", "other", "code"]):
        (tmp_path / path).write_text(str(n))
        git("add", "-A")
        git("commit", "-qm", str(n))
        names.append(git("rev-parse", "--short=10", "HEAD"))
    monkeypatch.setattr(record_ages, "ROOT", tmp_path)
    monkeypatch.setitem(CONCERNED, "speed", ("code",))
    today = git("log", "-1", "--format=%ad", "--date=short")
    assert changes(Made("speed", "", today, names[0])) == 2 and changes(Made("speed", "", today, names[3])) == 0
    assert changes(Made("speed", "", today, "0123456789")) == 3  # no such commit: all of its day
    assert changes(Made("speed", "", "2099-01-01")) == 0
    assert changes(Made("history", "a", today, names[0], ("other",))) == 1  # of its own code
    monkeypatch.setattr(record_ages, "ROOT", tmp_path / "code")
    assert changes(Made("speed", "", today)) is None and not has_history()
