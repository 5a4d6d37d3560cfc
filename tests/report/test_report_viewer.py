"""The 3D view: what the page carries, and how it behaves in a browser (left out where none is installed)."""

from __future__ import annotations

import base64
import gzip
import hashlib
import json
import re
import struct
from dataclasses import replace
from html import unescape
from pathlib import Path

import cv2
import numpy as np
import pytest
from support.browser import Tab, installed, tab
from support.synthetic_results import SyntheticResults, write_results

from pipeline.artifacts import Located
from pipeline.contract import Context
from pipeline.verdict import Limits, judged
from stages.report.stage import STAGE, Config, Inputs
from tests.support.viewer_results import with_glb

SHOWN = [
    "look",
    "albedo",
    "f0",
    "roughness",
    "normal",
    "ambient_occlusion",
    "confidence",
    "coverage",
    "region",
    "checker",
    "density",
    "wireframe",
]

CORES, LOADS = 2, 5.0  # seconds in which the view of a run's page is there
SMALLER = 3.0  # seconds of processor time that this page takes less than that of a draft of 40 photos


@pytest.fixture(scope="module")
def results(tmp_path_factory: pytest.TempPathFactory) -> SyntheticResults:
    return with_glb(write_results(tmp_path_factory.mktemp("results")))


def page_of(results: SyntheticResults, folder: Path, **settings: bool) -> Path:
    named = {n: getattr(results, n) for n in Inputs.__slots__}
    folder.mkdir(parents=True)
    STAGE.run(Inputs(**named), Config(**settings), Context(folder, folder / "scratch"))
    return folder / "index.html"


@pytest.fixture(scope="module")
def page(results: SyntheticResults, tmp_path_factory: pytest.TempPathFactory) -> Path:
    return page_of(results, tmp_path_factory.mktemp("page") / "report")


def island(text: str, name: str) -> str:
    found = re.search(rf'id="viewer-{name}">(.*?)</script>', text, re.S)
    assert found is not None
    return found[1]


def chunks(glb: bytes) -> tuple[dict, list[bytes]]:
    """The document of a glb, and the content of its buffer views."""
    size = struct.unpack_from("<I", glb, 12)[0]
    document, binary = json.loads(glb[20 : 20 + size]), glb[28 + size :]
    assert struct.unpack_from("<I", glb, 8)[0] == len(glb) and len(binary) == document["buffers"][0]["byteLength"]
    views = document["bufferViews"]
    assert all(v["byteOffset"] % 4 == 0 for v in views)
    return document, [binary[v["byteOffset"] : v["byteOffset"] + v["byteLength"]] for v in views]


def assert_same_asset(held: bytes, written: bytes) -> None:
    """Same meshes and materials, and the same pixels, in less room."""
    (a, ours), (b, theirs) = chunks(held), chunks(written)
    pictures = {i["bufferView"] for i in b["images"]}
    assert pictures and {i["mimeType"] for i in a["images"]} == {"image/webp"}
    for number, (one, two) in enumerate(zip(ours, theirs, strict=True)):
        if number in pictures:
            one, two = (cv2.imdecode(np.frombuffer(x, np.uint8), cv2.IMREAD_COLOR).tobytes() for x in (one, two))
        assert one == two
    assert a["meshes"] == b["meshes"] and a["materials"] == b["materials"] and a["accessors"] == b["accessors"]


def test_the_page_holds_the_asset_and_only_its_own_script_may_run(page: Path, results: SyntheticResults) -> None:
    text = page.read_text()
    held = gzip.decompress(base64.b64decode(island(text, "glb")))
    assert_same_asset(held, (results.usd.folder / "asset/head.glb").read_bytes())
    scripts = re.findall(r"<script>(.*?)</script>", text, re.S)
    assert len(scripts) == 1
    allowed = base64.b64encode(hashlib.sha256(scripts[0].encode()).digest()).decode()
    assert f"script-src 'sha256-{allowed}' blob:" in unescape(text) and "default-src 'none'" in text
    data = json.loads(island(text, "data"))
    assert [c["name"] for c in data["channels"]] == SHOWN
    assert data["landmarks"] == [[0.0, 0.1, 0.09], [0.03, 0.0, 0.1]]
    assert [x["name"] for x in data["lights"]] == ["captured", "key", "overcast", "sunset"]
    assert {c["name"] for c in data["cameras"] if c["photo"]} >= {c["name"] for c in data["cameras"]
                                                                   if c["kind"] == "held out"}  # fmt: skip


def test_without_the_setting_or_a_glb_nothing_runs(results: SyntheticResults, tmp_path: Path) -> None:
    plain = write_results(tmp_path / "in")
    for made in (page_of(results, tmp_path / "off", viewer=False), page_of(plain, tmp_path / "none")):
        text = made.read_text()
        assert "<script>" not in text and "script-src" not in text


# ------------------------------------------------------------------ in a browser
@pytest.fixture(scope="module")
def opened(page: Path, tmp_path_factory: pytest.TempPathFactory):
    if installed() is None:
        pytest.skip("no Chromium is installed")
    with tab(tmp_path_factory.mktemp("profile")) as found:
        found.size(1280, 720)
        found.call("Page.navigate", url=page.as_uri())
        found.until("document.documentElement && document.documentElement.dataset.viewer")
        found.run("document.getElementById('viewer').scrollIntoView()")
        yield found
        assert found.troubles == []
        assert [r for r in found.requests if not r.startswith(("file:", "data:", "blob:"))] == []


def choose(page: Tab, control: str, value: object, event: str = "change") -> None:
    page.run(f"(() => {{ const e = document.getElementById('viewer-{control}'); e.value = '{value}';"
             f" e.dispatchEvent(new Event('{event}')); }})()")  # fmt: skip


def drawn(page: Tab) -> np.ndarray:
    """The canvas with what lies over it, (H, W, 3)."""
    page.run("new Promise(r => setTimeout(() => requestAnimationFrame(() => requestAnimationFrame(r)), 100))")
    box = page.run("(({x, y, width, height}) => ({x, y: y + scrollY, width, height}))"
                   "(document.getElementById('viewer-canvas').getBoundingClientRect())")  # fmt: skip
    return cv2.imdecode(np.frombuffer(page.picture(**box), np.uint8), cv2.IMREAD_COLOR).astype(float)


def changed(a: np.ndarray, b: np.ndarray) -> float:
    """Share of pixels that differ visibly."""
    return float((np.abs(a - b).max(-1) > 8).mean())


@pytest.mark.slow
def test_it_starts_and_turns(opened: Tab) -> None:
    assert opened.run("document.documentElement.dataset.viewer") == "ready"
    first = drawn(opened)
    assert changed(first, np.broadcast_to(first[2, 2], first.shape)) > 0.05  # a head on an even background
    opened.drag((500, 300), (700, 320))
    by_mouse = drawn(opened)
    assert changed(first, by_mouse) > 0.02
    opened.run("document.getElementById('viewer-canvas').dispatchEvent(new KeyboardEvent('keydown', {key: 'ArrowUp'}))")
    assert changed(by_mouse, drawn(opened)) > 0.005
    opened.run("document.getElementById('viewer-home').click()")
    assert changed(first, drawn(opened)) < 0.001


@pytest.mark.slow
def test_it_loads_in_five_seconds_on_two_cores(page: Path, tmp_path: Path) -> None:
    """By processor time, so that other work on the machine does not count; no GPU. The filter of the light is most."""
    if installed() is None:
        pytest.skip("no Chromium is installed")
    with tab(tmp_path / "profile") as fresh:
        fresh.size(1280, 720)
        before = fresh.processor_seconds()
        fresh.call("Page.navigate", url=page.as_uri())
        fresh.until("document.documentElement && document.documentElement.dataset.viewer === 'ready'")
        fresh.until("Number(document.getElementById('viewer-canvas').dataset.frames) > 0")
        fresh.run("new Promise(r => requestAnimationFrame(() => requestAnimationFrame(r)))")
        taken = fresh.processor_seconds() - before
        assert 0.5 < taken < CORES * LOADS - SMALLER, taken


@pytest.mark.slow
def test_every_channel_and_light_shows_something_else(opened: Tab) -> None:
    names = opened.run("[...document.getElementById('viewer-channel').options].map(o => o.value)")
    assert names == SHOWN
    pictures = []
    for name in [*names[1:], "look"]:
        choose(opened, "channel", name)
        opened.until(f"document.getElementById('viewer-channel').dataset.shown === '{name}'")
        pictures.append(drawn(opened))
    for light in ("key", "overcast", "sunset"):
        choose(opened, "light", light, "input")
        pictures.append(drawn(opened))
    choose(opened, "turn", 90, "input")
    pictures.append(drawn(opened))
    choose(opened, "exposure", 2, "input")
    pictures.append(drawn(opened))
    for i, a in enumerate(pictures):
        assert all(changed(a, b) > 0.01 for b in pictures[:i]), i
    for control, value in (("light", "captured"), ("turn", 0), ("exposure", 0)):
        choose(opened, control, value, "input")


@pytest.mark.slow
def test_the_slider_shows_photo_or_render(opened: Tab, results: SyntheticResults) -> None:
    number = opened.run(
        "[...document.getElementById('viewer-camera').options].findIndex(o => o.text.includes('held out'))"
    )
    choose(opened, "camera", number - 1)
    opened.run("document.getElementById('viewer-photo').decode()")
    shown = {}
    for share in (0, 50, 100):
        choose(opened, "split", share, "input")
        shown[share] = drawn(opened)
    middle = shown[0].shape[1] // 2
    assert changed(shown[0][:, : middle - 3], shown[50][:, : middle - 3]) > 0.1
    assert changed(shown[0][:, middle + 3 :], shown[50][:, middle + 3 :]) < 0.02
    assert changed(shown[50][:, middle + 3 :], shown[100][:, middle + 3 :]) > 0.1
    choose(opened, "camera", "")


@pytest.mark.slow
def test_expressions_move_the_surface(opened: Tab) -> None:
    before = drawn(opened)
    opened.run("(() => { const e = document.querySelector('#viewer-expressions input'); e.value = 1;"
               " e.dispatchEvent(new Event('input')); })()")  # fmt: skip
    assert opened.run("document.querySelector('#viewer-expressions label').textContent") == "jawOpen"
    assert changed(before, drawn(opened)) > 0.05
    opened.run("(() => { const e = document.querySelector('#viewer-expressions input'); e.value = 0;"
               " e.dispatchEvent(new Event('input')); })()")  # fmt: skip
    assert changed(before, drawn(opened)) < 0.001


@pytest.mark.slow
def test_every_mesh_is_unpacked_and_shown_in_every_channel(opened: Tab) -> None:
    """The proxy equals the glb's mesh; the scan is smaller, the dense one larger, the displaced one is moved."""
    choose(opened, "camera", "")
    asset = drawn(opened)
    names = opened.run("[...document.getElementById('viewer-mesh').options].map(o => o.value)")
    assert names == ["asset", "proxy", "scan", "displaced", "high"]
    size = {"asset": seen(asset)}
    for name in names[1:]:
        choose(opened, "mesh", name)
        opened.until(f"document.getElementById('viewer-mesh').dataset.shown === '{name}'")
        pictures = [drawn(opened)]
        size[name] = seen(pictures[0])
        for channel in [*SHOWN[1:], "look"]:
            choose(opened, "channel", channel)
            opened.until(f"document.getElementById('viewer-channel').dataset.shown === '{channel}'")
            pictures.append(drawn(opened))
            assert channel == "look" or changed(pictures[0], pictures[-1]) > 0.01, (name, channel)
        assert changed(pictures[0], pictures[-1]) < 0.001
        if name == "proxy":
            assert changed(asset, pictures[0]) < 0.03
        assert opened.run("document.getElementById('viewer-expressions').hidden")
    assert size["scan"] < 0.8 * size["asset"] < 0.9 * size["high"] and abs(size["proxy"] / size["asset"] - 1) < 0.01
    assert size["asset"] < size["displaced"] < size["high"]
    choose(opened, "mesh", "asset")
    opened.until("document.getElementById('viewer-mesh').dataset.shown === 'asset'")
    assert changed(asset, drawn(opened)) < 0.001
    assert not opened.run("document.getElementById('viewer-expressions').hidden")


def seen(picture: np.ndarray) -> float:
    """Share of the picture that the head covers."""
    return changed(picture, np.broadcast_to(picture[20, 20], picture.shape))


@pytest.mark.slow
def test_the_difference_is_that_of_photo_and_render(opened: Tab) -> None:
    choose(opened, "camera", 3)
    opened.run("document.getElementById('viewer-photo').decode()")
    choose(opened, "split", 100, "input")
    photo = drawn(opened)
    choose(opened, "split", 0, "input")
    render = drawn(opened)
    choose(opened, "compare", "difference")
    choose(opened, "split", 100, "input")
    frame = np.abs(photo - render)
    assert np.abs(drawn(opened) - frame).max(-1)[frame.max(-1) > 4].mean() < 3  # outside of the photo it stays the view
    choose(opened, "compare", "photo")
    assert changed(photo, drawn(opened)) < 0.001
    choose(opened, "camera", "")


def tick(page: Tab, control: str, on: bool) -> None:
    page.run(f"(() => {{ const e = document.getElementById('viewer-{control}'); e.checked = {str(on).lower()};"
             f" e.dispatchEvent(new Event('input')); }})()")  # fmt: skip


@pytest.mark.slow
def test_landmarks_and_the_turn(opened: Tab) -> None:
    """Landmarks are dots on the picture; while it turns, pictures differ, and a photo's camera ends it."""
    opened.run("document.getElementById('viewer-home').click()")
    plain = drawn(opened)
    tick(opened, "landmarks", True)
    assert 1e-5 < changed(plain, drawn(opened)) < 0.02
    tick(opened, "landmarks", False)
    assert changed(plain, drawn(opened)) < 0.001
    tick(opened, "turning", True)
    first = drawn(opened)
    assert changed(first, drawn(opened)) > 0.005
    choose(opened, "camera", 0)
    assert opened.run("document.getElementById('viewer-turning').checked") is False
    choose(opened, "camera", "")
    still = drawn(opened)
    assert changed(still, drawn(opened)) < 0.001


TAB, RIGHT = ("Tab", 9), ("ArrowRight", 39)


@pytest.mark.slow
def test_keys_reach_every_control_and_move_it(opened: Tab) -> None:
    """Real keys: Tab from the top on, then an arrow on a slider and on the canvas."""
    kinds = ", ".join(f"#viewer {kind}" for kind in ("canvas", "select", "input", "button"))
    controls = set(opened.run(f"[...document.querySelectorAll('{kinds}')]"
                              ".filter(e => e.checkVisibility() && e.id).map(e => e.id)"))  # fmt: skip
    assert {"viewer-canvas", "viewer-channel", "viewer-mesh", "viewer-light", "viewer-turn", "viewer-exposure",
            "viewer-camera", "viewer-frusta", "viewer-home"} <= controls  # fmt: skip
    opened.run("document.activeElement.blur(); document.querySelector('.skip').focus()")
    reached, before = [], drawn(opened)
    for _ in range(80):
        opened.press(*TAB)
        reached.append(opened.run("document.activeElement.id"))
        if reached[-1] == "viewer-canvas":
            opened.press(*RIGHT)
            assert changed(before, drawn(opened)) > 0.005
            opened.run("document.getElementById('viewer-home').click()")
        if reached[-1] == "viewer-exposure":
            opened.press(*RIGHT)
            assert float(opened.run("document.activeElement.value")) == pytest.approx(0.1)
            choose(opened, "exposure", 0, "input")
    assert controls <= set(reached)


@pytest.mark.slow
def test_a_click_on_a_camera_shows_its_view(opened: Tab) -> None:
    """Where the picture has the colour of held-out cameras."""
    opened.run("document.getElementById('viewer-canvas').scrollIntoView({block: 'start', behavior: 'instant'})")
    tick(opened, "frusta", True)
    opened.run("document.getElementById('viewer-home').click()")
    picture = drawn(opened)
    blue = np.abs(picture[..., ::-1] - [0x56, 0xB4, 0xE9]).max(-1) < 12
    assert blue.sum() > 5
    left, top = opened.run("(r => [r.x, r.y])(document.getElementById('viewer-canvas').getBoundingClientRect())")
    y, x = (int(v[0]) for v in np.nonzero(blue))
    for kind in ("mousePressed", "mouseReleased"):
        opened.call("Input.dispatchMouseEvent", type=kind, x=left + x, y=top + y, button="left", clickCount=1)
    select = "document.getElementById('viewer-camera')"
    assert "held out" in opened.run(f"{select}.options[{select}.selectedIndex].text")
    assert opened.run("document.getElementById('viewer-photo').hidden") is False
    choose(opened, "camera", "")
    tick(opened, "frusta", False)


@pytest.mark.slow
def test_the_page_is_no_wider_than_a_phone(opened: Tab) -> None:
    opened.size(390, 844, phone=True)
    opened.until("document.documentElement.scrollWidth <= 390")
    opened.size(1280, 720)


@pytest.mark.slow
@pytest.mark.parametrize(("width", "height"), [(1280, 720), (390, 844)])
def test_the_first_screen_shows_verdict_and_view_however_long_the_findings_are(
    opened: Tab, results: SyntheticResults, tmp_path: Path, width: int, height: int
) -> None:
    """Also after the page of long findings was opened: no error in its console."""
    long = [judged(f"toy_{i}", 0.2, Limits(0.9, 0.5), "This is wrong in many words. " * 20, "do it again " * 30,
                   views=["3.png", "9.png"]) for i in range(9)]  # fmt: skip
    masks = Located(results.masks.artifact.model_copy(update={"findings": tuple(long)}), results.masks.folder)
    warned = results.uv.artifact.model_copy(update={"warnings": tuple(f"warning {i}" for i in range(30))})
    changed_results = replace(results, masks=masks, uv=Located(warned, results.uv.folder))
    opened.size(width, height, phone=width < 500)
    opened.call("Page.navigate", url=page_of(changed_results, tmp_path / "long").as_uri())
    opened.until("document.documentElement && document.documentElement.dataset.viewer")
    box = "document.querySelector('{}').getBoundingClientRect()"
    assert opened.run(f"{box.format('.verdict')}.bottom <= {box.format('#viewer .stage')}.top")
    assert opened.run(f"innerHeight - {box.format('#viewer .stage')}.top") >= 250
    folded = "document.querySelector('.troubles').open"
    assert opened.run(folded) is False
    opened.run("document.querySelector('.troubles summary').click()")
    assert opened.run(folded) is True and opened.run(f"{box.format('#viewer .stage')}.top > innerHeight")


@pytest.mark.slow
def test_dark_and_light_follow_the_system_and_the_switch(opened: Tab) -> None:
    colour = "getComputedStyle(document.body).backgroundColor"
    found = {}
    for theme in ("light", "dark"):
        opened.call("Emulation.setEmulatedMedia", features=[{"name": "prefers-color-scheme", "value": theme}])
        opened.run("document.getElementById('theme').checked = false")
        found[theme] = opened.run(colour)
        opened.run("document.getElementById('theme').click()")
        found[f"{theme}, switched"] = opened.run(colour)
        opened.run("document.getElementById('theme').click()")
    assert found["light"] == found["dark, switched"] != found["dark"] == found["light, switched"]
