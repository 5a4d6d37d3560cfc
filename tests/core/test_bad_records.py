"""Damage in the store and in settings files, full disks, missing rights: named, with what to do."""

from __future__ import annotations

import errno
import json
import os
import shutil
from pathlib import Path

import pytest

from pipeline.artifacts import FileRef
from pipeline.capture_artifacts import CaptureSource
from pipeline.errors import DiskError, StageError, UsageError, stage_error_from_os_error
from pipeline.store import LINEAGE, MANIFEST, RUN, Store, lineage
from stages.presets import configs_for, parse_sets, read_config_file
from workflows.cli.main import main

KEY = "0" * 64


# ------------------------------------------------------------------ the system's errors
def test_a_full_disk_is_named_by_the_copy_s_target() -> None:
    error = OSError(errno.ENOSPC, "No space left on device", "/store/a.png", None, "/out/a.png")
    found = stage_error_from_os_error(error, "/out")
    assert isinstance(found, DiskError) and found.where == "/out/a.png"


def test_a_photo_that_may_not_be_read(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    photo = tmp_path / "a.jpg"
    photo.write_bytes(b"x")
    error = PermissionError(errno.EACCES, "Permission denied", str(photo))
    assert "may write to" in str(stage_error_from_os_error(error, ""))
    monkeypatch.setattr(os, "access", lambda path, mode: Path(path) != photo)
    found = stage_error_from_os_error(error, "")
    assert found is not None and found.where == photo and "chmod u+r" in found.remedy
    assert not isinstance(found, DiskError)  # another capture may well be readable


def test_a_name_too_long(tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    assert main(["run", str(tmp_path / ("a" * 300)), "--out", str(tmp_path / "o")]) == 1
    said = capsys.readouterr().err
    assert "too long for the file system" in said and "300 bytes" in said and "Traceback" not in said


def test_messages_have_an_end() -> None:
    str(StageError("w", where="\ud800", value="\udcff", limit="l", remedy="r")).encode()
    assert len(str(StageError("w", where="x" * 10**6, value="y" * 10**6, limit="l", remedy="r"))) < 3000


# ------------------------------------------------------------------ words that are not UTF-8
@pytest.mark.parametrize("arguments", [["cap", "--out", "o\udcff"], ["c\udcff", "--out", "o"],
                                       ["cap", "--out", "o", "--name", "n\udcff"],
                                       ["cap", "--out", "o", "--set", "usd.author=\udcff"]])  # fmt: skip
def test_words_that_are_not_utf8(arguments: list[str], capsys: pytest.CaptureFixture[str]) -> None:
    assert main(["run", *arguments]) == 2
    assert "a name is not UTF-8" in capsys.readouterr().err


# ------------------------------------------------------------------ settings
@pytest.mark.parametrize(("name", "text", "says"), [
    ("a.toml", "size = 3\n", "outside of any table"), ("a.json", '{"bake": 3}', "outside of any table"),
    ("a.json", "[" * 100_000, "too deep"), ("a.toml", "#" * 2_000_000, "more than 1000 kB"), ("a.json", "[1]", "list"),
])  # fmt: skip
def test_settings_that_are_none(tmp_path: Path, name: str, text: str, says: str) -> None:
    (tmp_path / name).write_text(text)
    with pytest.raises(UsageError, match="can't be read") as caught:
        read_config_file(tmp_path / name)
    assert says in str(caught.value.value)


@pytest.mark.parametrize("value", ["inf", "nan", "-inf", "[" * 100_000])
def test_a_setting_is_a_finite_number(value: str) -> None:
    with pytest.raises(UsageError, match="outside its limits"):
        configs_for("draft", parse_sets([f"poses.given_deviation={value}"]))


# ------------------------------------------------------------------ the store
@pytest.fixture
def store(tmp_path: Path) -> Store:
    made = Store(tmp_path / "store")
    partial = made.begin("capture", KEY)
    (partial / "a.jpg").write_bytes(b"photo")
    source = CaptureSource(kind="photos", photos=(FileRef.of(partial, "a.jpg"),))
    made.finish("capture", KEY, partial, source, {"seconds": 1.5})
    return made


@pytest.mark.parametrize("text", ["", "[1]", '{"seconds": "long"}', '{"seconds": NaN}', "[" * 100_000, "\xff"])
def test_damaged_times_are_not_known(store: Store, text: str) -> None:
    assert store.load_run("capture", KEY) == {"seconds": 1.5}
    (store.folder("capture", KEY) / RUN).write_text(text, encoding="latin-1")
    assert store.load_run("capture", KEY) == {}


@pytest.mark.parametrize("path", ["b" * 300, "a.jpg/" * 50 + "a"])
def test_a_manifest_that_names_what_no_file_can_be(store: Store, path: str) -> None:
    manifest = store.folder("capture", KEY) / MANIFEST
    manifest.write_text(manifest.read_text().replace('"a.jpg"', f'"{path}"'))
    assert store.load("capture", KEY, CaptureSource) is None


@pytest.mark.parametrize("text", ["[]", "{", '{"source": 3}', '{"source": [3]}', "[" * 100_000])
def test_damaged_lineage_is_none(store: Store, text: str) -> None:
    path = store.root / LINEAGE / "x.json"
    path.parent.mkdir(parents=True, exist_ok=True)
    path.write_text(text)
    assert lineage(path) == {}
    shutil.rmtree(store.root)


@pytest.mark.parametrize(
    ("entries", "says"),
    [([7], "photos.0: Input should be"), ([7, 8, 9], "and 2 more"), ([7] * 5000, "5000 faults"),
     ([{"path": "a.jpg", "sha256": "0" * 64, "size": "9" * 4000}], "a.jpg has 5 bytes")],
)  # fmt: skip
def test_a_damaged_manifest_is_told_in_a_line(
    store: Store, caplog: pytest.LogCaptureFixture, entries: list[object], says: str
) -> None:
    """A warning for each of 5,000 wrong entries would be a megabyte in the log."""
    path = store.folder("capture", KEY) / MANIFEST
    content = json.loads(path.read_text())
    path.write_text(json.dumps({**content, "photos": entries}))
    with caplog.at_level("WARNING"):
        assert store.load("capture", KEY, CaptureSource) is None
    (message,) = [r.getMessage() for r in caplog.records if "is damaged" in r.getMessage()]
    assert says in message and len(message) < 1300 and "\n" not in message
    assert not path.parent.exists()
