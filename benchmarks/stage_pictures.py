"""The pictures of docs/stages: what each stage of the demo's run makes.

    make demo
    python -m benchmarks.stage_pictures out/demo --out docs/pictures/stages

One strip of pictures per stage, NAME.jpg. The report's is a screenshot and not made here.
"""

from __future__ import annotations

import argparse
import json
from collections.abc import Callable
from pathlib import Path
from typing import Any

import cv2
import numpy as np

from benchmarks.overview_picture import MAPS, SIDE, U8, held_out, read, relit, rendered, stretched, strip
from pipeline import meshes
from stages.usd.render.exported import load_exported
from stages.usd.render.previews import GREY_LIGHT, framing
from stages.usd.render.render import Renderer

Strip = list[tuple[U8, str]]
WHITE = 255


def main() -> int:
    """Write the pictures; see above."""
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("run", type=Path, help="the --out of a demo")
    parser.add_argument("--out", type=Path, required=True)
    given = parser.parse_args()
    given.out.mkdir(parents=True, exist_ok=True)
    makers: dict[str, Callable[[Path], Strip]] = {
        "capture": photos, "poses": cameras, "masks": cut_out, "inverse_rendering": compared, "surface": shape,
        "uv": charts, "bake": maps, "usd": lights,
    }  # fmt: skip
    for stage, maker in makers.items():
        path = given.out / f"{stage}.jpg"
        cv2.imwrite(str(path), strip(maker(given.run)), [cv2.IMWRITE_JPEG_QUALITY, 85])
    return 0


def artifact(run: Path, stage: str) -> tuple[Path, dict[str, Any]]:
    """The folder and the manifest of what a stage made."""
    key = json.loads((run / "run.json").read_text())["stages"][stage]["key"]
    folder = run / ".store" / stage / key
    return folder, json.loads((folder / "manifest.json").read_text())


def photos(run: Path) -> Strip:
    """Five photos."""
    return [(read(run / "capture" / f"{i}.png"), f"photo {i}") for i in (0, 8, 16, 24, 32)]


def cameras(run: Path) -> Strip:
    """The cameras from above, from the front and from the side."""
    found = artifact(run, "poses")[1]
    eyes = np.array([c["world_from_cam"] for c in found["cameras"]], np.float64)[:, :3, 3]
    radius, reach = found["roi_radius"], 1.1 * float(np.abs(eyes).max())
    out = []
    for across, up, caption in ((0, 2, "cameras, from above"), (0, 1, "from the front"), (2, 1, "from the side")):
        picture = np.full((SIDE, SIDE, 3), WHITE, np.uint8)
        place = ((np.array([[1, 1 if up == 2 else -1]]) * eyes[:, [across, up]] / reach + 1) * SIDE / 2).astype(int)
        cv2.circle(picture, (SIDE // 2, SIDE // 2), round(radius / reach * SIDE / 2), (170, 170, 170), -1, cv2.LINE_AA)
        for x, y in place:
            cv2.circle(picture, (int(x), int(y)), 3, (180, 90, 30), -1, cv2.LINE_AA)
        out.append((picture, caption))
    return out


def cut_out(run: Path) -> Strip:
    """Photos with what the masks leave out in grey."""
    folder, found = artifact(run, "masks")
    out = []
    for mask in [m for m in found["masks"] if m["index"] in (0, 8, 16, 24, 32)]:
        alpha = read(folder / mask["mask"]["path"]).astype(np.float32) / 255
        photo = read(run / "capture" / f"{mask['index']}.png")
        out.append((np.asarray(photo * alpha + 128 * (1 - alpha), np.uint8), f"photo {mask['index']}, masked"))
    return out


def compared(run: Path) -> Strip:
    """A held-out photo, the fitted model, and how they differ."""
    view = held_out(run)[0]
    photo, model = read(run / "capture" / f"{view}.png"), read(run / "report" / "views" / f"{view}.png")
    off = np.abs(photo.astype(int) - model).astype(np.float32)
    return [(photo, "photo, not used"), (model, "fitted model"),
            (np.asarray((4 * off).clip(0, 255), np.uint8), "difference x 4")]  # fmt: skip


def shape(run: Path) -> Strip:
    """The exported mesh in grey, from four sides."""
    renderer = Renderer(load_exported(next((run / "asset").glob("*.usd"))))
    out = []
    for degrees, caption in ((0, "front"), (60, "left"), (180, "back"), (300, "right")):
        rgba = renderer.render(framing(renderer, np.radians(degrees), SIDE), light=GREY_LIGHT, plain=True)
        grey = (rgba[..., :3] + 1 - rgba[..., 3:]).clip(0, 1) ** (1 / 2.2)
        out.append((np.asarray(255 * grey[..., ::-1], np.uint8), caption))
    return out


def charts(run: Path) -> Strip:
    """The charts of the texture, and the albedo on them."""
    folder, found = artifact(run, "uv")
    laid = meshes.load_charts(folder / found["mesh"]["path"])
    big = np.full((4 * SIDE, 4 * SIDE, 3), WHITE, np.uint8)
    corners = (laid.uvs[laid.faces] * [1, -1] + [0, 1]) * 4 * SIDE
    cv2.fillPoly(big, list(corners.round().astype(np.int32)), (225, 225, 225))
    cv2.polylines(big, list(corners[::6].round().astype(np.int32)), True, (120, 120, 120))
    small = np.asarray(cv2.resize(big, (SIDE, SIDE), interpolation=cv2.INTER_AREA), np.uint8)
    albedo = read(next((run / "asset" / "textures").glob("*_albedo.png")))
    return [(small, "charts"), (albedo, "albedo on them")]


def maps(run: Path) -> Strip:
    """Four maps."""
    folder = run / "asset" / "textures"
    return [(stretched(read(next(folder.glob(f"*_{name}.png")))), caption) for name, caption in MAPS]


def lights(run: Path) -> Strip:
    """The asset in the captured light and in another, beside the photo."""
    view = held_out(run)[0]
    photo = read(run / "capture" / f"{view}.png")
    return [(photo, "photo, not used"), (rendered(run, view), "asset, captured light"), (relit(run, view), "new light")]


if __name__ == "__main__":
    raise SystemExit(main())
