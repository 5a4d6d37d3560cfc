"""The content key, and what execute does when a stage finishes, fails, is stopped or killed."""

from __future__ import annotations

import dataclasses
import errno
import hashlib
import json
import os
import shutil
import signal
import subprocess
import sys
from pathlib import Path
from typing import Any

import pytest

from pipeline import threads
from pipeline.artifacts import FileRef, Located
from pipeline.asset_artifacts import Report
from pipeline.contract import Stage, execute, inputs_from, key
from pipeline.errors import Cancelled, DiskError, StageError
from pipeline.store import Store, link_or_copy
from tests.support.points import hold
from tests.support.toy_stages import FIRST, SECOND, THIRD, Config, FirstInputs, Number, SlowConfig, source


@pytest.fixture
def photos(tmp_path: Path) -> Path:
    folder = tmp_path / "photos"
    folder.mkdir()
    (folder / "a.jpg").write_bytes(b"first photo")
    (folder / "b.jpg").write_bytes(b"second photo")
    return folder


@pytest.fixture
def store(tmp_path: Path) -> Store:
    return Store(tmp_path / "store")


def run_second(store: Store, photos: Path, config: SlowConfig | None = None, **kwargs: Any) -> Any:
    first = execute(FIRST, FirstInputs(source(photos)), Config(), store)
    return execute(SECOND, inputs_from(SECOND, {"first": first.located}), config or SlowConfig(), store, **kwargs)


def entries(store: Store, stage: str) -> list[str]:
    folder = store.root / stage
    return sorted(p.name for p in folder.iterdir()) if folder.is_dir() else []


# ------------------------------------------------------------------ the key
def base_key(photos: Path) -> str:
    return key(FIRST, FirstInputs(source(photos)), Config())


def test_key_is_the_digest_of_what_it_names(photos: Path) -> None:
    """SHA-256 of stage, version, settings and inputs as JSON with sorted keys, written out: 64 hex digits that another
    process and another machine find too."""
    plain = {
        "stage": FIRST.name, "version": FIRST.version, "config": json.loads(Config().model_dump_json()),
        "inputs": {"source": source(photos).artifact.digest()}, "threads": threads.in_use(),
    }  # fmt: skip
    assert base_key(photos) == hashlib.sha256(json.dumps(plain, sort_keys=True).encode()).hexdigest()


@pytest.mark.parametrize("name", threads.NAMES)
def test_key_sees_the_number_of_threads_where_bytes_depend_on_it(
    photos: Path, monkeypatch: pytest.MonkeyPatch, name: str
) -> None:
    """Sums in another order have other last digits: a result of two threads is not that of one."""
    inputs, alike = FirstInputs(source(photos)), dataclasses.replace(FIRST, any_threads=True)
    found = []
    for number in ("1", "2", "1"):
        monkeypatch.setenv(name, number)
        found.append((key(FIRST, inputs, Config()), key(alike, inputs, Config())))
    assert found[0] == found[2] and found[0][0] != found[1][0]
    assert found[0][1] == found[1][1] != found[0][0]


def test_the_number_of_threads_is_that_of_the_cores_where_nothing_sets_it(monkeypatch: pytest.MonkeyPatch) -> None:
    for name in threads.NAMES:
        monkeypatch.delenv(name, raising=False)
    cores = str(len(os.sched_getaffinity(0)))
    assert threads.in_use() == [cores] * 3
    monkeypatch.setenv("NUMBA_NUM_THREADS", "")
    monkeypatch.setenv("OMP_NUM_THREADS", "7")
    assert threads.in_use() == ["7", cores, cores]


def test_key_ignores_where_and_when(photos: Path, tmp_path: Path) -> None:
    before = base_key(photos)
    os.utime(photos / "a.jpg", (1, 1))
    moved = tmp_path / "elsewhere" / "deep"
    shutil.copytree(photos, moved)
    assert base_key(photos) == before == base_key(moved)


def test_key_sees_one_changed_byte(photos: Path) -> None:
    before = base_key(photos)
    (photos / "a.jpg").write_bytes(b"first phot0")
    assert base_key(photos) != before


def test_key_sees_a_renamed_photo(photos: Path) -> None:
    before = base_key(photos)
    (photos / "a.jpg").rename(photos / "c.jpg")
    assert base_key(photos) != before


def test_key_sees_config_version_and_name(photos: Path) -> None:
    inputs = FirstInputs(source(photos))
    version = Stage("first", 2, FIRST.inputs, FIRST.config, FIRST.output, FIRST.run)
    name = Stage("other", 1, FIRST.inputs, FIRST.config, FIRST.output, FIRST.run)
    keys = {
        key(FIRST, inputs, Config()),
        key(FIRST, inputs, Config(plus=1)),
        key(FIRST, inputs, Config(seed=1)),
        key(version, inputs, Config()),
        key(name, inputs, Config()),
    }
    assert len(keys) == 5
    assert key(FIRST, inputs, Config(plus=0)) == key(FIRST, inputs, Config())


def test_key_of_a_later_stage_changes_only_with_what_it_gets(photos: Path, store: Store) -> None:
    """Settings of `second` do not reach `first`; a change that leaves first's output alone leaves second's key."""
    first = execute(FIRST, FirstInputs(source(photos)), Config(), store)
    again = execute(FIRST, FirstInputs(source(photos)), Config(seed=5), store)
    assert first.key != again.key
    a = key(SECOND, inputs_from(SECOND, {"first": first.located}), SlowConfig())
    b = key(SECOND, inputs_from(SECOND, {"first": again.located}), SlowConfig())
    assert a == b  # the seed changed nothing in first's content


def test_inputs_are_wired_by_name(photos: Path, store: Store) -> None:
    first = execute(FIRST, FirstInputs(source(photos)), Config(), store)
    second = run_second(store, photos, SlowConfig(plus=5))
    inputs = inputs_from(THIRD, {"second": second.located, "first": first.located, "unused": first.located})
    done = execute(THIRD, inputs, Config(), store)
    assert done.located.artifact.total == 2 * len(b"first photosecond photo") + 5


# ------------------------------------------------------------------ execute
def test_a_finished_stage_is_reused_with_its_run_record(photos: Path, store: Store) -> None:
    made, again = run_second(store, photos), run_second(store, photos)
    assert (made.reused, again.reused) == (False, True)
    assert again.located == made.located
    assert again.run == made.run
    assert again.run["seconds"] >= 0
    assert again.run["peak_memory_mb"] > 1
    assert again.run["versions"]["python"].startswith("3.")
    assert again.run["config"]["steps"] == 1


def test_manifest_has_no_paths_or_times(photos: Path, store: Store) -> None:
    done = run_second(store, photos)
    text = (done.located.folder / "manifest.json").read_text()
    assert str(store.root) not in text
    assert "seconds" not in text


@pytest.mark.parametrize(("fault", "kind"), [("stage", StageError), ("bug", ZeroDivisionError), ("space", StageError)])
def test_a_failed_stage_leaves_nothing_that_looks_finished(
    photos: Path, store: Store, fault: str, kind: type[Exception]
) -> None:
    with pytest.raises(kind):
        run_second(store, photos, SlowConfig(fault=fault))
    assert [e for e in entries(store, "second") if not e.endswith(".scratch")] == []
    assert len(entries(store, "first")) == 1  # what was finished before stays


@pytest.mark.parametrize(("free", "kind"), [(0, DiskError), (1 << 20, ZeroDivisionError)])
def test_a_librarys_error_on_a_full_disk_is_the_disks(
    photos: Path, store: Store, monkeypatch: pytest.MonkeyPatch, free: int, kind: type[Exception]
) -> None:
    monkeypatch.setattr(shutil, "disk_usage", lambda path: (1 << 30, 0, free))
    with pytest.raises(kind) as e:
        run_second(store, photos, SlowConfig(fault="bug"))
    assert not list(store.root.glob("*/*.partial-*"))
    if kind is DiskError:
        assert "no space is left" in str(e.value) and "ZeroDivisionError: a bug" in str(e.value)


def test_a_full_disk_is_told_in_plain_words(photos: Path, store: Store) -> None:
    with pytest.raises(StageError) as e:
        run_second(store, photos, SlowConfig(fault="space"))
    assert "no space is left" in str(e.value)
    assert "--store" in e.value.remedy


def test_a_manifest_that_lies_is_a_bug_not_a_result(photos: Path, store: Store) -> None:
    with pytest.raises(RuntimeError, match="does not match its files"):
        run_second(store, photos, SlowConfig(fault="manifest"))
    assert not any(e for e in entries(store, "second") if "." not in e)


def test_stopping_keeps_checkpoints_and_the_next_run_goes_on(photos: Path, store: Store) -> None:
    seen: list[int] = []

    def progress(done: int, total: int, message: str = "", **figures: float) -> None:
        seen.append(done)

    with pytest.raises(Cancelled):
        run_second(store, photos, SlowConfig(steps=6), progress=progress, cancelled=lambda: len(seen) >= 3)
    assert seen == [0, 1, 2]
    assert [e.partition(".")[2] for e in entries(store, "second")] == ["scratch"]
    seen.clear()
    done = run_second(store, photos, SlowConfig(steps=6), progress=progress)
    assert seen == [3, 4, 5]
    assert entries(store, "second") == [done.key]  # checkpoints go once the result stands


def test_a_stop_before_the_start_leaves_no_empty_scratch(photos: Path, store: Store) -> None:
    with pytest.raises(Cancelled):
        run_second(store, photos, cancelled=lambda: True)
    assert entries(store, "second") == []


# ------------------------------------------------------------------ damage
@pytest.mark.parametrize("damage", ["truncated", "flipped", "missing", "manifest", "no manifest"])
def test_a_damaged_artifact_is_found_and_made_anew(
    photos: Path, store: Store, damage: str, caplog: pytest.LogCaptureFixture
) -> None:
    made = run_second(store, photos)
    file, manifest = made.located.folder / "total.txt", made.located.folder / "manifest.json"
    content = file.read_bytes()
    if damage == "truncated":
        file.write_bytes(content[:-1])
    elif damage == "flipped":
        file.write_bytes(bytes([content[0] ^ 1]) + content[1:])
    elif damage == "missing":
        file.unlink()
    elif damage == "manifest":
        manifest.write_text(manifest.read_text()[:-20])
    else:
        manifest.unlink()
    again = run_second(store, photos)
    assert not again.reused
    assert file.read_bytes() == content
    assert "damaged" in caplog.text


def test_a_relative_store(photos: Path, store: Store, monkeypatch: pytest.MonkeyPatch) -> None:
    """Stages name their files by paths below workdir, which must not be joined to it a second time."""
    monkeypatch.chdir(store.root.parent)

    def run(inputs: FirstInputs, config: Config, context: Any) -> Any:
        (context.workdir / "total.txt").write_text("1")
        return Number(total=1, file=context.file(context.workdir / "total.txt"))

    stage = Stage("first", 1, FirstInputs, Config, Number, run)
    done = execute(stage, FirstInputs(source(photos)), Config(), Store(Path("store")))
    assert done.located.artifact.file.path == "total.txt"
    assert done.located.folder.is_absolute()


def test_forget_makes_it_anew(photos: Path, store: Store) -> None:
    made = run_second(store, photos)
    store.forget("second", made.key)
    assert entries(store, "second") == []
    assert not run_second(store, photos).reused
    store.forget("second", "0" * 64)  # nothing there: nothing to do


# ------------------------------------------------------------------ other processes
def start(photos: Path, store: Store, environment: dict[str, str], *options: str) -> subprocess.Popen[str]:
    script = Path(__file__).parents[1] / "support" / "toy_stages.py"
    return subprocess.Popen(
        [sys.executable, str(script), str(photos), str(store.root), *options],
        text=True,
        env=environment,
        stdout=subprocess.PIPE,
        stderr=subprocess.PIPE,
    )


@pytest.mark.parametrize("step", [1, 2, 5, 10])
@pytest.mark.slow
def test_killed_in_mid_stage_then_resumed(
    photos: Path, store: Store, child_environment: dict[str, str], step: int, tmp_path: Path
) -> None:
    point = hold(f"second.step@{step}", tmp_path / "signs")
    child = start(photos, store, {**child_environment, **point.environment()}, "--steps", "10")
    point.wait(child)
    child.send_signal(signal.SIGKILL)
    child.communicate()
    first = [e for e in entries(store, "first") if "." not in e]
    assert len(first) == 1
    assert [e for e in entries(store, "second") if "." not in e] == []
    assert entries(store, "third") == []
    out, err = start(photos, store, child_environment, "--steps", "10", "--seed", "1").communicate()
    # a different seed is a different config: the killed work is not taken for it
    assert out.split("\n")[:3] == ["first reused", "second made", "third made"], err
    out, err = start(photos, store, child_environment, "--steps", "10").communicate()
    assert out.split("\n")[:3] == ["first reused", "second made", "third reused"], err
    assert not list((store.root / "second").glob("*.partial-*"))


@pytest.mark.slow
def test_two_processes_on_one_key_do_it_once(
    photos: Path, store: Store, child_environment: dict[str, str], tmp_path: Path
) -> None:
    point = hold("second.step@3", tmp_path / "signs")
    environment = {**child_environment, **point.environment()}
    children = [start(photos, store, environment, "--steps", "5") for _ in range(3)]
    point.wait(*children)  # one is at work; the others wait for it, or are not there yet
    point.release()
    outputs = [c.communicate()[0] for c in children]
    assert all(c.returncode == 0 for c in children)
    for stage in ("first", "second", "third"):
        assert sorted(line for out in outputs for line in out.split("\n") if line.startswith(stage)) == [
            f"{stage} made",
            f"{stage} reused",
            f"{stage} reused",
        ]
        assert len(entries(store, stage)) == 1


def test_unwritable_store(photos: Path, tmp_path: Path) -> None:
    (tmp_path / "file").write_text("in the way")
    with pytest.raises(StageError) as e:
        run_second(Store(tmp_path / "file" / "store"), photos)
    assert "file is where a folder is needed" in str(e.value)


def test_located_paths_are_inside_the_folder(photos: Path, store: Store) -> None:
    done = run_second(store, photos)
    located: Located[Any] = done.located
    assert located.path(located.artifact.file) == located.folder / "total.txt"
    assert located.path(located.artifact.file).is_file()


def test_a_second_name_takes_no_room_and_is_a_copy_elsewhere(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    source = tmp_path / "map.exr"
    source.write_bytes(b"content")
    link_or_copy(source, tmp_path / "same.exr")
    assert (tmp_path / "same.exr").stat().st_ino == source.stat().st_ino
    number = errno.EXDEV

    def refuse(*_: Any) -> None:
        raise OSError(number, os.strerror(number))

    monkeypatch.setattr(os, "link", refuse)
    link_or_copy(source, tmp_path / "copy.exr")
    assert (tmp_path / "copy.exr").read_bytes() == b"content"
    assert (tmp_path / "copy.exr").stat().st_ino != source.stat().st_ino
    number = errno.ENOSPC
    with pytest.raises(OSError, match="No space"):
        link_or_copy(source, tmp_path / "none.exr")


def test_files_with_the_same_bytes_share_their_room(store: Store) -> None:
    partial = store.begin("twins", "k")
    for name, text in (("a.txt", "same"), ("b.txt", "same"), ("c.txt", "other")):
        (partial / name).write_text(text)
    refs = tuple(FileRef.of(partial, n) for n in ("a.txt", "b.txt", "c.txt", "a.txt"))
    folder = store.finish("twins", "k", partial, Report(files=refs), {}).folder
    assert {p.name for p in folder.iterdir()} >= {"a.txt", "b.txt", "c.txt"}
    assert (folder / "a.txt").samefile(folder / "b.txt") and not (folder / "a.txt").samefile(folder / "c.txt")
    assert [(folder / n).read_text() for n in ("a.txt", "b.txt", "c.txt")] == ["same", "same", "other"]
    assert not list(folder.glob("*.partial"))
