"""The locks, what differs from them, the bill of materials, and the page of licences."""

from __future__ import annotations

import hashlib
import json
import re
import subprocess
import sys
from pathlib import Path

import pytest

from pipeline.errors import UsageError
from workflows.cli import doctor
from workflows.supply import sbom
from workflows.supply.lock import LOCKS, Pinned, differences, installed, locked, read_lock

A, B = "a" * 64, "b" * 64


def test_a_lock_is_read_with_its_hashes(tmp_path: Path) -> None:
    lock = tmp_path / "x.lock"
    lock.write_text(
        f"# made by hand\n\nZope.Interface==5.0 \\\n    --hash=sha256:{A} \\\n    --hash=sha256:{B}\n    # via y\n"
        f"b_c==1.0+cpu --hash=sha256:{A}  # via z\nplain==2\n"
    )
    assert read_lock(lock) == [
        Pinned("zope-interface", "5.0", (A, B)),
        Pinned("b-c", "1.0+cpu", (A,)),
        Pinned("plain", "2", ()),
    ]


@pytest.mark.parametrize("line", ["numpy>=1", "-e .", "numpy==1 --hash=md5:00", "numpy==1 ; python_version < '4'"])
def test_a_line_that_is_no_pin_is_told(line: str, tmp_path: Path) -> None:
    (tmp_path / "x.lock").write_text(line + "\n")
    with pytest.raises(UsageError, match="make lock"):
        read_lock(tmp_path / "x.lock")
    with pytest.raises(UsageError, match="can't be read"):
        read_lock(tmp_path / "none.lock")


def test_what_differs_is_named_and_a_builds_label_is_no_difference() -> None:
    pins = [Pinned("a", "1", ()), Pinned("b", "2", ()), Pinned("torch", "3", ()), Pinned("d", "4", ())]
    here = {"a": "1", "b": "2.1", "torch": "3+cpu", "more": "9"}
    assert differences(pins, here) == ["b 2.1 in place of 2", "d 4 is missing"]


def test_every_pin_of_the_locks_has_a_hash_and_stands_once(repo: Path) -> None:
    pins = locked(repo)
    assert len(pins) > 100 and len({p.name for p in pins}) == len(pins)
    assert [p.name for p in pins if not p.hashes] == []
    assert [p.name for p in read_lock(repo / LOCKS[1])] == ["torch"]
    dev = {p.name: p for p in read_lock(repo / "requirements-dev.lock")}
    assert [p.name for p in dev.values() if not p.hashes] == []
    shared = [p for p in pins if p.name in dev]
    assert len(shared) == len(pins) - 1 and all(dev[p.name] == p for p in shared)


def test_doctor_tells_what_differs(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    assert doctor._lock(tmp_path).found.startswith("not beside the program")
    for name in LOCKS:
        (tmp_path / name).write_text("numpy==1.0\n" if name == LOCKS[0] else "no-such-thing==2\n")
    found = doctor._lock(tmp_path)
    assert found.level == "note" and "2 of 2 packages differ" in found.found and "make setup" in found.remedy
    assert (
        f"numpy {installed()['numpy']} in place of 1.0" in found.found and "no-such-thing 2 is missing" in found.found
    )
    (tmp_path / LOCKS[0]).write_text(f"numpy=={installed()['numpy']}\n")
    (tmp_path / LOCKS[1]).write_text("# nothing\n")
    assert doctor._lock(tmp_path).level == "ok"


def test_the_bill_is_complete_and_always_the_same(repo: Path, tmp_path: Path) -> None:
    """By the rules of CycloneDX 1.5: required fields, unique references, hashes of the right length."""
    pins = locked(repo)
    made = sbom.bill(pins)
    assert (made["bomFormat"], made["specVersion"], made["version"]) == ("CycloneDX", "1.5", 1)
    assert re.fullmatch(r"urn:uuid:[0-9a-f]{8}(-[0-9a-f]{4}){3}-[0-9a-f]{12}", made["serialNumber"])
    references = [c["bom-ref"] for c in made["components"]]
    assert len(set(references)) == len(references)
    for c in made["components"]:
        assert {"type", "name", "version", "purl", "licenses", "hashes"} <= c.keys()
        assert c["hashes"] and all(re.fullmatch("[0-9a-f]{64}", h["content"]) for h in c["hashes"])
    libraries = {c["name"]: c["version"] for c in made["components"] if c["type"] == "library"}
    assert libraries == {p.name: p.version for p in pins}
    done = subprocess.run(
        [sys.executable, "-m", "workflows.supply.sbom", "--out", tmp_path / "deep/bill.json"], cwd=repo
    )
    assert done.returncode == 0 and json.loads((tmp_path / "deep/bill.json").read_text()) == made


def test_every_foreign_file_is_listed_with_the_hash_that_its_notice_has(repo: Path) -> None:
    shipped = [*repo.glob("pipeline/faces/models/*.tflite"), *repo.glob("stages/masks/models/*.tflite"),
               *repo.glob("stages/report/three/*.js"), *repo.glob("pipeline/template/hm08/*.npz")]  # fmt: skip
    listed = {f for b in sbom.BUNDLED for f in b.files}
    assert {p.relative_to(repo).as_posix() for p in shipped} <= listed
    for path in shipped:
        notice = path.parent / "NOTICE"
        if notice.is_file():
            assert hashlib.sha256(path.read_bytes()).hexdigest() in notice.read_text(), path.name


def test_the_page_of_licences_has_every_package_with_its_licence(repo: Path) -> None:
    """Licences are those of the installed packages; versions and names must be the locks'."""
    rows = [line.strip("| ").split(" | ") for line in sbom.PAGE.read_text().splitlines() if line.startswith("| ")]
    told = {name: (version, licence) for name, version, licence, *_ in rows}
    assert [p.name for p in locked(repo) if told.get(p.name, ("", ""))[0] != p.version] == []
    assert [name for name, (_, licence) in told.items() if licence in ("", sbom.UNKNOWN)] == []
    assert "GPL" in told["pymeshlab"][1] and told["three.js"] == ("0.187.0", "MIT")
