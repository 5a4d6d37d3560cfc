"""The empty database that runs begin with."""

from __future__ import annotations

import sqlite3
from contextlib import closing
from pathlib import Path

import pytest

from workflows import server_tables
from workflows.server_tables import DATABASE


@pytest.fixture(autouse=True)
def cache(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> Path:
    monkeypatch.setenv("XDG_CACHE_HOME", str(tmp_path / "cache"))
    return tmp_path / "cache"


def home_with(folder: Path, runs: int) -> Path:
    """A server's home whose last changes are still in the log beside its database."""
    folder.mkdir()
    with closing(sqlite3.connect(folder / DATABASE)) as db:
        db.execute("PRAGMA journal_mode = WAL")
        db.execute("CREATE TABLE flow_run (id INTEGER)")
        db.executemany("INSERT INTO flow_run VALUES (?)", [(i,) for i in range(runs)])
        db.commit()
    return folder


def tables(home: Path) -> list[str]:
    with closing(sqlite3.connect(home / DATABASE)) as db:
        return [name for (name,) in db.execute("SELECT name FROM sqlite_master WHERE type = 'table'")]


def test_the_next_home_begins_with_the_tables_of_the_first(tmp_path: Path) -> None:
    server_tables.keep(home_with(tmp_path / "a", runs=0))
    (tmp_path / "b").mkdir()
    server_tables.begin(tmp_path / "b")
    assert tables(tmp_path / "b") == ["flow_run"]
    assert [f.name for f in (tmp_path / "b").iterdir()] == [DATABASE]


def test_a_database_with_runs_is_not_kept(tmp_path: Path, cache: Path) -> None:
    server_tables.keep(home_with(tmp_path / "a", runs=1))
    assert not list(cache.rglob("*.*"))


def test_a_home_in_use_is_left_alone(tmp_path: Path) -> None:
    server_tables.keep(home_with(tmp_path / "a", runs=0))
    used = home_with(tmp_path / "b", runs=3)
    before = (used / DATABASE).read_bytes()
    server_tables.begin(used)
    assert (used / DATABASE).read_bytes() == before


@pytest.mark.parametrize("broken", ["no cache", "no folder for it", "a foreign file"])
def test_without_a_template_prefect_makes_its_own(tmp_path: Path, cache: Path, broken: str) -> None:
    if broken == "no folder for it":
        cache.write_text("a file where the folder would be")
    home = tmp_path / "a"
    home.mkdir()
    if broken == "a foreign file":
        (home / DATABASE).write_text("not a database")
        server_tables.keep(home)
        assert not server_tables.template().exists()
        return
    server_tables.begin(home)
    assert not list(home.iterdir())
    server_tables.keep(home_with(tmp_path / "b", runs=0))
    assert server_tables.template().exists() == (broken == "no cache")
