"""The zip of an asset: what it holds, its bytes, and what happens to a file of the user's in its place."""

from __future__ import annotations

import errno
import json
import shutil
import zipfile
from pathlib import Path
from typing import Any

import pytest
from support.synthetic_asset import run_stage, write_inputs

from pipeline.artifacts import FileRef, Located
from pipeline.asset_artifacts import UsdAsset
from pipeline.contract import Done
from pipeline.errors import StageError
from pipeline.store import Store
from stages.usd.check.validate import validate
from workflows.batch.request import BatchRequest
from workflows.cli.main import main
from workflows.cli.summary import paths
from workflows.run import pack
from workflows.run.plan import Plan, make_plan
from workflows.run.publish import publish
from workflows.run.published import LIST
from workflows.run.request import RunRequest
from workflows.run.runner import run_stages
from workflows.store.gc import belongings, purge

pytestmark = pytest.mark.usefixtures("toys")
FILES = ("head.usd", "open_in_blender.py", "textures/head_albedo.png", "textures/head_albedo.1001.exr",
         "internal/head_basis_rgb0.exr", "internal/head_inv_kappa.1001.exr", "internal/head_confidence.exr",
         "internal/head_region.1002.png", "internal/light.json")  # fmt: skip
KEPT = ["head/head.usd", "head/internal/head_basis_rgb0.exr", "head/internal/head_inv_kappa.1001.exr",
        "head/open_in_blender.py", "head/textures/head_albedo.1001.exr", "head/textures/head_albedo.png"]  # fmt: skip


@pytest.fixture
def plan(photos: Path) -> Plan:
    made = make_plan(RunRequest(capture=str(photos), out=str(photos.parent / "out"), pack="zip"))
    made.out.mkdir()
    return made


def usd(folder: Path, text: str = "#usda 1.0") -> Done[Any]:
    for name in FILES:
        path = folder / "asset" / name
        path.parent.mkdir(parents=True, exist_ok=True)
        path.write_text(f"{name} {text}")
    refs = tuple(FileRef.of(folder, f"asset/{name}") for name in FILES)
    asset = UsdAsset(name="head", root="asset/head.usd", files=refs, checks=1)
    return Done("usd", "k" * 64, Located(asset, folder), False, {"seconds": 2.0})


def test_it_holds_what_other_programs_open(plan: Plan, tmp_path: Path) -> None:
    record = publish(plan, [usd(tmp_path / "art")])
    with zipfile.ZipFile(plan.out / "head.zip") as z:
        assert z.testzip() is None and z.namelist() == KEPT  # sorted, and of internal/ what the asset reads
        assert {i.date_time for i in z.infolist()} == {(1980, 1, 1, 0, 0, 0)}
        assert z.read("head/head.usd") == b"head.usd #usda 1.0"
    assert record["pack"] == "head.zip" and paths(record, plan.out)["zip"] == plan.out / "head.zip"
    assert json.loads((plan.out / "run.json").read_text())["pack"] == "head.zip"


def test_the_same_files_give_the_same_bytes(plan: Plan, tmp_path: Path) -> None:
    publish(plan, [usd(tmp_path / "art")])
    first = (plan.out / "head.zip").read_bytes()
    (plan.out / "head.zip").unlink()
    shutil.copytree(tmp_path / "art", tmp_path / "copy", copy_function=shutil.copyfile)  # later dates
    publish(plan, [usd(tmp_path / "copy")])
    assert (plan.out / "head.zip").read_bytes() == first


def test_a_zip_of_the_users_is_kept_and_told(plan: Plan, tmp_path: Path) -> None:
    notes: list[str] = []
    (plan.out / "head.zip").write_text("mine")
    record = publish(plan, [usd(tmp_path / "art")], notes.append)
    assert (plan.out / "head.zip.yours-1").read_text() == "mine" and zipfile.is_zipfile(plan.out / "head.zip")
    assert record["moved_aside"] == {"head.zip": "head.zip.yours-1"} and any("head.zip.yours-1" in n for n in notes)
    publish(plan, [usd(tmp_path / "art", "other")], notes.append)  # ours is replaced
    assert not (plan.out / "head.zip.yours-2").exists()
    with zipfile.ZipFile(plan.out / "head.zip") as z:
        assert z.read("head/head.usd") == b"head.usd other"


def test_nothing_half_written_is_left(plan: Plan, tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    publish(plan, [usd(tmp_path / "art")])
    before = (plan.out / "head.zip").read_bytes()

    def full(source: Any, target: Any, length: int) -> None:
        target.write(b"half")
        raise OSError(errno.ENOSPC, "No space left on device", str(plan.out))

    with monkeypatch.context() as m:
        m.setattr(pack.shutil, "copyfileobj", full)
        with pytest.raises(StageError, match="no space is left"):
            publish(plan, [usd(tmp_path / "art", "new")])
    hidden = {".store", LIST}
    assert (plan.out / "head.zip").read_bytes() == before
    assert {p.name for p in plan.out.iterdir() if p.name.startswith(".")} == hidden
    (plan.out / ".head.partial-0123abcd.zip").write_text("of a killed process")
    (plan.out / ".head.partial-mine.zip").write_text("of the user's own")
    publish(plan, [usd(tmp_path / "art", "new")])
    assert {p.name for p in plan.out.iterdir() if p.name.startswith(".")} == hidden | {".head.partial-mine.zip"}


def test_without_the_option_or_an_asset_there_is_none(plan: Plan, photos: Path) -> None:
    assert main(["run", str(photos), "--out", str(photos.parent / "a")]) == 0
    notes: list[str] = []
    record = publish(plan, run_stages(plan), notes.append)  # the toy stages make no asset
    assert notes == ["no zip: this run ended before the asset"] and "pack" not in record
    assert not [*photos.parent.glob("*/*.zip")]
    with pytest.raises(SystemExit):
        main(["run", str(photos), "--out", str(photos.parent / "c"), "--pack", "rar"])


def test_room_is_asked_for(plan: Plan, monkeypatch: pytest.MonkeyPatch) -> None:
    asked: list[int] = []
    monkeypatch.setattr("workflows.run.publish.check_room_for_copies", lambda out, files: asked.append(len([*files])))
    publish(plan, [usd(plan.store.root / "usd/art")])
    assert asked == [len(KEPT)]  # the asset's own files are hard links into OUT/.store


def test_each_run_of_a_batch_has_one() -> None:
    request = BatchRequest(root="tree", out="out", pack="zip")
    assert request.run_request(Path("a"), "1", (), {}).pack == "zip"


def test_purge_removes_it(plan: Plan, tmp_path: Path) -> None:
    publish(plan, [usd(tmp_path / "art")])
    store = Store(plan.request.store_path)
    (plan.out / ".head.partial-0123abcd.zip").write_text("of a killed process")
    (plan.out / "mine.zip").write_text("mine")
    purge(belongings(Path(plan.request.capture).name, plan.out, store), store)
    assert [p.name for p in plan.out.iterdir() if p.name != ".store"] == ["mine.zip"]


@pytest.mark.slow
def test_what_is_unpacked_is_a_whole_asset(tmp_path: Path) -> None:
    """No file that a layer of the asset opens is missing from the zip."""
    run_stage(write_inputs(tmp_path / "inputs"), tmp_path / "work", render_views=False)
    asset = tmp_path / "work/asset"
    files = {p.relative_to(asset).as_posix(): p for p in asset.rglob("*") if p.is_file()}
    assert pack.write_pack(tmp_path, "head", files) is None
    with zipfile.ZipFile(tmp_path / "head.zip") as z:
        z.extractall(tmp_path / "there")
    assert len(pack.packed(files)) < len(files)
    for root in ("head.usd", "lookdev.usda", "head.usdz"):
        assert not [f for f in validate(tmp_path / "there/head" / root) if f.level == "error"]
