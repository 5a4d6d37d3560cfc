"""Room on the disk is asked for before a stage, and before results are copied."""

from __future__ import annotations

import errno
import resource
import shutil
from pathlib import Path
from types import SimpleNamespace

import pytest

from pipeline.artifacts import FileRef, Located
from pipeline.capture_artifacts import CaptureSource
from pipeline.contract import StageConfig
from pipeline.errors import DiskError, StageError, stage_error_from_os_error
from stages.bake.stage import Config as BakeConfig
from tests.support.toy_stages import SECOND
from workflows.run.plan import make_plan
from workflows.run.publish import publish
from workflows.run.request import RunRequest
from workflows.run.room import BYTES_A_TEXEL, SPARE, check_room, check_room_for_copies, least
from workflows.run.runner import run_stages


def with_free(monkeypatch: pytest.MonkeyPatch, free: int, total: int = 1 << 40) -> list[Path]:
    asked: list[Path] = []

    def usage(path: Path) -> tuple[int, int, int]:
        asked.append(Path(path))
        return total, total - free, free

    monkeypatch.setattr(shutil, "disk_usage", usage)
    return asked


def test_the_limit_is_exact(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    with_free(monkeypatch, 1000)
    check_room(tmp_path, 1000, "for it", "--store")
    with pytest.raises(DiskError, match="not enough space") as caught:
        check_room(tmp_path, 1001, "for it", "--store")
    assert caught.value.where == tmp_path and "--store" in caught.value.remedy
    with_free(monkeypatch, 0, total=0)  # a file system that knows no sizes
    check_room(tmp_path, 1, "for it", "--store")


def test_a_folder_that_is_not_there_yet_has_the_room_of_its_disk(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    asked = with_free(monkeypatch, 1 << 30)
    check_room(tmp_path / "new/deep", 1, "for it", "--out")
    assert asked == [tmp_path]


def test_what_is_surely_written(tmp_path: Path) -> None:
    (tmp_path / "a.jpg").write_bytes(bytes(12345))
    source = Located(CaptureSource(kind="photos", photos=(FileRef.of(tmp_path, tmp_path / "a.jpg"),)), tmp_path)
    assert least("capture", SimpleNamespace(source=source), StageConfig()) == SPARE + 12345
    assert least("usd", SimpleNamespace(bake=source), StageConfig()) == SPARE + 12345
    assert least("bake", SimpleNamespace(), BakeConfig(size=16384)) == SPARE + BYTES_A_TEXEL * 16384**2
    assert least("report", SimpleNamespace(), StageConfig()) == SPARE


@pytest.mark.usefixtures("toys")
def test_a_full_disk_ends_a_run_before_the_stage(photos: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    plan = make_plan(RunRequest(capture=str(photos), out=str(photos.parent / "out")))
    done = run_stages(plan)
    with monkeypatch.context() as m:
        with_free(m, SPARE - 1)
        assert [d.reused for d in run_stages(plan)] == [True] * 3  # what is stored needs none
        again = make_plan(RunRequest(capture=str(photos), out=str(photos.parent / "out"), sets=("second.plus=1",)))
        with pytest.raises(DiskError, match=f"for the stage {SECOND.name}"):
            run_stages(again)
        assert not list(plan.store.root.glob("*/*.partial-*"))
        plan.out.mkdir(exist_ok=True)
        with pytest.raises(DiskError, match="for the results") as caught:
            publish(plan, done)
    assert str(plan.out) in str(caught.value) and "--out" in caught.value.remedy
    assert not (plan.out / "run.json").exists()


def test_copies_need_their_sizes(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    (tmp_path / "a").write_bytes(bytes(100))
    with_free(monkeypatch, SPARE + 199)
    check_room_for_copies(tmp_path, [tmp_path / "a"])
    with pytest.raises(DiskError):
        check_room_for_copies(tmp_path, [tmp_path / "a"] * 2)


@pytest.mark.parametrize("number", [errno.ESTALE, errno.ENOTCONN, errno.ENODEV, errno.EMFILE, errno.ENFILE])
def test_other_faults_of_disks_have_words(number: int) -> None:
    found = stage_error_from_os_error(OSError(number, "as the system says", "/some/file"), "/fallback")
    assert found is not None and "/some/file" in str(found)


@pytest.mark.parametrize(("limit", "refused"), [(3e9, True), (5.999e9, True), (6e9, False), (-1, False)])
def test_too_small_an_address_space_is_told_before_anything_runs(
    photos: Path, toys: None, tmp_path: Path, monkeypatch: pytest.MonkeyPatch, limit: float, refused: bool
) -> None:
    """With 3 GB a library ended the process by a segmentation fault. -1 is no limit."""
    monkeypatch.setattr(resource, "getrlimit", lambda which: (int(limit), -1))
    request = RunRequest(capture=str(photos), out=str(tmp_path / "out"))
    if refused:
        with pytest.raises(StageError, match="too little memory") as e:
            make_plan(request)
        assert "ulimit -v" in str(e.value) and e.value.exit_code == 1
    else:
        make_plan(request)
