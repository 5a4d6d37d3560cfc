"""A made-up capture of many large photos: those of a FaceScape capture, enlarged and moved in the frame.

    python -m benchmarks.many_photos CAPTURE OUT --photos 200 --width 6000 --height 4000

Photo n is number n % N of the N valid photos of CAPTURE, enlarged to the frame's height; the rest of the frame is
black. From the second round on it is moved in the frame, each round by another amount, so that no two are the same
picture; its principal point moves with it. So all cameras are right, and what the photos take to read, check and mask
is that of photos of this size. Their detail is not: enlarged photos are smooth, and their files small.
"""

from __future__ import annotations

import argparse
import json
import shutil
from collections.abc import Sequence
from concurrent.futures import ThreadPoolExecutor
from pathlib import Path
from typing import Any

import cv2
import numpy as np

from pipeline import transforms

MOVED = 0.025  # of the frame's height, for each round
WAYS = ((1, 0), (-1, 0), (0, 1), (0, -1), (1, 1), (-1, -1), (1, -1), (-1, 1))
QUALITY = 92
AT_ONCE = 2  # photos
Params = dict[str, Any]


def enlarge(source: Path, target: Path, photos: int, width: int, height: int) -> None:
    """Write the capture; target must not exist."""
    params: Params = json.loads((source / "params.json").read_text())
    known = [k.removesuffix("_K") for k in params if k.endswith("_K") and params[k.removesuffix("_K") + "_valid"]]
    known = [n for n in known if picture_of(source, n) is not None]
    if not known:
        raise SystemExit(f"{source}: no photos beside params.json; name a FaceScape capture")
    target.mkdir(parents=True)
    out: Params = {}

    def one(n: int) -> None:
        name, turn = known[n % len(known)], n // len(known)
        size = int(params[f"{name}_width"]), int(params[f"{name}_height"])
        place = placed(size, (width, height), turn)
        path = picture_of(source, name)
        assert path is not None
        picture = cv2.imread(str(path), cv2.IMREAD_COLOR)
        assert picture is not None
        cv2.imwrite(
            str(target / f"{n}.jpg"),
            cv2.warpAffine(picture, pixels(place), (width, height), flags=cv2.INTER_LINEAR),
            [cv2.IMWRITE_JPEG_QUALITY, QUALITY],
        )
        K = transforms.corner_K_from_centre_K(np.array(params[f"{name}_K"], float))
        out.update(
            {f"{n}_{k}": params[f"{name}_{k}"] for k in ("Rt", "distortion", "valid") if f"{name}_{k}" in params}
        )
        out[f"{n}_K"] = transforms.centre_K_from_corner_K(place @ K).tolist()
        out[f"{n}_width"], out[f"{n}_height"] = width, height

    try:
        with ThreadPoolExecutor(AT_ONCE) as pool:
            list(pool.map(one, range(photos)))
        ordered = {k: out[k] for k in sorted(out, key=lambda k: (int(k.partition("_")[0]), k))}
        (target / "params.json").write_text(json.dumps(ordered))
    except BaseException:
        shutil.rmtree(target)
        raise


def picture_of(source: Path, name: str) -> Path | None:
    """The photo of a camera; None without one."""
    return next((p for p in (source / f"{name}{end}" for end in (".jpg", ".png")) if p.is_file()), None)


def placed(size: tuple[int, int], frame: tuple[int, int], turn: int) -> np.ndarray:
    """(3, 3) from positions in a photo to those in the frame, pixels from the corner: enlarged to the frame's height,
    in its middle, moved as in this round."""
    factor = frame[1] / size[1]
    step = MOVED * frame[1] * (1 + (turn - 1) // len(WAYS))
    x, y = WAYS[(turn - 1) % len(WAYS)] if turn else (0, 0)
    across = (frame[0] - factor * size[0]) / 2
    return np.array([[factor, 0, across + x * step], [0, factor, y * step], [0, 0, 1]])


def pixels(place: np.ndarray) -> np.ndarray:
    """(2, 3) the same for OpenCV, whose positions count from the middle of the first pixel."""
    half = np.array([[1, 0, 0.5], [0, 1, 0.5], [0, 0, 1]])
    return np.asarray((np.linalg.inv(half) @ place @ half)[:2])


def main(arguments: Sequence[str] | None = None) -> None:
    """The command line."""
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("capture", type=Path)
    parser.add_argument("out", type=Path)
    for name, value in (("photos", 200), ("width", 6000), ("height", 4000)):
        parser.add_argument(f"--{name}", type=int, default=value)
    given = parser.parse_args(arguments)
    if given.out.exists():
        raise SystemExit(f"{given.out} exists; name a new folder")
    enlarge(given.capture, given.out, given.photos, given.width, given.height)


if __name__ == "__main__":
    main()
