"""Faults that really happen: processes killed, disks full and read-only, stages that hang, clocks that jump.

What is damaged in the store is in tests/core/test_contract.py; workers, server and database in
tests/workflows/test_batch_pool.py; a killed fit in tests/end_to_end.
"""

from __future__ import annotations

import json
import os
import shutil
import signal
import subprocess
import sys
from collections import Counter
from collections.abc import Iterator
from pathlib import Path

import pytest

from tests.support.clock import compiler, jumping_clock
from tests.support.facescape_tree import write_tree
from tests.support.points import PATIENCE, hold, read_until, wait_for
from workflows.run.request import RunRequest

pytestmark = pytest.mark.slow
SUPPORT = Path(__file__).parents[1] / "support"
TOY_BATCH = SUPPORT / "toy_batch.py"
STOPPING = "stopping at the next checkpoint"


@pytest.fixture
def tree(tmp_path: Path) -> Path:
    write_tree(tmp_path / "tree", {"1/1_neutral": True, "1/2_smile": True})
    return tmp_path / "tree"


@pytest.fixture
def environment(tmp_path: Path, child_environment: dict[str, str]) -> dict[str, str]:
    return {**child_environment, "NEUFACE_TALLY": str(tmp_path / "tally")}


def start(environment: dict[str, str], *arguments: object) -> subprocess.Popen[str]:
    return subprocess.Popen([sys.executable, *map(str, arguments)], env=environment, text=True,
                            stdout=subprocess.PIPE, stderr=subprocess.PIPE, start_new_session=True)  # fmt: skip


def finish(child: subprocess.Popen[str]) -> tuple[int, str]:
    out, err = child.communicate(timeout=PATIENCE)
    return child.returncode, out + err


def batch(tree: Path, *options: object) -> list[object]:
    return [TOY_BATCH, "batch", tree, "--out", tree.parent / "out", *options]


def slow(steps: int) -> list[str]:
    return ["--set", f"work.steps={steps}"]


def summary(tree: Path) -> dict[str, dict[str, object]]:
    content = json.loads((tree.parent / "out/batch/summary.json").read_text())
    return {c["name"]: c for c in content["captures"]}


def tally(tree: Path) -> Counter[str]:
    return Counter((tree.parent / "tally").read_text().split("\n")[:-1])


# ------------------------------------------------------------------ processes
def test_one_captures_process_killed_costs_one_attempt(tree: Path, environment: dict[str, str]) -> None:
    code, said = finish(start(environment, *batch(tree, "--set", "work.fault=killed once", "--workers", "2")))
    assert code == 0, said
    assert "trying again (lost): the process ended without a message (signal 9)" in said
    assert {c["attempts"] for c in summary(tree).values()} == {2}
    assert set(tally(tree).values()) == {1}


def test_an_unusable_result_is_written_and_not_tried_again(tree: Path, environment: dict[str, str]) -> None:
    write_tree(tree, {"2/1_neutral": True}, side=80)
    options = ["--set", "work.doubted_width=80"]
    code, said = finish(start(environment, *batch(tree, *options)))
    assert code == 3, said
    states = {name: (c["state"], c["level"], c["attempts"]) for name, c in summary(tree).items()}
    assert states == {"1/1_neutral": ("done", "good", 1), "1/2_smile": ("done", "good", 1),
                      "2/1_neutral": ("unusable", "unusable", 1)}  # fmt: skip
    assert (tree.parent / "out/2/1_neutral/asset/head_2_1_neutral.usd").is_file()
    code, said = finish(start(environment, *batch(tree, *options)))
    assert code == 3 and "3 of them done before" in said
    assert {c["attempts"] for c in summary(tree).values()} == {1}


def test_the_batch_itself_killed_leaves_no_process_and_goes_on(tree: Path, environment: dict[str, str]) -> None:
    point = hold("work.checkpoint@2", tree.parent / "signs")
    child = start({**environment, **point.environment()}, *batch(tree, *slow(20), "--workers", "2"))
    step = tree.parent / "out/.store/work"
    point.wait(child, processes=2)
    os.kill(child.pid, signal.SIGKILL)
    point.release()
    child.communicate()
    wait_for(lambda: not alive_below(tree.parent))  # nobody reads them any more
    assert sum(int(p.read_text()) for p in step.glob("*.scratch/step.txt")) >= 4
    code, said = finish(start(environment, *batch(tree, *slow(20), "--workers", "2")))
    assert code == 0, said
    assert set(tally(tree).values()) == {1}


def alive_below(folder: Path) -> list[str]:
    """Command lines of processes that have a file below `folder` open."""
    found = []
    for entry in Path("/proc").glob("[0-9]*/fd/*"):
        try:
            if str(entry.readlink()).startswith(str(folder)) and str(os.getpid()) != entry.parts[2]:
                found.append((entry.parents[1] / "cmdline").read_text())
        except OSError:
            continue
    return [f for f in found if "toy_batch" in f]


def test_ctrl_c_stops_at_a_checkpoint_and_twice_at_once(tree: Path, environment: dict[str, str]) -> None:
    point = hold("work.checkpoint", tree.parent / "signs")
    child = start({**environment, **point.environment()}, *batch(tree, *slow(30)))
    point.wait(child)
    child.send_signal(signal.SIGINT)
    code, said = finish(child)  # the captures' processes are never released: they go on when they hear of it
    assert code == 130, said
    assert "the same command resumes" in said
    assert list((tree.parent / "out/.store/work").glob("*.scratch/step.txt"))
    never = hold("work.hangs", tree.parent / "more signs")
    hangs = start({**environment, **never.environment()}, *batch(tree, "--set", "work.fault=hangs", *slow(1)))
    never.wait(hangs)
    hangs.send_signal(signal.SIGINT)
    assert hangs.stderr is not None
    read_until(hangs.stderr, STOPPING)
    assert hangs.poll() is None
    hangs.send_signal(signal.SIGINT)  # the stage is never released, and the batch ends all the same
    assert finish(hangs)[0] == 130
    wait_for(lambda: not alive_below(tree.parent))


# ------------------------------------------------------------------ stages that hang
@pytest.mark.parametrize(
    ("fault", "told"),
    [("hangs politely", "took longer than it may"), ("hangs in C", "was ended")],
)
def test_a_stage_that_hangs_is_ended_and_the_next_capture_runs(
    tree: Path, environment: dict[str, str], fault: str, told: str
) -> None:
    rows = [{"capture": "1/1_neutral", "name": "good", "until": "capture"}, {"capture": "1/2_smile", "name": "bad"}]
    (tree / "list.json").write_text(json.dumps(rows))
    options = ["--out", tree.parent / "out", "--stage-limit", "15s", "--set", f"work.fault={fault}", "--workers", "2"]
    code, said = finish(start(environment, TOY_BATCH, "batch", tree / "list.json", *options))
    assert code == 1  # ended at all: the toy hangs for ever
    found = summary(tree)
    assert found["good"]["state"] == "done" and found["bad"]["state"] == "failed"
    assert told in str(found["bad"]["fault"]), said
    assert found["bad"]["attempts"] == 1  # it would hang again
    if fault != "hangs politely":  # where it hung is in the log
        assert "run_work" in (tree.parent / "out/batch/logs/bad.log").read_text()


# ------------------------------------------------------------------ disks
@pytest.fixture
def small_disk(tmp_path: Path) -> Iterator[Path]:
    """A file system of 2 MB."""
    place = tmp_path / "disk"
    place.mkdir()
    if subprocess.run(["mount", "-t", "tmpfs", "-o", "size=64m", "tmpfs", place], capture_output=True).returncode:
        pytest.skip("this user may not mount a tmpfs")
    try:
        yield place
    finally:
        subprocess.run(["umount", "-l", place], check=True)


def test_a_disk_that_runs_full_stops_the_batch_and_it_goes_on_with_space(
    tree: Path, environment: dict[str, str], small_disk: Path
) -> None:
    filler = small_disk / "filler"
    filler.write_bytes(bytes(shutil.disk_usage(small_disk).free - 40_000))
    options = ["--out", small_disk / "out"]
    code, said = finish(start(environment, TOY_BATCH, "batch", tree, *options))
    assert code == 1, said
    assert "space is left on the disk" in said  # asked for before, or met while writing
    assert "Traceback" not in said
    filler.unlink()
    code, said = finish(start(environment, TOY_BATCH, "batch", tree, *options))
    assert code == 0, said
    finished = [p for p in (small_disk / "out/.store").glob("*/*") if len(p.name) == 64]
    assert finished and all((p / "manifest.json").is_file() for p in finished)
    assert not list((small_disk / "out/.store").glob("*/*.partial-*"))


def test_a_limit_on_file_sizes_is_told_in_plain_words(tree: Path, environment: dict[str, str]) -> None:
    """Where nobody may mount: RLIMIT_FSIZE of 10 kB, beneath the toy's 64 kB."""
    limited = "import resource, runpy, sys; resource.setrlimit(resource.RLIMIT_FSIZE, (10240, 10240));"
    limited += f"sys.argv = sys.argv[1:]; runpy.run_path({str(TOY_BATCH)!r}, run_name='__main__')"
    code, said = finish(start(environment, "-c", limited, *batch(tree)))
    assert code == 1
    assert "larger than the limit for files" in said, said


def test_a_read_only_store_is_told_before_any_work(tree: Path, environment: dict[str, str], small_disk: Path) -> None:
    (small_disk / "store").mkdir()
    subprocess.run(["mount", "-o", "remount,ro", small_disk], check=True)
    code, said = finish(start(environment, *batch(tree, "--store", small_disk / "store")))
    assert code == 1
    assert "the disk is read-only" in said and "--store" in said
    assert not (tree.parent / "tally").exists()


# ------------------------------------------------------------------ two at once
def test_two_runs_of_one_capture_into_one_folder_at_once(tree: Path, environment: dict[str, str]) -> None:
    """One waits for the other and then finds everything done."""
    out = tree.parent / "one"
    asked = RunRequest(capture=str(tree / "1/1_neutral"), out=str(out), sets=("work.steps=8",))
    children = []
    point = hold("work.step@4", tree.parent / "signs")
    for _ in range(2):
        child = subprocess.Popen([sys.executable, TOY_BATCH, "--child", "1", str(os.getpid())],
                                 env={**environment, **point.environment()}, text=True,
                                 stdin=subprocess.PIPE, stdout=subprocess.PIPE, stderr=subprocess.PIPE)  # fmt: skip
        assert child.stdin is not None
        child.stdin.write(asked.model_dump_json() + "\n")
        child.stdin.flush()  # and not closed: its end would mean stop
        children.append(child)
    point.wait(*children)
    first = next(c for c in children if c.pid in point.reached())
    second = next(c for c in children if c is not first)
    assert second.stderr is not None
    read_until(second.stderr, "another run writes to")
    point.release()
    assert [c.wait(PATIENCE) for c in children] == [0, 0]
    assert all("another run writes to" not in c.communicate()[1] for c in children)  # told once, by the second
    assert set(tally(tree).values()) == {1}
    assert json.loads((out / "run.json").read_text())["stages"]["work"]["reused"]
    assert not [p for p in out.iterdir() if ".partial" in p.name or ".old" in p.name]


def test_two_batches_into_one_folder_at_once(tree: Path, environment: dict[str, str]) -> None:
    children = [start(environment, *batch(tree, *slow(5))) for _ in range(2)]
    ends = [finish(c) for c in children]
    assert [code for code, _ in ends] == [0, 0], ends
    assert set(tally(tree).values()) == {1}
    assert any("2 of them done before" in said for _, said in ends)


# ------------------------------------------------------------------ clocks
@pytest.mark.skipif(compiler() is None, reason="no C compiler to make a clock that jumps")
def test_the_wall_clock_jumps_back_a_year_in_mid_stage(tree: Path, tmp_path: Path, environment: dict[str, str]) -> None:
    """Time limits and retries go by a clock that does not jump; keys know no time."""
    sign = tmp_path / "jump"
    jumping = {**environment, **jumping_clock(tmp_path, sign, 365 * 86400)}
    probe = [sys.executable, "-c", "import time; print(time.time())"]
    before = float(subprocess.run(probe, env=jumping, capture_output=True, check=True).stdout)
    point = hold("work.checkpoint@3", tmp_path / "signs")
    child = start({**jumping, **point.environment()}, *batch(tree, *slow(10), "--stage-limit", "600s"))
    point.wait(child)
    sign.write_text("")
    after = float(subprocess.run(probe, env=jumping, capture_output=True, check=True).stdout)
    assert after < before - 3e7, "the clock did not jump"
    point.release()
    code, said = finish(child)
    assert code == 0, said
    assert set(tally(tree).values()) == {1}
    seconds = [c["figures"]["seconds"] for c in summary(tree).values()]  # type: ignore[index]
    assert all(0 < s < 3600 for s in seconds)  # and not a year, nor less than nothing
