"""What a soak and a killed worker's table call a fault, each put there by hand; the soak's plan follows its seed."""

from __future__ import annotations

import hashlib
import json
from dataclasses import replace
from pathlib import Path
from types import SimpleNamespace
from typing import Any

import pytest

from benchmarks import kill_pool, soak
from benchmarks.kill_pool import MARKED, Cell, Struck, judge_end, left_behind, other_bytes
from benchmarks.soak import SPECIALS, events
from benchmarks.soak_record import Found, faults_in, page, temporary_faults
from workflows.run.run_lock import exclusive_run

NAMES = ["1/a", "2/a"]
WANTED = {"1/a": "x", "2/a": "y"}


def finished(out: Path) -> None:
    """Two captures of one stored result each, as they should be."""
    for name in NAMES:
        (out / name).mkdir(parents=True)
        (out / name / "run.json").write_text(json.dumps({"asset_hash": WANTED[name]}))
        folder = out / ".store/work" / WANTED[name]
        folder.mkdir(parents=True)
        (folder / "w.bin").write_bytes(b"content")
        digest = hashlib.sha256(b"content").hexdigest()
        (folder / "manifest.json").write_text(json.dumps({"file": {"path": "w.bin", "sha256": digest, "size": 7}}))


def faults(out: Path, stored: list[str] | None = None, runs: list[tuple[str, str]] | None = None) -> list[str]:
    lines = ["work x", "work y"] if stored is None else stored
    seen = [(n, "COMPLETED") for n in NAMES] if runs is None else runs
    return list(faults_in(out, NAMES, lines, seen, WANTED))


def test_a_soak_without_a_fault(tmp_path: Path) -> None:
    finished(tmp_path)
    crashed = [("1/a", "CRASHED"), ("1/a", "FAILED"), *((n, "COMPLETED") for n in NAMES)]
    assert faults(tmp_path) == [] == faults(tmp_path, runs=crashed)


def test_each_fault_of_a_soak_is_named(tmp_path: Path) -> None:
    finished(tmp_path)
    assert faults(tmp_path, stored=["work x", "work y", "work x"]) == ["made twice: work x"]
    assert faults(tmp_path, runs=[("1/a", "COMPLETED"), ("1/a", "COMPLETED")]) == ["1/a completed 2 times"]
    (tmp_path / ".store/work/y/w.bin").write_bytes(b"contemt")
    assert faults(tmp_path) == [f"damaged: {tmp_path / '.store/work/y/w.bin'}"]
    (tmp_path / ".store/work/y/w.bin").write_bytes(b"content")
    for left in (".store/work/z.partial-0", ".store/work/z.scratch", "1/a/.asset.partial-0", "1/a/.asset.old-0"):
        (tmp_path / left).mkdir()
        assert faults(tmp_path) == [f"left {left}"]
        (tmp_path / left).rmdir()
    with exclusive_run(tmp_path / ".store", tmp_path / "1/a", lambda: False, print):
        assert faults(tmp_path) == ["the lock of 1/a is held"]
    (tmp_path / "1/a/run.json").write_text(json.dumps({"asset_hash": "z"}))
    (tmp_path / "2/a/run.json").unlink()
    assert faults(tmp_path) == ["1/a has other bytes than undisturbed", "2/a is lost"]
    for name in ("runner_storage", "tmpabcprefect", "ours"):
        (tmp_path / "tmp" / name).mkdir(parents=True)
    assert list(temporary_faults(tmp_path / "tmp")) == ["left ours in TMPDIR"]


def test_a_soak_follows_its_seed_and_has_every_special_event_once() -> None:
    planned = events(7, 40, 12)
    assert planned == events(7, 40, 12) != events(8, 40, 12)
    assert [e.at for e in planned] == sorted(e.at for e in planned)
    assert sorted(e.what for e in planned if not e.signal) == sorted(SPECIALS)
    assert len(planned) == 12 + len(SPECIALS) and max(e.at for e in planned) <= 36
    assert {e.what for e in events(1, 40, 200) if e.signal} == set(soak.TARGETS)


def test_the_page_of_a_soak_tells_its_faults() -> None:
    found = Found("a machine", 7, 40, [(3, "the server: SIGKILL")], {"COMPLETED": 40}, {"1": 40}, 120, 600.0, 9.0)
    assert "**no fault**" in page(found) and "| 3 | the server: SIGKILL |" in page(found)
    told = page(replace(found, faults=["1/a is lost"]))
    assert "**1 faults**" in told and "- 1/a is lost" in told


# ------------------------------------------------------------------ the table of killed workers
def struck(out: Path) -> Struck:
    return Struck(kill_pool.MOMENTS[0], out, "run", Cell(137, ""), at=1_000_000.0)


@pytest.mark.parametrize(
    ("kind", "after", "picked_up", "told"),
    [
        ("CRASHED", 65.0, False, "137; crashed, 65 s"),
        ("CRASHED", MARKED + 1, False, "crashed after 121 s: why"),
        ("RUNNING", 0.0, False, "RUNNING after 120 s"),
        ("FAILED", 3.0, False, "failed after 3 s: why"),
        ("COMPLETED", 12.0, True, "137; picked up, 12 s"),
        ("COMPLETED", 12.0, False, "137; completed, 12 s"),
    ],
)
def test_how_a_run_ended(tmp_path: Path, kind: str, after: float, picked_up: bool, told: str) -> None:
    one = struck(tmp_path)
    one.picked_up = picked_up
    stamp = f"1970-01-12T13:{46 + int(40 + after) // 60:02d}:{int(40 + after) % 60:02d}.000000Z"
    pool: Any = SimpleNamespace(run=lambda run: {"state_type": kind, "state": {"timestamp": stamp, "message": "why"}})
    judge_end(pool, one)
    assert str(one.cell) == told and one.cell.is_fault() == ("after" in told)


def test_what_a_worker_must_not_leave_is_named(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    out, temporary = tmp_path / "out", tmp_path / "tmp"
    temporary.mkdir()
    (temporary / "runner_storage").mkdir()
    monkeypatch.setattr(kill_pool, "survivors", lambda mark: [])
    monkeypatch.setattr(kill_pool, "GONE", 0.2)
    one = struck(out)
    assert list(left_behind(one, "mark", temporary)) == []
    (temporary / "ours").write_text("")
    assert list(left_behind(one, "mark", temporary)) == ["left ours"]
    (temporary / "ours").unlink()
    out.mkdir()
    (out / "run.json").write_text("{}")
    assert list(left_behind(one, "mark", temporary)) == ["published run.json alone"]
    (out / "asset").mkdir()
    with exclusive_run(one.store, out, lambda: False, print):
        assert list(left_behind(one, "mark", temporary)) == ["the lock is held"]
    monkeypatch.setattr(kill_pool, "survivors", lambda mark: [7])
    assert list(left_behind(one, "mark", temporary)) == ["1 processes live on"]


def test_what_an_undisturbed_run_must_not_leave_is_named(tmp_path: Path) -> None:
    assert list(other_bytes(tmp_path, "x", "m")) == ["m: no result"]
    (tmp_path / "run.json").write_text(json.dumps({"asset_hash": "x"}))
    assert list(other_bytes(tmp_path, "x", "m")) == []
    (tmp_path / ".store/work/k.scratch").mkdir(parents=True)
    assert list(other_bytes(tmp_path, "y", "m")) == ["m: OTHER BYTES", "m: left k.scratch"]
