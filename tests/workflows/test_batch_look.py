"""The batch's page in a browser: sorting, the command that compares two captures; and the pictures that turn."""

from __future__ import annotations

import json
from pathlib import Path

import cv2
import numpy as np
import pytest
from support.browser import Tab, installed, tab
from support.synthetic_asset import ball

from pipeline.images import write_png
from workflows.batch import page as page_module
from workflows.batch.page import write_page
from workflows.batch.request import BatchRequest
from workflows.batch.state import Entry, Summary
from workflows.batch.turn_picture import FILE, FRAMES, SIDE, write_turn

PSNR = {"a": 30.0, "b": None, "c": 9.0, "d": 1234.5, "e 'x'": 31.0}
LEVELS = {"a": "good", "b": "", "c": "unusable", "d": "usable", "e 'x'": "good"}


def made_run(out: Path) -> None:
    """A ball whose front half (+Z) is red and whose back is blue, as the store and run.json have it."""
    store = out.parent / "store"
    for stage in ("uv", "bake"):
        (store / stage / "k").mkdir(parents=True)
    np.savez(store / "uv/k/mesh.npz", **ball())
    u = (np.arange(64) + 0.5) / 64
    albedo = np.where((np.abs(u - 0.5) < 0.25)[None, :, None], [0.9, 0.1, 0.1], [0.1, 0.1, 0.9]) * np.ones((64, 1, 1))
    write_png(store / "bake/k/albedo.png", albedo)
    (store / "uv/k/manifest.json").write_text(json.dumps({"mesh": {"path": "mesh.npz"}}))
    maps = {"albedo": {"files": {"png": {"path": "albedo.png"}}}}
    (store / "bake/k/manifest.json").write_text(json.dumps({"tiles": 1, "maps": maps}))
    (out / "report").mkdir(parents=True)
    record = {"store": str(store), "stages": {s: {"key": "k"} for s in ("uv", "bake", "usd")}}
    (out / "run.json").write_text(json.dumps(record))


def test_the_picture_shows_the_front_first_and_the_back_half_a_turn_later(tmp_path: Path) -> None:
    made_run(tmp_path / "run")
    assert write_turn(tmp_path / "run")
    found = cv2.imreadanimation(str(tmp_path / "run" / FILE))[1]
    assert len(found.frames) == FRAMES and found.frames[0].shape[:2] == (SIDE, SIDE)
    assert abs(sum(found.durations) - 4000) < FRAMES
    middle = [np.asarray(f[SIDE // 2, SIDE // 2, :3], int) for f in found.frames]  # BGR
    assert middle[0][2] > middle[0][0] + 60 and middle[FRAMES // 2][0] > middle[FRAMES // 2][2] + 60
    listed = json.loads((tmp_path / "run/.published.json").read_text())["files"]
    assert FILE in listed  # the next run, or a purge, removes it


def test_a_result_without_a_mesh_has_no_picture(tmp_path: Path) -> None:
    made_run(tmp_path / "run")
    (tmp_path / "store/bake/k/albedo.png").write_bytes(b"damaged")
    assert not write_turn(tmp_path / "run")
    (tmp_path / "store/uv/k/manifest.json").unlink()
    assert not write_turn(tmp_path / "run")
    (tmp_path / "run/run.json").write_text('{"stages": {"usd": 3, "uv": 1}}')
    assert not write_turn(tmp_path / "run")
    assert not write_turn(tmp_path / "nowhere") and not (tmp_path / "run" / FILE).exists()


def batch(folder: Path) -> Path:
    """A batch of five captures with these figures; its page."""
    out = folder / "out"
    for name, psnr in PSNR.items():
        (out / name / "report").mkdir(parents=True)
        (out / name / "report/index.html").write_text("report")
        (out / name / "report/metrics.json").write_text(json.dumps({"holdout": {"psnr": psnr}}))
        (out / name / "run.json").write_text(json.dumps({"verdict": {"level": LEVELS[name]}}))
    entries = [Entry(name=n, capture="/c", state="done") for n in PSNR]
    write_page(BatchRequest(root=str(folder), out=str(out)), Summary(entries))
    return out / "batch/index.html"


def test_pictures_are_made_once_and_for_a_few_seconds_only(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    asked: list[str] = []
    monkeypatch.setattr(page_module, "write_turn", lambda folder: asked.append(folder.name))
    for name in ("a", "c"):
        (tmp_path / "out" / name / "asset").mkdir(parents=True)
    (tmp_path / "out/a" / FILE).parent.mkdir(parents=True)
    (tmp_path / "out/a" / FILE).write_bytes(b"x")
    folders = [tmp_path / "out" / n for n in ("a", "c")]
    (tmp_path / "out/c/report").mkdir()
    page_module._turn_pictures(folders)
    assert asked == ["c"]
    monkeypatch.setattr(page_module, "TURN_SECONDS", -1.0)
    page_module._turn_pictures(folders)
    assert asked == ["c"]


def names(page: Tab) -> list[str]:
    found = page.run("[...document.querySelectorAll('#captures tbody tr')].map(r => r.dataset.name)")
    return list(found)


def click(page: Tab, title: str) -> None:
    page.run(f"[...document.querySelectorAll('th button')].find(b => b.textContent === '{title}').click()")


@pytest.mark.slow
def test_sorting_and_comparing_in_a_browser(tmp_path: Path) -> None:
    if installed() is None:
        pytest.skip("no Chromium is installed")
    path = batch(tmp_path)
    with tab(tmp_path / "profile") as found:
        found.call("Page.navigate", url=path.as_uri())
        found.until("document.querySelectorAll('th button').length > 0")
        written = names(found)
        click(found, "psnr")
        assert names(found) == ["d", "e 'x'", "a", "c", "b"]  # the largest first, the empty one last
        click(found, "psnr")
        assert names(found) == ["c", "a", "e 'x'", "d", "b"]
        click(found, "psnr")
        assert names(found) == written
        click(found, "verdict")
        assert [LEVELS[n] for n in names(found)] == ["unusable", "usable", "good", "good", ""]
        click(found, "capture")
        assert names(found) == sorted(PSNR)
        assert found.run("document.querySelectorAll('th[aria-sort]').length") == 1
        ticks = "document.querySelectorAll('#captures input')"
        for i in (0, 4):
            found.run(f"{ticks}[{i}].click()")
        out = tmp_path / "out"
        assert found.run("document.getElementById('compare').textContent") == (
            f"neuface compare '{out}/a' '{out}/e '\\''x'\\'''"
        )
        found.run(f"{ticks}[2].click()")  # a third one replaces the first
        assert "/c'" in found.run("document.getElementById('compare').textContent")
        assert found.run(f"{ticks}[0].checked") is False
        assert found.troubles == [] and all(r.startswith(("file:", "data:")) for r in found.requests)
