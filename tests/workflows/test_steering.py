"""Pause, go on, stop: at checkpoints, without a wait that counts, and with signals as ever."""

from __future__ import annotations

import json
import os
import pty
import signal
import subprocess
import sys
import threading
import time
from collections.abc import Iterator
from pathlib import Path
from typing import Any

import pytest

from pipeline.contract import Checked
from pipeline.errors import Cancelled, TimeLimitError
from tests.support.points import wait_for
from tests.support.steered import Recorded, in_thread, plan_of
from workflows.cli.console import Console
from workflows.cli.keys import HELP, Keys, keys_of
from workflows.cli.main import main
from workflows.live.folder import ASK, FOLDER, PICTURES, LiveFolder, put_whole
from workflows.live.look import look_at
from workflows.live.publisher import Live, told_live
from workflows.live.wishes import Wishes, ask
from workflows.run.plan import Plan, make_plan
from workflows.run.publish import publish
from workflows.run.request import RunRequest
from workflows.run.run_lock import exclusive_run
from workflows.run.runner import run_stages
from workflows.run.session import Session
from workflows.run.steering import LOOK, Steering

TOY = Path(__file__).parents[1] / "support" / "toy_neuface.py"


# ------------------------------------------------------------------ how to resume
@pytest.mark.usefixtures("toys")
@pytest.mark.parametrize("again", [True, False])
def test_a_stopped_run_from_a_stage_says_how_to_resume_and_that_is_right(
    again: bool, photos: Path, monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str]
) -> None:
    """Of six steps three are done when it is stopped; they are kept only without --from-stage."""
    command = ["run", str(photos), "--out", str(photos.parent / "out"), "--set", "second.steps=6"]
    assert main(command) == 0
    seen: list[int] = []

    def progress(console: Console, done: int, total: int, message: str = "", **figures: float) -> None:
        seen.append(done)
        if seen == [0, 1, 2, 3]:
            raise Cancelled("stopped by the user")

    monkeypatch.setattr(Console, "progress", progress)
    capsys.readouterr()
    assert main([*command, "--from-stage", "second"]) == 130
    assert "to resume, run it again without --from-stage: with it, second begins anew" in capsys.readouterr().err
    begun = len(seen)
    assert main([*command, *(["--from-stage", "second"] if again else [])]) == 0
    assert seen[begun:] == ([0, 1, 2, 3, 4, 5] if again else [3, 4, 5])


@pytest.mark.usefixtures("toys")
def test_another_stopped_run_resumes_with_the_same_command(
    photos: Path, monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str]
) -> None:
    def progress(console: Console, *given: object, **figures: float) -> None:
        raise Cancelled("stopped by the user")

    monkeypatch.setattr(Console, "progress", progress)
    assert main(["run", str(photos), "--out", str(photos.parent / "out"), "--set", "second.steps=6"]) == 130
    assert "stopped; run the same command again to resume" in capsys.readouterr().err


# ------------------------------------------------------------------ the wishes
def test_a_pause_waits_and_its_time_is_counted_once() -> None:
    steering, begun = Steering(), time.monotonic()
    steering.wish("pause")
    threads = [in_thread(lambda: steering.wait(lambda: False))[0] for _ in range(3)]
    wait_for(lambda: steering._waiting == 3)
    assert steering.pausing and steering.paused
    time.sleep(0.3)
    steering.wish("go on")
    for thread in threads:
        thread.join(10)
    assert not steering.paused
    assert 0.25 < steering.waited() < time.monotonic() - begun  # not three times that


def test_what_is_asked_elsewhere_is_looked_for_not_too_often() -> None:
    now, asked = [0.0], list[float]()

    def elsewhere() -> str | None:
        asked.append(now[0])
        return "pause" if now[0] > 1 else None

    steering = Steering(lambda: now[0])
    steering.ask = elsewhere
    for _ in range(100):
        steering.wait(lambda: True)
        now[0] += LOOK / 10
    assert 9 <= len(asked) <= 11 and steering.pausing
    steering.wish("nonsense")
    assert steering.pausing


@pytest.mark.parametrize("end", ["signal", "wish"])
def test_a_stop_ends_a_pause(end: str) -> None:
    session, found = Session(), list[bool]()
    session.steering.wish("pause")
    thread, _ = in_thread(lambda: found.append(session.stopped()))
    wait_for(lambda: session.steering.paused)
    session.stop.set() if end == "signal" else session.steering.wish("stop")
    thread.join(10)
    assert found == [True] and not session.steering.paused
    assert session.asked_to_stop()


def test_the_check_counts_the_time_within_it() -> None:
    checked = Checked(lambda: bool(time.sleep(0.05)))
    assert checked() is False
    threads = [in_thread(checked)[0] for _ in range(4)]
    for thread in threads:
        thread.join()
    assert 0.09 < checked.waited() < 0.19  # four at a time are one wait


# ------------------------------------------------------------------ a run
def test_a_paused_run_has_the_same_bytes_and_no_time_for_it(photos: Path, toys: None) -> None:
    """Also: a limit of half the pause for each stage does not end it."""
    pause, done = 2.4, list[Any]()
    plan = plan_of(photos, stage_limit=pause / 2)
    watch, begun = Session(Recorded()), time.monotonic()
    watch.steering.wish("pause")
    thread, errors = in_thread(lambda: done.extend(run_stages(plan, watch)))
    wait_for(lambda: watch.steering.paused)
    time.sleep(pause)
    watch.steering.wish("go on")
    thread.join(20)
    in_all = time.monotonic() - begun
    assert errors == [] and [d.stage for d in done] == ["first", "second", "third"]
    # What is left of the time, not a number of seconds: a busy machine takes as long as it likes beside the pause.
    assert sum(d.run["seconds"] for d in done) <= in_all - pause
    assert watch.elapsed() <= time.monotonic() - watch.begun - pause
    assert watch.observer.told == ["first", True, False, "second", "third"]  # type: ignore[attr-defined]
    other = make_plan(plan.request.model_copy(update={"out": str(photos.parent / "other"), "stage_limit": None}))
    assert [d.located.artifact for d in run_stages(other)] == [d.located.artifact for d in done]


def test_the_limit_goes_on_after_a_pause(photos: Path, toys: None) -> None:
    plan = plan_of(photos, stage_limit=0.6, sets=("second.steps=100", "second.pause=0.05"))
    watch = Session()
    thread, errors = in_thread(lambda: run_stages(plan, watch))
    wait_for(lambda: (plan.store.root / "first").is_dir() and any((plan.store.root / "second").glob("*.scratch")))
    watch.steering.wish("pause")
    wait_for(lambda: watch.steering.paused)
    time.sleep(0.8)
    assert errors == []
    watch.steering.wish("go on")
    thread.join(20)
    assert isinstance(errors[0], TimeLimitError)


def test_it_stops_after_the_stage_and_resumes(photos: Path, toys: None) -> None:
    plan, watch = plan_of(photos), Session()
    watch.steering.wish("stop after stage")
    with pytest.raises(Cancelled, match="after first") as stopped:
        run_stages(plan, watch)
    assert stopped.value.exit_code == 130
    assert [d.reused for d in run_stages(plan)] == [True, False, False]
    taken_back = Session()
    taken_back.steering.wish("stop after stage")
    taken_back.steering.wish("go on")
    assert len(run_stages(plan, taken_back)) == 3


# ------------------------------------------------------------------ what a run tells
def told_run(plan: Plan, watch: Session) -> Any:
    with exclusive_run(plan.store.root, plan.out, watch.stopped, print), told_live(plan, watch) as told:
        return publish(plan, run_stages(plan, told), told.observer.note, told.asked_to_stop)


def test_a_run_tells_its_folder_and_takes_wishes_from_it(photos: Path, toys: None) -> None:
    plan, watch = plan_of(photos, sets=("second.steps=400", "second.pause=0.02")), Session(Recorded())
    thread, errors = in_thread(lambda: told_run(plan, watch))
    wait_for(lambda: any(s["state"] == "running" for s in look_at(plan.out).state.get("stages", [])[1:]))
    look = look_at(plan.out)
    assert look.alive and look.troubles == ()
    assert [(s["name"], s["state"]) for s in look.state["stages"]] == [
        ("first", "done"), ("second", "running"), ("third", "waiting")]  # fmt: skip
    assert ask(plan.out, "pause")
    wait_for(lambda: look_at(plan.out).state["status"] == "paused")
    before = look_at(plan.out).state
    time.sleep(0.6)
    assert look_at(plan.out).state == before  # nothing happens while it is paused
    assert ask(plan.out, "go on")
    wait_for(lambda: look_at(plan.out).state["status"] == "running")
    assert ask(plan.out, "stop")
    thread.join(20)
    assert isinstance(errors[0], Cancelled)
    left = look_at(plan.out)
    assert not left.alive and left.state["status"] == "stopped" and "stopped by the user" in left.state["message"]
    told_run(plan_of(photos, sets=("second.steps=2",)), Session())
    assert not (plan.out / FOLDER).exists() and look_at(plan.out).record["stages"].keys() >= {"third"}


def test_a_wish_is_for_one_run_and_taken_once(tmp_path: Path) -> None:
    """A file that is put there again, with another time but the same number, is no second wish."""
    folder = tmp_path / FOLDER
    folder.mkdir()

    def put(number: str, **content: str) -> None:
        put_whole(folder / ASK, json.dumps({"run": "one", "wish": "pause", "number": number} | content).encode())

    wishes = Wishes(tmp_path, "one")
    assert wishes() is None
    put("1")
    assert wishes() == "pause"
    assert wishes() is None
    put("1", wish="stop")
    assert wishes() is None
    put("2", run="another")
    assert wishes() is None
    put("3", wish="nonsense")
    assert wishes() is None
    put("4", wish="stop")
    assert wishes() == "stop"


def test_what_failed_says_why_and_nothing_is_left_of_a_run_that_made_nothing(photos: Path, toys: None) -> None:
    with pytest.raises(Exception, match="the toy is broken"):
        told_run(plan_of(photos, sets=("second.fault=stage",)), Session())
    state = look_at(photos.parent / "out").state
    assert state["status"] == "failed" and "the toy is broken" in state["message"]
    plan = make_plan(RunRequest(capture=str(photos), out=str(photos.parent / "none"), sets=("first.fault=x",)))
    with pytest.raises(Exception, match="the first toy is broken"):
        told_run(plan, Session())
    assert not plan.out.exists()


def test_without_the_folder_the_run_goes_on(photos: Path, toys: None) -> None:
    out = photos.parent / "out"
    out.mkdir()
    (out / FOLDER).write_text("mine")
    watch = Session(Recorded())
    assert told_run(plan_of(photos), watch)["stages"]
    assert (out / FOLDER).read_text() == "mine"
    assert any("no live view" in str(t) for t in watch.observer.told)  # type: ignore[attr-defined]
    (out / FOLDER).unlink()
    plan = plan_of(photos, no_live=True)
    with exclusive_run(plan.store.root, plan.out, lambda: False, print), told_live(plan, watch) as told:
        assert told is watch and not (out / FOLDER).exists()


def test_a_full_disk_ends_the_telling_only(photos: Path, toys: None, monkeypatch: pytest.MonkeyPatch) -> None:
    def full(self: LiveFolder, name: str, data: bytes) -> None:
        raise OSError(28, "No space left on device")

    monkeypatch.setattr(LiveFolder, "write", full)
    assert told_run(plan_of(photos), Session())["stages"]


def test_files_of_the_users_are_not_touched(photos: Path, toys: None) -> None:
    folder = photos.parent / "out" / FOLDER
    folder.mkdir(parents=True)
    for name in ("notes.txt", "state.json", "fit.jpg"):
        (folder / name).write_text(f"mine: {name}")
    watch = Session(Recorded())
    told_run(plan_of(photos), watch)
    assert {p.name: p.read_text() for p in folder.iterdir()} == {
        "notes.txt": "mine: notes.txt", "state.json.yours-1": "mine: state.json", "fit.jpg.yours-1": "mine: fit.jpg",
    }  # fmt: skip
    assert sum("is yours" in str(t) for t in watch.observer.told) == 2  # type: ignore[attr-defined]


def test_what_a_killed_run_left_is_tidied_and_an_edited_picture_kept(tmp_path: Path) -> None:
    left = LiveFolder(tmp_path)
    left.state({"stages": []})
    for name in PICTURES[:2]:
        left.write(name, b"ours")
        left.write(name, b"ours again")
    (tmp_path / FOLDER / PICTURES[1]).write_text("edited")
    (tmp_path / FOLDER / f".{PICTURES[0]}.new-0123abcd").write_text("half")
    LiveFolder(tmp_path)
    assert sorted(p.name for p in (tmp_path / FOLDER).iterdir()) == [f"{PICTURES[1]}.yours-1"]


def test_pictures_come_every_ten_seconds_and_take_little_time(photos: Path, toys: None, tmp_path: Path) -> None:
    import numpy as np

    now, made = [0.0], list[float]()

    def picture() -> Any:
        made.append(now[0])
        now[0] += 0.5
        return np.zeros((8, 16, 3), np.uint8)

    plan = plan_of(photos)
    plan.out.mkdir()
    live = Live(plan, Session(Recorded()), lambda: now[0])
    live.started("second", 2, 3)
    spent = 0.0
    while now[0] < 100:
        spent += live.show("fit", picture)
        now[0] += 0.25
    assert made[0] == 0 and len(made) == pytest.approx(100 / 17, abs=1.5)  # half a second is 3 % of 17
    assert spent == pytest.approx(0.5 * len(made)) and spent < 0.04 * 100
    assert live.state["pictures"]["fit.jpg"]["number"] == len(made)


# ------------------------------------------------------------------ keys
@pytest.fixture
def terminal() -> Iterator[tuple[int, int]]:
    ours, theirs = pty.openpty()
    yield ours, theirs
    os.close(ours)
    os.close(theirs)


def test_keys_steer(monkeypatch: pytest.MonkeyPatch) -> None:
    import io

    stream = io.StringIO()
    steering = Steering()
    keys = Keys(steering, Console(stream), None)
    for key, pausing, ends in (("p", True, False), (" ", False, False), ("S", False, True), (" ", False, False),
                               ("x", False, False)):  # fmt: skip
        keys.press(key)
        assert (steering.pausing, steering.ends_after_stage.is_set()) == (pausing, ends)
    assert stream.getvalue().count("\n") == 4
    with keys_of(steering, Console(stream)) as none:  # no terminal: nothing is read
        assert none.descriptor is None


def run_on(terminal: int, photos: Path, *sets: str) -> subprocess.Popen[bytes]:
    """`neuface run` with toy stages, with this terminal as its own."""
    import fcntl
    import termios

    command = [sys.executable, str(TOY), "run", str(photos), "--out", str(photos.parent / "out"), *sets]
    root = Path(__file__).parents[2]
    return subprocess.Popen(
        command, cwd=root, stdin=terminal, stdout=terminal, stderr=terminal, start_new_session=True,
        env={**os.environ, "PYTHONPATH": str(root), "TERM": "xterm"},
        preexec_fn=lambda: fcntl.ioctl(terminal, termios.TIOCSCTTY, 0),
    )  # fmt: skip


@pytest.mark.slow
def test_keys_in_a_terminal_pause_and_go_on_and_it_is_given_back(photos: Path, terminal: tuple[int, int]) -> None:
    import termios

    ours, theirs = terminal
    before = termios.tcgetattr(theirs)
    out, seen = photos.parent / "out", bytearray()
    child = run_on(theirs, photos, "--set=second.steps=300", "--set=second.pause=0.02")
    threading.Thread(target=lambda: [seen.extend(b) for b in iter(lambda: _read(ours), b"")], daemon=True).start()
    wait_for(lambda: look_at(out).state.get("percent", 0) > 0)
    assert not termios.tcgetattr(theirs)[3] & termios.ICANON
    os.write(ours, b"p")
    wait_for(lambda: look_at(out).state.get("status") == "paused")
    os.write(ours, b" ")
    assert child.wait(60) == 0
    assert HELP.encode()[:20] in seen and b"pausing at the next checkpoint" in seen and b"paused, " in seen
    assert termios.tcgetattr(theirs)[3] == before[3]


def _read(descriptor: int) -> bytes:
    try:
        return os.read(descriptor, 4096)
    except OSError:
        return b""


@pytest.mark.slow
@pytest.mark.parametrize("number", [signal.SIGINT, signal.SIGTERM])
def test_a_signal_stops_a_paused_run_and_it_resumes_with_the_same_bytes(number: int, photos: Path) -> None:
    root, out = Path(__file__).parents[2], photos.parent / "out"
    sets = ["--set=second.steps=60", "--set=second.pause=0.02"]
    command = [sys.executable, str(TOY), "run", str(photos), *sets, "--stage-limit", "20s", "--out"]
    environment = {**os.environ, "PYTHONPATH": str(root)}
    child = subprocess.Popen([*command, str(out)], cwd=root, env=environment, stderr=subprocess.DEVNULL)
    wait_for(lambda: look_at(out).state.get("percent", 0) > 0)
    assert ask(out, "pause")
    wait_for(lambda: look_at(out).state.get("status") == "paused")
    child.send_signal(number)
    assert child.wait(60) == 128 + number
    assert look_at(out).state["status"] == "stopped"
    assert list((out / ".store/second").glob("*.scratch/step.txt"))  # its checkpoint
    for folder in (out, photos.parent / "undisturbed"):
        done = subprocess.run([*command, str(folder)], cwd=root, env=environment, capture_output=True, timeout=120)
        assert done.returncode == 0, done.stderr
    manifests = []
    for folder in (out, photos.parent / "undisturbed"):
        key = json.loads((folder / "run.json").read_text())["stages"]["third"]["key"]
        manifests.append((folder / f".store/third/{key}/manifest.json").read_bytes())
    assert manifests[0] == manifests[1]
