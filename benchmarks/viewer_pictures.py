"""The pictures of docs/looking.md: every panel of the 3D view and of the report, and the live page, in Chromium.

    make demo
    python -m benchmarks.viewer_pictures out/demo --out docs/pictures/looking

Needs a Chromium on the PATH (any of tests/support/browser.py's names), and no GPU. Prints how long the view took to
load and how much processor time that was. A minute on two cores.
"""

from __future__ import annotations

import argparse
import tempfile
import time
from collections.abc import Callable, Iterator
from pathlib import Path

import cv2
import numpy as np
import numpy.typing as npt

from tests.support.browser import Tab, installed, tab

U8 = npt.NDArray[np.uint8]
SCREEN = (1280, 720)
PHONE = (390, 844)
QUALITY = 82  # of a JPEG
SIDE, LINE, GAP = 300, 24, 6  # pixels: of a strip's picture along its sides, of its caption, between two pictures
CHANNELS = ("albedo", "f0", "roughness", "normal", "ambient_occlusion", "confidence", "coverage", "region", "checker",
            "density", "wireframe")  # fmt: skip
LIGHTS = ("captured", "key", "overcast", "sunset")
# file -> the heading of a part of the page, and how many pixels of it are shown
PARTS = {"held_out": ("Held-out views", 700), "scores": ("Scores of every view", 420),
         "shape": ("Shape and appearance", 560),
         "turntable": ("Turntable", 640), "maps": ("Maps and light", 760),
         "cameras": ("Cameras and masks", 1000)}  # fmt: skip


def main() -> int:
    """Write the pictures; see above."""
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("run", type=Path, help="the --out of a demo")
    parser.add_argument("--out", type=Path, required=True)
    given = parser.parse_args()
    if installed() is None:
        raise SystemExit("no Chromium is installed")
    given.out.mkdir(parents=True, exist_ok=True)
    with tempfile.TemporaryDirectory() as profile, tab(Path(profile)) as page:
        print(opened(page, given.run / "report" / "index.html"))
        for name, picture in pictures(page):
            cv2.imwrite(str(given.out / f"{name}.jpg"), picture, [cv2.IMWRITE_JPEG_QUALITY, QUALITY])
        if page.troubles:
            raise SystemExit(f"the page told errors: {page.troubles}")
    return 0


def opened(page: Tab, path: Path) -> str:
    """Load the page, until its first picture is drawn; returns how long it took, in words."""
    page.size(*SCREEN)
    before, start = page.processor_seconds(), time.monotonic()
    page.call("Page.navigate", url=path.resolve().as_uri())
    page.until("document.documentElement && document.documentElement.dataset.viewer === 'ready'", 120)
    page.until("Number(document.getElementById('viewer-canvas').dataset.frames) > 0")
    page.run("new Promise(r => requestAnimationFrame(() => requestAnimationFrame(r)))")
    took, work = time.monotonic() - start, page.processor_seconds() - before
    return f"the view was there after {took:.1f} s, with {work:.1f} s of processor time"


def pictures(page: Tab) -> Iterator[tuple[str, U8]]:
    """(name, picture) of every panel, in the order of the page that shows them."""
    yield "first_screen", screen(page)
    yield "channels", strip_of(page, CHANNELS, channel)
    channel(page, "look")
    yield "lights", strip_of(page, LIGHTS, light)
    light(page, "captured")
    yield "meshes", strip_of(page, meshes(page), mesh)
    mesh(page, "asset")
    yield "frusta", frusta(page)
    yield "slider", slider(page)
    for name, (place, height) in PARTS.items():
        yield name, part(page, place, height)
    yield "dark_and_phone", dark_and_phone(page)


# ------------------------------------------------------------------ the controls
def chosen(page: Tab, control: str, value: str, event: str = "change") -> None:
    """Set a control of the view, as a user does."""
    page.run(f"(() => {{ const e = document.getElementById('viewer-{control}'); e.value = '{value}';"
             f" e.dispatchEvent(new Event('{event}')); }})()")  # fmt: skip


def ticked(page: Tab, control: str, *, on: bool) -> None:
    """Set a tick of the view."""
    page.run(f"(() => {{ const e = document.getElementById('viewer-{control}'); e.checked = {str(on).lower()};"
             f" e.dispatchEvent(new Event('input')); }})()")  # fmt: skip


def channel(page: Tab, name: str) -> None:
    """Show a channel, and wait for it."""
    chosen(page, "channel", name)
    page.until(f"document.getElementById('viewer-channel').dataset.shown === '{name}'")


def light(page: Tab, name: str) -> None:
    """Use a light."""
    chosen(page, "light", name, "input")


def mesh(page: Tab, name: str) -> None:
    """Show a mesh, and wait for it."""
    chosen(page, "mesh", name)
    page.until(f"document.getElementById('viewer-mesh').dataset.shown === '{name}'")


def meshes(page: Tab) -> tuple[str, ...]:
    """The meshes that the page has."""
    return tuple(page.run("[...document.getElementById('viewer-mesh').options].map(o => o.value)"))


# ------------------------------------------------------------------ pictures
def screen(page: Tab) -> U8:
    """What the window shows."""
    settled(page)
    return decoded(page.picture())


def canvas(page: Tab) -> U8:
    """The picture of the view with what lies over it."""
    settled(page)
    box = page.run("(({x, y, width, height}) => ({x, y: y + scrollY, width, height}))"
                   "(document.getElementById('viewer-canvas').getBoundingClientRect())")  # fmt: skip
    return decoded(page.picture(**box))


def settled(page: Tab) -> None:
    """Wait until what was asked for is drawn."""
    page.run("new Promise(r => setTimeout(() => requestAnimationFrame(() => requestAnimationFrame(r)), 300))")


def decoded(png: bytes) -> U8:
    """A picture (H, W, 3) in OpenCV's order of colours."""
    return np.asarray(cv2.imdecode(np.frombuffer(png, np.uint8), cv2.IMREAD_COLOR), np.uint8)


def strip_of(page: Tab, names: tuple[str, ...], show: Callable[[Tab, str], None]) -> U8:
    """The middle of the view with each of the names chosen, four in a row."""
    found: list[tuple[U8, str]] = []
    for name in names:
        show(page, name)
        label = page.run(f"[...document.querySelectorAll('#viewer option')].find(o => o.value === '{name}').text")
        found.append((middle(canvas(page)), str(label)))
    rows = [captioned(found[i : i + 4]) for i in range(0, len(found), 4)]
    width = max(r.shape[1] for r in rows)
    return np.vstack([cv2.copyMakeBorder(r, 0, 0, 0, width - r.shape[1], cv2.BORDER_CONSTANT, value=(255,) * 3)
                      for r in rows])  # fmt: skip


def captioned(pictures: list[tuple[U8, str]]) -> U8:
    """Pictures of one height side by side, with their captions below."""
    columns = []
    for image, caption in pictures:
        label = np.full((LINE, image.shape[1], 3), 255, np.uint8)
        cv2.putText(label, caption[:36], (4, 17), cv2.FONT_HERSHEY_SIMPLEX, 0.45, (40, 40, 40), 1, cv2.LINE_AA)
        columns += [np.concatenate([image, label]), np.full((len(image) + LINE, GAP, 3), 255, np.uint8)]
    return np.concatenate(columns[:-1], 1)


def middle(picture: U8) -> U8:
    """The square in the middle, SIDE pixels along a side."""
    height, width = picture.shape[:2]
    left = (width - height) // 2
    square = picture[:, left : left + height]
    return np.asarray(cv2.resize(square, (SIDE, SIDE), interpolation=cv2.INTER_AREA), np.uint8)


def frusta(page: Tab) -> U8:
    """All cameras around the head."""
    ticked(page, "frusta", on=True)
    page.run("document.getElementById('viewer-home').click()")
    found = screen(page)
    ticked(page, "frusta", on=False)
    return found


def slider(page: Tab) -> U8:
    """Through a held-out photo's camera: photo | render, and their difference | render."""
    number = page.run(
        "[...document.getElementById('viewer-camera').options].findIndex(o => o.text.includes('held out'))"
    )
    chosen(page, "camera", str(int(number) - 1))
    page.run("document.getElementById('viewer-photo').decode()")
    chosen(page, "split", "50", "input")
    found = [canvas(page)]
    chosen(page, "compare", "difference")
    found.append(canvas(page))
    chosen(page, "compare", "photo")
    chosen(page, "camera", "")
    labels = ("photo | render", "difference | render")
    return captioned([(middle_of(p), text) for p, text in zip(found, labels, strict=True)])


def middle_of(picture: U8) -> U8:
    """The square in the middle as it is on the screen."""
    height, width = picture.shape[:2]
    return picture[:, (width - height) // 2 : (width + height) // 2]


def part(page: Tab, place: str, height: int) -> U8:
    """A part of the page: from a heading, or the element of a selector, downwards."""
    find = (f"document.querySelector('{place}')" if place.startswith(".") else
            f"[...document.querySelectorAll('h2')].find(h => h.textContent === '{place}')")  # fmt: skip
    page.size(SCREEN[0], height)
    page.run(f"{find}.scrollIntoView()")
    found = screen(page)
    page.size(*SCREEN)
    return found


def dark_and_phone(page: Tab) -> U8:
    """The first screen in the other colours, and as a phone shows it."""
    page.run("document.getElementById('theme').click(); scrollTo(0, 0)")
    dark = screen(page)
    page.run("document.getElementById('theme').click()")
    page.size(*PHONE, phone=True)
    page.run("scrollTo(0, 0)")
    phone = screen(page)
    page.size(*SCREEN)
    scale = dark.shape[0] / phone.shape[0]
    small = cv2.resize(phone, None, fx=scale, fy=scale, interpolation=cv2.INTER_AREA)
    gap = np.full((dark.shape[0], 12, 3), 255, np.uint8)
    return np.hstack([dark, gap, np.asarray(small, np.uint8)])


if __name__ == "__main__":
    raise SystemExit(main())
