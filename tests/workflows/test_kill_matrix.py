"""The moments of benchmarks/kill_matrix.py: what killed runs left does not count, and a missed moment comes again."""

from __future__ import annotations

import signal
import subprocess
import sys
from pathlib import Path

import pytest

from benchmarks import kill_matrix
from benchmarks.kill_matrix import (
    PUBLISHING,
    RETRIES,
    Cell,
    Column,
    Moment,
    left_in,
    moments,
    strike_in_time,
    under_way,
)
from stages.registry import REGISTRY
from workflows.run.run_lock import exclusive_run


def partial_of(out: Path, stage: str, key: str = "a") -> Path:
    folder = out / ".store" / stage / f"{key}.partial-0"
    folder.mkdir(parents=True)
    return folder


def test_a_partial_folder_of_a_killed_run_is_no_sign_of_this_one(tmp_path: Path) -> None:
    partial_of(tmp_path, "uv")
    old = left_in(tmp_path)
    m = Moment("uv, 10%", 1.0, "uv", ("bake", "usd"))
    assert not m.has_come(tmp_path, old) and m.has_come(tmp_path, set())
    partial_of(tmp_path, "uv", "b")
    assert m.has_come(tmp_path, old) and not m.is_over(tmp_path, old)
    partial_of(tmp_path, "usd")
    assert m.is_over(tmp_path, old)


def test_results_that_are_published_are_told_from_stages(tmp_path: Path) -> None:
    m = Moment("report, 60%", 1.0, "report")
    (tmp_path / ".run.partial-0").mkdir()
    assert not m.is_over(tmp_path, set()) and not under_way(tmp_path, (PUBLISHING,), set())
    (tmp_path / ".asset.partial-0").mkdir()
    assert m.is_over(tmp_path, set())
    last = Moment(PUBLISHING, 0.0, PUBLISHING)
    assert last.has_come(tmp_path, set()) and not last.is_over(tmp_path, set())


def test_every_stage_has_its_moments_in_the_order_of_a_run() -> None:
    found = list(moments({s.name: 10.0 for s in REGISTRY}))
    stages = [m.stage for m in found if m.stage]
    assert stages == [s.name for s in REGISTRY for _ in kill_matrix.SHARES] + [PUBLISHING]
    assert {m.wait for m in found if m.stage == "uv"} == {1.0, 6.0}


def test_a_stage_that_was_too_fast_is_made_again_and_the_signal_comes_sooner(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    waits: list[float] = []

    def missed_twice(folder: Path, out: Path, moment: Moment, name: str) -> Cell:
        assert not (out / ".store" / "uv").exists() or not waits
        waits.append(moment.wait)
        for stage in ("masks", "uv", "bake"):
            (out / ".store" / stage / "key").mkdir(parents=True, exist_ok=True)
        return Cell(None) if len(waits) < 3 else Cell(143)

    monkeypatch.setattr(kill_matrix, "strike", missed_twice)
    m = Moment("uv, 60%", 9.0, "uv", ("bake", "usd"))
    assert strike_in_time(tmp_path, tmp_path, m, "TERM").code == 143
    assert waits == [9.0, 3.0, 1.0] and (tmp_path / ".store/masks/key").is_dir()

    monkeypatch.setattr(kill_matrix, "strike", lambda *_: waits.append(0.0) or Cell(None))
    waits.clear()
    assert strike_in_time(tmp_path, tmp_path, m, "TERM").code is None and len(waits) == 1 + RETRIES
    waits.clear()
    assert strike_in_time(tmp_path, tmp_path, Moment(PUBLISHING, 0.0, PUBLISHING), "TERM").code is None
    assert len(waits) == 1  # there is nothing to make again


def test_children_of_a_harness_that_ignores_hangups_do_not_ignore_them() -> None:
    child = "import signal; print(signal.getsignal(signal.SIGHUP) == signal.SIG_IGN)"
    parent = "import signal, subprocess, sys; signal.signal(signal.SIGHUP, signal.SIG_IGN); from benchmarks import "
    parent += f"kill_matrix; {{}}; subprocess.run([sys.executable, '-c', {child!r}], check=True)"
    for call, ignored in (("kill_matrix.not_ignored()", "False"), ("pass", "True")):
        command = [sys.executable, "-c", parent.format(call)]
        assert subprocess.run(command, capture_output=True, text=True, check=True).stdout.strip() == ignored


def test_cells_that_were_measured_later_join_their_column() -> None:
    """The last row stays that of all moments, unless a fault came; the column's commit is that of most of its cells."""
    last, same = kill_matrix.LAST, Cell(0, 0.0, [kill_matrix.SAME])
    old = Column("here, 2026-01-02; commit abc1234", {"uv, 10%": Cell(143), last: Cell(0, 0.0, ["not compared"])})
    new = Column("there, 2026-02-03; commit def5678; 16 photos of", {"usd, 10%": Cell(143, 2.0), last: same})
    found = kill_matrix.added(old, new, ["usd"])
    assert found.cells == {**old.cells, "usd, 10%": Cell(143, 2.0)}
    assert found.made == f"{old.made}; usd later: there, 2026-02-03; def5678, then the same bytes"
    other = Column(new.made, {last: Cell(0, 0.0, ["OTHER BYTES"])})
    assert kill_matrix.added(old, other, ["usd"]).cells[last].is_fault()


def test_python_s_own_start_is_told_from_a_fault() -> None:
    """Its traceback has no line of ours. One that has is a fault, and so is another exit code, or a process left."""
    own = 'File "<frozen site>", line 599, in main\nKeyboardInterrupt'
    ours = f'File "{kill_matrix.ROOT}/workflows/cli/entry.py", line 9\n{own}'
    traced = ["exit code 1", "says Traceback"]
    for code, said, faults, fault in (
        (1, own, traced, False), (1, ours, traced, True), (-6, own, ["exit code 134"], True), (130, "", [], False),
        (1, own, [*traced, "1 processes live on"], True), (1, "Traceback", traced, True),
    ):  # fmt: skip
        cell = kill_matrix.too_early(Cell(code, 0.1, list(faults)), said)
        assert cell.is_fault() is fault, (code, said, faults)
        assert (str(cell) == kill_matrix.TOO_EARLY) == (said == own and code == 1 and not fault)


def test_a_batch_comes_to_each_point_again(tmp_path: Path) -> None:
    """Of a batch that has finished, what a capture must make again stays no longer, and what comes before stays."""
    from benchmarks.kill_batch import CAPTURES, MOMENTS, STAGES, forget

    for moment in [m for m in MOMENTS if m.point]:
        for folder in (*(f".store/{s}/key" for s in STAGES), *(f"{c}/asset" for c in CAPTURES)):
            (tmp_path / folder).mkdir(parents=True, exist_ok=True)
        forget(tmp_path, moment)
        of = moment.point.partition(".")[0]
        kept = {"capture": 0, "work": 1}.get(of, 1 if moment.finished else 2)
        assert [s for s in STAGES if (tmp_path / ".store" / s).is_dir()] == list(STAGES[:kept]), moment.name
        assert not any((tmp_path / c).exists() for c in CAPTURES)


def test_a_batch_s_faults_are_named(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    """Each of what a batch may leave, put there by hand."""
    from benchmarks import kill_batch, kill_matrix

    out = tmp_path / "out"
    (out / "batch/logs").mkdir(parents=True)
    (tmp_path / "said.txt").write_text("")
    monkeypatch.setattr(kill_batch, "survivors", lambda mark: [])
    monkeypatch.setattr(kill_batch, "GONE", 0.2)
    cell = Cell(143, 1.0)

    def found(name: str = "TERM") -> list[str]:
        ended = kill_matrix.ending_faults(cell, signal.SIGTERM)
        return [*ended, *kill_batch._faults(tmp_path, out, name, "mark", set())]

    assert found() == []
    cell.code = 1
    assert found() == ["exit code 1"]
    cell.code, cell.seconds = -15, 1e3
    assert found() == ["1000 s until the end"]
    cell.seconds = 1.0
    (out / "batch/logs/1.log").write_text("Traceback (most recent call last)")
    assert found() == ["says Traceback"]
    (out / "batch/logs/1.log").write_text("")
    partial_of(out, "capture")
    assert found() == ["left 1 partial folders"] and found("KILL") == []
    (out / "1/1_neutral/asset").mkdir(parents=True)
    assert found("KILL") == ["published asset alone"]
    (out / "1/1_neutral/run.json").write_text("{}")
    monkeypatch.setattr(kill_batch, "survivors", lambda mark: [7])
    assert found("KILL") == ["1 processes live on"]
    monkeypatch.setattr(kill_batch, "survivors", lambda mark: [])
    with exclusive_run(out / ".store", out / "batch", lambda: False, print):
        assert found("KILL") == ["a lock is held"]
