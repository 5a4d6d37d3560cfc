"""What happens to each capture of a batch, and when it is tried again."""

from __future__ import annotations

from pathlib import Path
from typing import Any

import pytest

from pipeline.errors import Cancelled, StageError, UsageError
from pipeline.verdict import Level
from tests.support.scripted_batch import BAD, DISK, LOST, MEMORY, Scripted, capture_tree, go, request
from workflows.batch import failures
from workflows.batch.captures import find
from workflows.batch.failures import Failure
from workflows.batch.fingerprint import fingerprint
from workflows.batch.loop import run_batch
from workflows.batch.request import BatchRequest
from workflows.batch.state import BatchState, Entry, idempotency_key


@pytest.fixture
def tree(tmp_path: Path) -> Path:
    return capture_tree(tmp_path)


@pytest.fixture(autouse=True)
def no_waiting(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(failures, "BACK_OFF", 0.01)


def test_one_bad_capture_costs_no_other_and_is_not_tried_again(tree: Path) -> None:
    summary, runner = go(tree, {"2/1_neutral": [BAD]})
    assert summary.counts() == {"done": 4, "unusable": 0, "failed": 1, "submitted": 0, "waiting": 0}
    assert len(runner.started) == 5 and runner.most == 2
    assert summary.failed == 1


def test_what_may_pass_is_tried_again_as_often_as_asked(tree: Path) -> None:
    summary, runner = go(tree, {"1/1_neutral": [LOST, LOST], "1/2_smile": [LOST] * 5}, attempts=3)
    tries = {n: [a for name, a, _ in runner.started if name == n] for n in ("1/1_neutral", "1/2_smile")}
    assert tries == {"1/1_neutral": [1, 2, 3], "1/2_smile": [1, 2, 3]}
    assert summary.counts()["failed"] == 1


def test_an_unusable_result_is_an_end_and_is_not_tried_again(tree: Path) -> None:
    asked = request(tree)
    levels: dict[str, Level] = {"1/1_neutral": "unusable", "1/2_smile": "usable", "2/1_neutral": "good"}
    summary = run_batch(asked, Scripted(Path(asked.out), {}, levels=levels))
    assert summary.counts() == {"done": 4, "unusable": 1, "failed": 0, "submitted": 0, "waiting": 0}
    assert (summary.failed, summary.refused(False), summary.refused(True)) == (0, 1, 2)
    again = Scripted(Path(asked.out), {})
    later = run_batch(asked, again)  # what is known is on disk
    assert again.started == [] and later.counts()["unusable"] == 1 and later.refused(True) == 2
    (Path(asked.out) / "1/1_neutral/run.json").unlink()
    run_batch(asked, again)
    assert [name for name, *_ in again.started] == ["1/1_neutral"]


@pytest.mark.parametrize(("change", "again"), [({"strict": True}, 0), ({"force": True}, 5)])
def test_strict_makes_nothing_anew_and_force_does(tree: Path, change: dict[str, bool], again: int) -> None:
    go(tree, {})
    _, runner = go(tree, {}, **change)
    assert len(runner.started) == again


@pytest.mark.parametrize(
    ("script", "levels", "options", "code"),
    [
        ({}, {"2/1_neutral": "good"}, ["--strict"], 0),
        ({}, {"2/1_neutral": "usable"}, [], 0),
        ({}, {"2/1_neutral": "usable"}, ["--strict"], 3),
        ({}, {"2/1_neutral": "unusable"}, [], 3),
        ({"1/2_smile": [Failure(kind="capture", message="bad")]}, {"2/1_neutral": "unusable"}, [], 1),
    ],
)
def test_exit_codes_of_a_batch(
    tree: Path,
    monkeypatch: pytest.MonkeyPatch,
    script: dict[str, list[Failure | None]],
    levels: dict[str, Level],
    options: list[str],
    code: int,
) -> None:
    from workflows.batch import local
    from workflows.cli.main import main

    out = tree.parent / "out"
    runner = Scripted(out, script, levels=levels)
    runner.kill = lambda: None  # type: ignore[attr-defined]
    monkeypatch.setattr(local, "Processes", lambda request, slots: runner)
    assert main(["batch", str(tree), "--out", str(out), *options]) == code


def test_out_of_memory_is_tried_with_half_the_rays(tree: Path) -> None:
    asked = request(tree, subjects="2")
    runner = Scripted(Path(asked.out), {"2/1_neutral": [MEMORY, MEMORY]})
    assert run_batch(asked, runner).failed == 0
    half = ("inverse_rendering.batch=2048",)  # twice the same: the script's fit always has 4096
    assert [sets for _, _, sets in runner.started] == [(), half, half]


def test_a_full_disk_stops_the_batch_and_the_same_command_goes_on(tree: Path) -> None:
    summary, runner = go(tree, {"1/1_neutral": [DISK]})
    assert summary.held is not None and summary.counts()["waiting"] == 3
    again, runner = go(tree, {})
    assert again.failed == 0
    assert len(runner.started) == 4


def test_a_second_command_touches_only_what_is_not_done(tree: Path) -> None:
    go(tree, {"2/1_neutral": [BAD]})
    _, runner = go(tree, {})
    assert runner.started == [("2/1_neutral", 2, ())]
    _, runner = go(tree, {})
    assert runner.started == []


@pytest.mark.parametrize("change", ["photo", "setting", "result gone"])
def test_done_is_forgotten_when_it_is_no_longer_true(tree: Path, change: str) -> None:
    go(tree, {})
    options: dict[str, Any] = {}
    if change == "photo":
        (tree / "1/1_neutral/0.jpg").write_bytes(b"another")
    elif change == "setting":
        options = {"seed": 1}
    else:
        (tree.parent / "out/1/1_neutral/run.json").unlink()
    _, runner = go(tree, {}, **options)
    assert len(runner.started) == (5 if change == "setting" else 1)


def test_ctrl_c_leaves_what_was_under_way_waiting(tree: Path) -> None:
    asked = request(tree)
    runner = Scripted(Path(asked.out), {})
    with pytest.raises(Cancelled):
        run_batch(asked, runner, stopped=lambda: len(runner.started) >= 2)
    states = [BatchState(asked.folder).read(i).state for i in find(tree)]
    assert sorted(states) == ["done", "waiting", "waiting", "waiting", "waiting"]
    assert (asked.folder / "index.html").is_file()


def test_a_batch_that_was_killed_joins_what_it_submitted(tree: Path) -> None:
    """The same attempt, so the same idempotency key: a server hands back the run that it has."""
    asked = request(tree, subjects="2")
    state, item = BatchState(asked.folder), find(tree, "2")[0]
    run = asked.run_request(item.capture, item.name, (), item.own)
    entry = Entry(name=item.name, capture=str(item.capture), state="submitted", attempt=4, fingerprint=fingerprint(run))
    state.write(entry)
    runner = Scripted(Path(asked.out), {})
    run_batch(asked, runner)
    assert runner.started == [("2/1_neutral", 4, ())]


def test_idempotency_keys_differ_by_all_that_matters(tree: Path) -> None:
    base = Entry(name="a", capture="/c", attempt=1, fingerprint="f")
    others = [base.model_copy(update=u) for u in ({"name": "b"}, {"attempt": 2}, {"fingerprint": "g"})]
    keys = [idempotency_key(e, "/out") for e in (base, *others)] + [idempotency_key(base, "/other")]
    assert len(set(keys)) == 5
    assert idempotency_key(base.model_copy(update={"state": "failed"}), "/out") == keys[0]


@pytest.mark.parametrize("content", [b"", b"{", b'{"name": "../x", "capture": "c"}', b'{"name":"a","asset":"/etc/x"}'])
def test_a_damaged_ledger_is_a_new_one(tree: Path, content: bytes) -> None:
    state, item = BatchState(tree.parent / "out/batch"), find(tree)[0]
    state.write(Entry(name=item.name, capture="c", state="done"))
    next(state.folder.iterdir()).write_bytes(content)
    assert state.read(item).state == "waiting"


def test_results_never_land_among_the_captures(tree: Path) -> None:
    for out in (tree, tree / "out"):
        with pytest.raises(StageError, match="among the captures"):
            run_batch(BatchRequest(root=str(tree), out=str(out)), Scripted(out, {}))
    assert not (tree / "out").exists()


@pytest.mark.parametrize("change", [{"preset": "besst"}, {"sets": ("bake.size=x",)}, {"until": "baek"}, {"seed": 2.5}])
def test_wrong_words_are_told_before_anything_is_written(tree: Path, change: dict[str, Any]) -> None:
    with pytest.raises((UsageError, ValueError)):
        run_batch(request(tree, **change), Scripted(tree, {}))
    assert not (tree.parent / "out").exists()


@pytest.mark.parametrize("option", [["--attempts", "0"], ["--seed", "-1"], ["--preset", "besst"], ["--chunk", "9999"]])
def test_wrong_options_are_exit_code_2(tree: Path, option: list[str], capsys: pytest.CaptureFixture[str]) -> None:
    from workflows.cli.main import main

    assert main(["batch", str(tree), "--out", str(tree.parent / "out"), *option]) == 2
    assert "what to do:" in capsys.readouterr().err
