"""`neuface turntable`: a film of one turn around an exported asset, under any light."""

from __future__ import annotations

from collections.abc import Iterator
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np
import numpy.typing as npt

from pipeline.errors import StageError, UsageError
from workflows.cli.render import CAPTURED, component_in, light_named
from workflows.run.output_dirs import check_file, make_folder
from workflows.run.owned import partial_name

U8 = npt.NDArray[np.uint8]
KINDS = (".mp4", ".webp")
RATE = 30  # frames a second
GREY = 0.09  # linear radiance behind the asset


@dataclass(frozen=True, slots=True)
class TurntableRequest:
    """The options of the command. size: pixels along each side."""

    folder: Path
    out: Path
    light: str = CAPTURED
    frames: int = 120
    size: int = 1080


def write_turntable(request: TurntableRequest) -> Path:
    """Render one turn and write it as a film. It has its name when it is whole; a former one stays until then.

    Raises:
        UsageError: not a film's name, or an odd size, which no player of MP4 shows. StageError: something of the asset
        or the light is missing, or the film can't be written.
    """
    kind = request.out.suffix.lower()
    if kind not in KINDS or request.size % 2:
        raise UsageError(
            "this film can't be written",
            where="--out" if kind not in KINDS else "--size",
            value=request.out.name if kind not in KINDS else request.size,
            limit=f"a name that ends with {' or '.join(KINDS)}; an even size",
            remedy="for example --out film.mp4 --size 1080",
        )
    make_folder(request.out.parent)
    check_file(request.out, "--out")
    partial = partial_name(request.out.parent, request.out.name)
    try:
        (_write_mp4 if kind == ".mp4" else _write_webp)(request, frames(request), partial)
        partial.replace(request.out)
    finally:
        partial.unlink(missing_ok=True)
    return request.out


def frames(request: TurntableRequest) -> Iterator[U8]:
    """(size, size, 3) sRGB pictures, in the order of the azimuth, over grey."""
    from pipeline.colour import srgb_from_linear
    from stages.usd.render.exported import load_exported
    from stages.usd.render.previews import framing
    from stages.usd.render.render import Renderer

    root = component_in(request.folder)
    renderer = Renderer(load_exported(root))
    light = light_named(request.light, renderer, root)
    for azimuth in 2 * np.pi * np.arange(request.frames) / request.frames:
        rgba = renderer.render(framing(renderer, float(azimuth), request.size), samples=0, light=light)
        shown = rgba[..., :3] + GREY * (1 - rgba[..., 3:])
        yield np.round(srgb_from_linear(shown.clip(0, 1)) * 255).astype(np.uint8)


def _write_mp4(request: TurntableRequest, pictures: Iterator[U8], path: Path) -> None:
    import cv2

    code = cv2.VideoWriter_fourcc(*"mp4v")  # type: ignore[attr-defined]
    film = cv2.VideoWriter(str(path), code, RATE, (request.size, request.size))
    if not film.isOpened():
        raise _unwritten(request.out)
    try:
        for picture in pictures:
            film.write(np.ascontiguousarray(picture[..., ::-1]))
    finally:
        film.release()
    count = _frames_in(path)  # where the disk is full, OpenCV says nothing
    if count != request.frames:
        raise _unwritten(request.out, f"a film of which {count} of {request.frames} pictures can be read")


def _frames_in(path: Path) -> int:
    import cv2

    film, count = cv2.VideoCapture(str(path)), 0
    while film.grab():
        count += 1
    film.release()
    return count


def _write_webp(request: TurntableRequest, pictures: Iterator[U8], path: Path) -> None:
    import cv2

    film: Any = cv2.Animation()
    film.frames = [np.ascontiguousarray(p[..., ::-1]) for p in pictures]
    film.durations = np.full(len(film.frames), round(1000 / RATE), np.int32)
    made, data = cv2.imencodeanimation(".webp", film, [cv2.IMWRITE_WEBP_QUALITY, 85])
    if not made:
        raise _unwritten(request.out)
    path.write_bytes(data.tobytes())


def _unwritten(path: Path, value: str = "OpenCV reported a failure") -> StageError:
    return StageError(
        "the film can't be written",
        where=path,
        value=value,
        limit="a writable folder with enough free space, and OpenCV with its video writers",
        remedy="free space on this disk, or try the other kind, .webp or .mp4",
    )
