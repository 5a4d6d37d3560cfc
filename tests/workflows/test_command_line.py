"""`neuface` as a user has it: exit codes, messages, stopping, resuming."""

from __future__ import annotations

import dataclasses
import inspect
import json
import os
import signal
import subprocess
import sys
from pathlib import Path
from typing import Any

import pytest

from pipeline.errors import Cancelled
from stages import registry
from tests.support.points import PATIENCE, hold, read_until
from tests.support.toy_stages import TOYS
from workflows.cli.console import Console
from workflows.cli.main import COMMANDS, main, parser

TOY = Path(__file__).parents[1] / "support" / "toy_neuface.py"


def start(environment: dict[str, str], *arguments: object) -> subprocess.Popen[str]:
    return subprocess.Popen(
        [sys.executable, str(TOY), *map(str, arguments)],
        env=environment,
        text=True,
        stdout=subprocess.PIPE,
        stderr=subprocess.PIPE,
        start_new_session=True,
    )


def neuface(environment: dict[str, str], *arguments: object) -> tuple[int, str, str]:
    child = start(environment, *arguments)
    out, err = child.communicate(timeout=PATIENCE)
    return child.returncode, out, err


# ------------------------------------------------------------------ usage
@pytest.mark.parametrize(
    "arguments",
    [[], ["fly"], ["run"], ["run", "x"], ["run", "x", "--out"], ["run", "x", "--out", "y", "--seed", "a"],
     ["demo", "--views", "3"]],
)  # fmt: skip
def test_wrong_usage_is_exit_code_2(arguments: list[str], capsys: pytest.CaptureFixture[str]) -> None:
    with pytest.raises(SystemExit) as e:
        main(arguments)
    assert e.value.code == 2
    assert "usage: neuface" in capsys.readouterr().err


@pytest.mark.usefixtures("toys")
@pytest.mark.parametrize(
    "options",
    [["--preset", "besst"], ["--until", "frist"], ["--set", "first.puls=1"], ["--config", "gone.toml"],
     ["--device", "tpu"], ["--set", "first.plus=-1"], ["--out", ""]],
)  # fmt: skip
def test_unknown_words_are_exit_code_2_and_leave_nothing(
    photos: Path, options: list[str], capsys: pytest.CaptureFixture[str]
) -> None:
    assert main(["run", str(photos), "--out", str(photos.parent / "out"), *options]) == 2
    err = capsys.readouterr().err
    assert err.startswith("error: ")
    assert "what to do:" in err
    assert "Traceback" not in err
    assert [p.name for p in photos.parent.iterdir()] == ["photos"]


def test_every_command_has_help(capsys: pytest.CaptureFixture[str]) -> None:
    for command in COMMANDS:
        with pytest.raises(SystemExit) as e:
            parser().parse_args([command, "--help"])
        assert e.value.code == 0
        assert "usage" in capsys.readouterr().out


@pytest.mark.usefixtures("toys")
def test_dry_run_writes_nothing(photos: Path, capsys: pytest.CaptureFixture[str]) -> None:
    assert main(["run", str(photos), "--out", str(photos.parent / "out"), "--dry-run"]) == 0
    assert [line.split()[:2] for line in capsys.readouterr().out.splitlines()[:3]] == [
        ["first", "made"], ["second", "made"], ["third", "made"]]  # fmt: skip
    assert not (photos.parent / "out").exists()


def test_commands_on_folders_without_a_run(tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    for arguments in (["report", str(tmp_path)], ["view", str(tmp_path)], ["validate", str(tmp_path / "a.usd")],
                      ["render", str(tmp_path), "--out", str(tmp_path / "o")]):  # fmt: skip
        assert main(arguments) == 1
        assert capsys.readouterr().err.startswith("error: ")
    (tmp_path / "run.json").write_text("[]")
    assert main(["report", str(tmp_path)]) == 1


def test_a_capture_that_is_not_there(tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    assert main(["run", str(tmp_path / "gone"), "--out", str(tmp_path / "out")]) == 1
    assert str(tmp_path / "gone") in capsys.readouterr().err
    assert list(tmp_path.iterdir()) == []


@pytest.mark.usefixtures("toys")
@pytest.mark.parametrize(
    ("options", "stopped", "code", "event"),
    [
        (["--set", "second.fault=stage"], None, 1, "error"),
        (["--preset", "drfat"], None, 2, "error"),
        ([], 130, 130, "stopped"),
        ([], 143, 143, "stopped"),
    ],
)
def test_verbose_adds_a_traceback_and_changes_nothing_else(
    options: list[str],
    stopped: int | None,
    code: int,
    event: str,
    photos: Path,
    monkeypatch: pytest.MonkeyPatch,
    capsys: pytest.CaptureFixture[str],
) -> None:
    def progress(console: Console, *given: object, **figures: float) -> None:
        if stopped is not None:
            error = Cancelled("stopped by the user")
            error.exit_code = stopped  # as after a signal
            raise error

    monkeypatch.setattr(Console, "progress", progress)
    said = []
    for verbose in ([], ["--verbose"]):
        assert main([*verbose, "run", str(photos), "--out", str(photos.parent / "out"), "--json", *options]) == code
        told = capsys.readouterr()
        last = json.loads(told.out.splitlines()[-1])
        assert (last["event"], last["exit_code"]) == (event, code)
        assert ("Traceback" in told.err) == bool(verbose)
        said.append(last["text"])
    assert said[0] == said[1]


# ------------------------------------------------------------------ runs
@pytest.mark.slow
def test_run_reuse_fail_and_tidy(photos: Path, child_environment: dict[str, str]) -> None:
    out = photos.parent / "out"
    code, stdout, err = neuface(child_environment, "run", photos, "--out", out)
    assert code == 0, err
    assert "Traceback" not in err
    assert "3 stages, 0 reused" in stdout
    record = json.loads((out / "run.json").read_text())
    assert list(record["stages"]) == ["first", "second", "third"]
    assert all({"key", "reused", "seconds", "peak_memory_mb"} <= s.keys() for s in record["stages"].values())
    code, stdout, err = neuface(child_environment, "run", photos, "--out", out, "--set", "third.plus=1")
    assert code == 0, err
    assert "3 stages, 2 reused" in stdout
    code, stdout, err = neuface(child_environment, "run", photos, "--out", out, "--set", "second.fault=stage")
    assert code == 1
    for part in ("the toy is broken", "part 7", "found: 3", "limit: 4", "mend it"):
        assert part in err
    assert "Traceback" not in err
    assert err.count("the toy is broken") == 1  # once, not again from Prefect's own log
    assert list(json.loads((out / "run.json").read_text())["stages"]) == ["first", "second", "third"]


@pytest.mark.slow
def test_a_first_stage_that_fails_leaves_no_folder(photos: Path, child_environment: dict[str, str]) -> None:
    out = photos.parent / "new" / "out"
    code, _, err = neuface(child_environment, "run", photos, "--out", out, "--set", "first.fault=stage")
    assert code == 1
    assert "the first toy is broken" in err
    assert [p.name for p in photos.parent.iterdir()] == ["photos"]


@pytest.mark.slow
def test_a_bug_shows_its_traceback_and_fails(photos: Path, child_environment: dict[str, str]) -> None:
    code, _, err = neuface(child_environment, "run", photos, "--out", photos.parent / "out", "--set",
                           "second.fault=bug")  # fmt: skip
    assert code == 1
    assert "ZeroDivisionError: a bug of the stage" in err


@pytest.mark.slow
def test_verdicts_and_their_exit_codes_through_the_flow(photos: Path, child_environment: dict[str, str]) -> None:
    out = photos.parent / "out"
    bad = ("run", photos, "--out", out, "--set", "second.level=unusable")
    code, stdout, err = neuface(child_environment, *bad)
    assert code == 3, err
    assert "--force continues" in err and "Traceback" not in err
    assert stdout.splitlines()[-2].startswith("verdict: unusable (second unusable")
    assert "take the broken toys again" in stdout.splitlines()[-1]
    assert list(json.loads((out / "run.json").read_text())["stages"]) == ["first", "second"]
    code, stdout, err = neuface(child_environment, *bad, "--force")
    assert code == 3 and "3 stages, 2 reused" in stdout, err
    usable = ("run", photos, "--out", out, "--set", "third.level=usable")
    assert neuface(child_environment, *usable)[0] == 0
    code, stdout, err = neuface(child_environment, *usable, "--strict")
    assert code == 3 and "3 stages, 3 reused" in stdout, err


@pytest.mark.slow
def test_ctrl_c_keeps_what_is_finished_and_the_run_goes_on(
    photos: Path, child_environment: dict[str, str], tmp_path: Path
) -> None:
    out, point = photos.parent / "out", hold("second.step@4", tmp_path / "signs")
    environment = {**child_environment, **point.environment()}
    child = start(environment, "run", photos, "--out", out, "--set", "second.steps=100")
    point.wait(child)
    os.killpg(child.pid, signal.SIGINT)  # as a terminal does: all that runs in it gets it
    err = read_until(child.stderr, "stopping at the next checkpoint")
    point.release()
    err += child.communicate(timeout=PATIENCE)[1]
    assert child.returncode == 130, err
    assert "stopping at the next checkpoint" in err
    assert "run the same command again to resume" in err
    assert "Traceback" not in err
    assert len([p for p in (out / ".store/first").iterdir() if "." not in p.name]) == 1
    assert not list((out / ".store").glob("second/*.partial-*"))
    checkpoint = next((out / ".store").glob("second/*.scratch/step.txt"))
    assert int(checkpoint.read_text()) == 4  # the step at work was finished, and no other begun


@pytest.mark.slow
def test_a_second_ctrl_c_stops_at_once(photos: Path, child_environment: dict[str, str], tmp_path: Path) -> None:
    """The stage is deep in something that does not look up: it is never released, and ends all the same."""
    out, point = photos.parent / "out", hold("second.step", tmp_path / "signs")
    environment = {**child_environment, **point.environment()}
    child = start(environment, "run", photos, "--out", out, "--set", "second.steps=2")
    point.wait(child)
    child.send_signal(signal.SIGINT)
    read_until(child.stderr, "stopping at the next checkpoint")
    assert child.poll() is None
    child.send_signal(signal.SIGINT)
    child.communicate(timeout=PATIENCE)
    assert child.returncode == 130


def test_the_way_from_main_to_the_first_stage_is_short(
    photos: Path, toys: None, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    """Six calls, as docs/architecture.md shows them."""
    first, *rest = TOYS
    stack: list[str] = []

    def noted(*arguments: Any) -> Any:
        stack.extend(f.function for f in inspect.stack(0))
        return first.run(*arguments)

    monkeypatch.setattr(registry, "REGISTRY", [dataclasses.replace(first, run=noted), *rest])
    assert main(["run", str(photos), "--out", str(tmp_path / "out")]) == 0
    assert stack[: stack.index("main")] == ["noted", "execute", "run_stages", "run_as_asked", "run", "run_command"]
