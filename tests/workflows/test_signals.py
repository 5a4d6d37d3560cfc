"""Signals: at a named point of a run, during the imports, and what a process that dies leaves behind."""

from __future__ import annotations

import os
import signal
import subprocess
import sys
from pathlib import Path
from typing import Any

import pytest

from tests.support.points import wait_for

TOY = Path(__file__).parents[1] / "support" / "toy_neuface.py"
ALL = (signal.SIGINT, signal.SIGTERM, signal.SIGHUP)

# In place of a clock: the interpreter loads this before anything else and signals itself, or waits, at a named import.
AT_IMPORT = """
import os, signal, sys
class At:
    def find_spec(self, name, path=None, target=None):
        if name == os.environ.get("TEST_AT_IMPORT"):
            os.environ.pop("TEST_AT_IMPORT")
            os.kill(os.getpid(), int(os.environ["TEST_SIGNAL"]))
sys.meta_path.insert(0, At())
"""


def start(environment: dict[str, str], *arguments: object, **more: Any) -> subprocess.Popen[str]:
    return subprocess.Popen(
        [sys.executable, *map(str, arguments)],
        env=environment,
        text=True,
        stdout=subprocess.PIPE,
        stderr=subprocess.PIPE,
        start_new_session=True,
        **more,
    )


def held(photos: Path, environment: dict[str, str], *more: str) -> tuple[subprocess.Popen[str], Path]:
    """A run that is in the middle of its slow stage, which never ends by itself and looks up ten times a second."""
    out = photos.parent / "out"
    child = start(environment, TOY, "run", photos, "--out", out, "--set", "second.steps=1000000",
                  "--set", "second.pause=0.1", *more)  # fmt: skip
    wait_for(lambda: child.poll() is not None or list((out / ".store").glob("second/*.scratch/step.txt")), 300)
    assert child.poll() is None, child.communicate()
    return child, out


@pytest.mark.slow
@pytest.mark.parametrize("number", ALL)
def test_each_signal_stops_a_run_at_its_checkpoint(
    photos: Path, child_environment: dict[str, str], number: signal.Signals
) -> None:
    child, out = held(photos, child_environment)
    child.send_signal(number)
    _, err = child.communicate(timeout=120)
    assert child.returncode == 128 + number, err
    assert "run the same command again to resume" in err and "Traceback" not in err
    assert not (out / "run.json").exists() and not list((out / ".store").glob("second/*.partial-*"))
    assert list((out / ".store").glob("second/*.scratch/step.txt"))


@pytest.mark.slow
@pytest.mark.parametrize("number", ALL)
def test_the_second_signal_ends_a_run_at_once(
    photos: Path, child_environment: dict[str, str], number: signal.Signals
) -> None:
    out = photos.parent / "out"
    child = start(child_environment, TOY, "run", photos, "--out", out, "--set", "second.steps=2", "--set",
                  "second.pause=3600")  # fmt: skip
    wait_for(lambda: child.poll() is not None or list((out / ".store").glob("second/*.partial-*/part0.bin")), 300)
    child.send_signal(signal.SIGTERM)
    assert child.stderr is not None
    for line in child.stderr:
        if "stopping at the next checkpoint" in line:
            break
    child.send_signal(number)
    child.communicate(timeout=120)
    assert child.returncode == 128 + number


@pytest.mark.slow
def test_a_terminal_that_is_gone_changes_no_exit_code(photos: Path, child_environment: dict[str, str]) -> None:
    master, slave = os.openpty()
    out = photos.parent / "out"
    child = subprocess.Popen(
        [sys.executable, str(TOY), "run", str(photos), "--out", str(out), "--set", "second.steps=1000000", "--set",
         "second.pause=0.1"], env=child_environment, stdin=slave, stdout=slave, stderr=slave,
        start_new_session=True)  # fmt: skip
    os.close(slave)
    wait_for(lambda: child.poll() is not None or list((out / ".store").glob("second/*.scratch/step.txt")), 300)
    os.close(master)  # every write to the terminal fails from now on
    child.send_signal(signal.SIGHUP)
    assert child.wait(120) == 129
    assert list((out / ".store").glob("second/*.scratch/step.txt"))


@pytest.mark.parametrize("number", ALL)
@pytest.mark.parametrize("module", ["argparse", "pipeline.errors", "workflows.cli.command_options"])
def test_a_signal_during_the_imports_shows_no_traceback(
    tmp_path: Path, child_environment: dict[str, str], number: signal.Signals, module: str
) -> None:
    (tmp_path / "sitecustomize.py").write_text(AT_IMPORT)
    environment = {
        **child_environment,
        "PYTHONPATH": f"{tmp_path}{os.pathsep}{child_environment['PYTHONPATH']}",
        "TEST_AT_IMPORT": module,
        "TEST_SIGNAL": str(int(number)),
    }
    for how in (["-m", "workflows.cli"], ["-c", "from workflows.cli.entry import main; main()"]):
        child = start(environment, *how, "run", "x", "--out", tmp_path / "out")
        out, err = child.communicate(timeout=120)
        assert (child.returncode, out, err) == (128 + number, "", ""), how


@pytest.mark.parametrize("number", ALL)
def test_a_command_without_stages_is_tidied_and_stops(
    tmp_path: Path, child_environment: dict[str, str], number: signal.Signals
) -> None:
    program = f"""
import sys, os, signal
from workflows.cli.main import main
from workflows.cli import commands
def command(options, console):
    try:
        os.kill(os.getpid(), {int(number)})
        while True: pass
    finally:
        print("tidied")
commands.doctor_command = command
sys.exit(main(["doctor"]))
"""
    child = start(child_environment, "-c", program)
    out, err = child.communicate(timeout=120)
    assert (child.returncode, out, err) == (128 + number, "tidied\n", "stopped\n")


COMMAND = """
import os, sys, threading
from workflows.cli.main import main
from workflows.cli import commands
from workflows.run.interrupt import interruptible
def command(options, console):
    {body}
commands.doctor_command = command
sys.exit(main(["doctor"]))
"""


def told(environment: dict[str, str], body: str) -> tuple[int, str, str]:
    program = COMMAND.format(body=body.strip().replace("\n", "\n    "))
    child = start(environment, "-c", program)
    out, err = child.communicate(timeout=120)
    return child.returncode, out, err


@pytest.mark.parametrize("number", ALL)
def test_an_exception_that_python_drops_is_raised_again(
    child_environment: dict[str, str], number: signal.Signals
) -> None:
    body = f"""
class Part:
    def __del__(self):
        os.kill(os.getpid(), {int(number)})
        self.after = 1
try:
    part = Part()
    del part
    while True: pass
finally:
    print("tidied")
"""
    assert told(child_environment, body) == (128 + number, "tidied\n", "stopped\n")


def test_a_library_that_catches_the_exception_does_not_make_the_command_succeed(
    child_environment: dict[str, str],
) -> None:
    caught = f"""
try:
    os.kill(os.getpid(), {int(signal.SIGTERM)})
    while True: pass
except BaseException:
    pass
"""
    assert told(child_environment, f"{caught}\nreturn 0") == (143, "", "stopped\n")
    run = "with interruptible(threading.Event(), print): print('the run began')"
    assert told(child_environment, f"{caught}\n{run}") == (143, "", "stopped\n")


@pytest.mark.parametrize("number", ALL)
def test_a_library_that_makes_an_error_of_the_exception_hides_no_signal(
    child_environment: dict[str, str], number: signal.Signals
) -> None:
    body = f"""
try:
    os.kill(os.getpid(), {int(number)})
    while True: pass
except BaseException as e:
    raise ValueError(f"Interrupted: {{e}}")
"""
    assert told(child_environment, body) == (128 + number, "", "stopped\n")


def test_the_second_signal_outside_of_a_run_ends_it_at_once(child_environment: dict[str, str]) -> None:
    body = f"""
try:
    os.kill(os.getpid(), {int(signal.SIGTERM)})
    while True: pass
finally:
    os.kill(os.getpid(), {int(signal.SIGHUP)})
    while True: pass
"""
    assert told(child_environment, body) == (129, "", "")


def test_a_reader_of_stdout_that_is_gone(child_environment: dict[str, str]) -> None:
    for body in ("print('x' * 1000000)", "print('short')"):
        program = COMMAND.format(body=f"{body}; return 0")
        child = start(child_environment, "-c", program)
        assert child.stdout is not None and child.stderr is not None
        child.stdout.close()
        assert (child.wait(120), child.stderr.read()) == (141, "")


PUBLISHED = """
import os, runpy, sys
from workflows.run import publish
real = publish.{where}
def signalled(*arguments):
    publish.{where} = real
    os.kill(os.getpid(), {number})
    import time; time.sleep(0.3)  # the thread that reads signals
    return real(*arguments)
publish.{where} = signalled
sys.argv = sys.argv[1:]
runpy.run_path(sys.argv[0], run_name="__main__")
"""


@pytest.mark.parametrize(("where", "whole"), [("published", False), ("note_published", True), ("write_owned", True)])
def test_a_signal_while_results_are_published(
    photos: Path, child_environment: dict[str, str], where: str, whole: bool
) -> None:
    """All of them are put in place, or none; the exit code is the signal's."""
    out = photos.parent / "out"
    program = PUBLISHED.format(where=where, number=int(signal.SIGTERM))
    child = start(child_environment, "-c", program, TOY, "run", photos, "--out", out)
    _, err = child.communicate(timeout=240)
    assert child.returncode == 143, err
    assert (out / "run.json").is_file() == whole and ("complete" in err) == whole
    assert "Traceback" not in err and not [p for p in out.iterdir() if ".partial" in p.name]


def test_nohup_is_heeded(photos: Path, child_environment: dict[str, str]) -> None:
    program = """
import os, signal, sys, threading
signal.signal(signal.SIGHUP, signal.SIG_IGN)
from workflows.run.interrupt import as_exceptions, interruptible
stop = threading.Event()
with as_exceptions(), interruptible(stop, print):
    os.kill(os.getpid(), signal.SIGHUP)
    print(stop.is_set(), signal.getsignal(signal.SIGHUP) is signal.SIG_IGN)
"""
    child = start(child_environment, "-c", program)
    assert child.communicate(timeout=120)[0] == "False True\n"


def test_pycolmap_takes_no_signal_from_a_run(child_environment: dict[str, str]) -> None:
    program = """
import os, signal, sys, threading
from workflows.run.interrupt import interruptible
stop = threading.Event()
with interruptible(stop, lambda text: None) as caught:
    from {where}
    os.kill(os.getpid(), signal.SIGTERM)
    stop.wait(60)
    print(caught.number)
"""
    for where, told in (("pipeline.colmap import pycolmap", "15\n"), ("pycolmap import Camera", "")):
        child = start(child_environment, "-c", program.format(where=where))
        out, err = child.communicate(timeout=120)
        assert out == told, err  # without our import its own handler ends the process
        assert ("SIGTERM" in err) == (told == "")


# ------------------------------------------------------------------ who dies with whom
def alive(pid: int) -> bool:
    try:
        return Path(f"/proc/{pid}/stat").read_text().rpartition(")")[2].split()[0] != "Z"
    except OSError:
        return False


PARENT = """
import os, subprocess, sys, time
code = '''
import os, sys, time
from workflows.run.interrupt import end_with
end_with(int(sys.argv[1]))
print(os.getpid(), flush=True)
time.sleep(3600)
'''
child = subprocess.Popen([sys.executable, {how}], start_new_session=True)
time.sleep(3600)
"""


@pytest.mark.parametrize(
    "how", ["'-c', code, str(os.getpid())",
            "'-m', 'workflows.server.kept_child', str(os.getpid()), '-c', 'import os, time; "
            "print(os.getpid(), flush=True); time.sleep(3600)'"],
)  # fmt: skip
def test_a_child_dies_with_a_killed_parent(child_environment: dict[str, str], how: str) -> None:
    parent = start(child_environment, "-c", PARENT.format(how=how))
    assert parent.stdout is not None
    pid = int(parent.stdout.readline())
    assert alive(pid)
    parent.kill()
    parent.wait()
    wait_for(lambda: not alive(pid))


def test_a_child_whose_parent_is_gone_does_not_begin(child_environment: dict[str, str]) -> None:
    ended = subprocess.run([sys.executable, "-c", "import sys; from workflows.run.interrupt import end_with; "
                            "end_with(1 if __import__('os').getppid() != 1 else 2); print('began')"],
                           env=child_environment, capture_output=True, text=True)  # fmt: skip
    assert (ended.returncode, ended.stdout) == (128 + signal.SIGKILL, "")


# ------------------------------------------------------------------ no Prefect
@pytest.mark.slow
def test_a_local_run_and_its_report_never_import_prefect(photos: Path, child_environment: dict[str, str]) -> None:
    program = """
import runpy, sys
sys.modules["prefect"] = None
sys.argv = sys.argv[1:]
runpy.run_path(sys.argv[0], run_name="__main__")
"""
    out = photos.parent / "out"
    for command in (["run", photos, "--out", out], ["run", photos, "--out", out, "--dry-run"]):
        child = start(child_environment, "-c", program, TOY, *command)
        _, err = child.communicate(timeout=240)
        assert child.returncode == 0, err
    assert not (out / ".store/.prefect").exists()
    assert not [p for p in Path("/proc").glob("[0-9]*") if _told_of(p, str(out))]


def _told_of(process: Path, text: str) -> bool:
    try:
        return text in (process / "cmdline").read_text() or text in (process / "environ").read_text()
    except OSError:
        return False
