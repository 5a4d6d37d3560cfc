"""What all formats of given cameras share: the views, matching of photo names, approximation of other lens models."""

from __future__ import annotations

import json
import re
from collections.abc import Callable, Mapping, Sequence
from contextlib import suppress
from dataclasses import dataclass
from functools import lru_cache
from pathlib import Path, PurePosixPath
from typing import Any, Protocol

import numpy as np

from pipeline.capture_artifacts import GivenCamera
from pipeline.errors import StageError
from pipeline.transforms import F64, distort
from stages.capture.readers.values import DIGITS, LONGEST_NAME, LONGEST_PATH, fault, printable

PHOTO_SUFFIXES = (".jpg", ".jpeg", ".png", ".tif", ".tiff", ".exr")
HEIF_SUFFIXES, RAW_SUFFIXES = (".heic", ".heif", ".hif"), (".dng", ".cr2", ".nef", ".arw")  # photos without cameras
PHOTO_FOLDERS = ("", "images", "image", "input", "photos", "rgb")
LENS_LIMIT = 0.25  # pixels, largest error of the five-term approximation of a lens
MAX_BYTES = 64_000_000  # of a cameras' file: cameras of about ten thousand photos; a larger file is something else
MAX_DIGITS = 300  # of a number in a file name that is compared by its value
MAX_STEPS = 100  # of the least squares: a lens that five terms can describe needs about ten
GRID = 17  # half the number of positions along each edge of the frame at which a lens is compared


def description(path: Path) -> bytes:
    """The bytes of a cameras' file. Raises StageError before reading if it is too large."""
    size = path.stat().st_size
    if size > MAX_BYTES:
        raise StageError(
            "the cameras' file is too large",
            where=path.name,
            value=f"{size / 1e6:.0f} MB",
            limit=f"{MAX_BYTES / 1e6:.0f} MB",
            remedy="export the cameras alone, without points and pictures",
        )
    return path.read_bytes()


def read_json(path: Path, what: str, remedy: str) -> Any:
    """The content of a JSON file. what: the message if it is not JSON. Raises StageError."""
    try:
        return json.loads(description(path))
    except (ValueError, RecursionError) as e:
        raise fault(what, path.name, printable(str(e)), "a JSON object", remedy) from e


@dataclass(frozen=True, slots=True)
class Declared:
    """One view of a cameras' file. name: the photo's name in it. photo, mask: files in the capture, None if missing.

    camera: None if the file has none. size: (width, height) in pixels, None if unknown. serial: the camera body, "" if
    unknown.
    """

    index: int
    name: str
    photo: Path | None
    camera: GivenCamera | None
    size: tuple[int, int] | None
    serial: str = ""
    mask: Path | None = None


@dataclass(frozen=True, slots=True)
class Described:
    """views: those that may be used. left_out: a note on each view that the cameras' file excludes, or that has no
    photo; absent: their photos' names."""

    views: tuple[Declared, ...]
    left_out: tuple[str, ...] = ()
    absent: tuple[str, ...] = ()
    warnings: tuple[str, ...] = ()


class Reader(Protocol):
    """A format. Modules of this package are readers."""

    def find(self, folder: Path) -> list[Path]:
        """The cameras' files of this format in `folder`; empty if there are none."""
        ...

    def read(self, folder: Path, files: Sequence[Path]) -> Described:
        """The views. Raises StageError that names the wrong file or camera."""
        ...


def natural_key(name: str) -> tuple[tuple[int, int, str], ...]:
    """Sort key that puts 2.jpg before 10.jpg."""
    parts = re.findall(r"\d+|\D+", name)
    return tuple((0, int(p), p) if p.isdecimal() and len(p) < MAX_DIGITS else (1, 0, p.lower()) for p in parts)


def indices_of(names: Sequence[str]) -> list[int]:
    """View numbers: the file stems if all are different numbers, else 0, 1, 2, ... in order."""
    stems = [PurePosixPath(n).stem for n in names]
    if all(s.isdecimal() and len(s) <= DIGITS for s in stems) and len({int(s) for s in stems}) == len(stems):
        return [int(s) for s in stems]
    return list(range(len(stems)))


def find_photo(folder: Path, written: str) -> Path | None:
    """The photo for a path in a cameras' file, or None: the path itself, the path with a suffix added, or the file name
    in one of PHOTO_FOLDERS. If no file has that spelling, one whose name differs in capital letters only: cameras write
    DSC_0001.JPG, and programs write the name without a suffix or with a small one.

    Paths that lead out of the capture are not followed. A name longer than file systems allow gives None.
    """
    plain = written.replace("\\", "/").removeprefix("./")
    lengths = [len(part.encode("utf-8", "backslashreplace")) for part in plain.split("/")]
    if not PurePosixPath(plain).name or max(lengths) > LONGEST_NAME or sum(lengths) > LONGEST_PATH:
        return None
    inside = not PurePosixPath(plain).is_absolute() and ".." not in PurePosixPath(plain).parts
    candidates = [folder / root / plain for root in PHOTO_FOLDERS] if inside else []
    candidates += [folder / root / PurePosixPath(plain).name for root in PHOTO_FOLDERS]
    for candidate in candidates:
        for name in _names(candidate):
            if (candidate.parent / name).is_file():
                return candidate.parent / name
    for candidate in candidates:
        spelt = _spellings(candidate.parent)
        for name in _names(candidate):
            found = spelt.get(name.casefold())
            if found is not None and (candidate.parent / found).is_file():
                return candidate.parent / found
    return None


def _names(candidate: Path) -> list[str]:
    """Names that the photo of this path may have."""
    own = [candidate.name] if candidate.suffix.lower() in PHOTO_SUFFIXES else []
    return own + [candidate.name + suffix for suffix in PHOTO_SUFFIXES]


def _spellings(folder: Path) -> Mapping[str, str]:
    """File names in a folder by their small letters."""
    try:
        return _listing(folder, folder.stat().st_mtime_ns)
    except (OSError, ValueError):  # there is no such folder, or its name can't be one
        return {}


@lru_cache(maxsize=4 * len(PHOTO_FOLDERS))
def _listing(folder: Path, changed: int) -> Mapping[str, str]:
    """The same, once for the cameras of a file, which may be ten thousand. changed: when the folder was, as a key."""
    names = sorted((p.name for p in folder.iterdir()), reverse=True)
    return {n.casefold(): n for n in names if PurePosixPath(n).suffix.lower() in PHOTO_SUFFIXES}


def five_terms(
    image_from_plane: Callable[[F64], F64], K: F64, width: int, height: int, where: str
) -> tuple[F64, F64, float]:
    """K (3, 3), k1 k2 p1 p2 k3 (5,) and the greatest error in pixels of the best approximation of another lens model.

    image_from_plane: pixels (N, 2) of positions (N, 2) on the plane z = 1, NaN where undefined. Least squares over the
    frame, so that photos of a fisheye or a rational lens need not be resampled.
    Raises StageError if the error is more than LENS_LIMIT.
    """
    from scipy.optimize import least_squares

    xy, uv = _over_the_frame(image_from_plane, K, width, height)
    start = np.array([K[0, 0], K[1, 1], K[0, 2], K[1, 2], 0, 0, 0, 0, 0])

    def error(p: F64) -> F64:
        return np.asarray((distort(xy, p[4:]) * p[:2] + p[2:4] - uv).ravel(), np.float64)

    p, worst = start, np.inf
    if len(xy) >= 9:
        with suppress(ValueError, np.linalg.LinAlgError), np.errstate(all="ignore"):  # it diverged
            p = least_squares(error, start, x_scale=np.maximum(np.abs(start), 0.1), max_nfev=MAX_STEPS).x
            worst = float(np.linalg.norm(error(p).reshape(-1, 2), axis=1).max())
    if not worst <= LENS_LIMIT:
        raise fault(
            "the lens can't be described by k1 k2 p1 p2 k3",
            where,
            f"an error of up to {worst:.2f} pixels in the frame",
            f"at most {LENS_LIMIT} pixels",
            "undistort the photos first and give the undistorted cameras, or remove the cameras' file to solve the "
            "cameras from the photos",
        )
    found = np.array([[p[0], K[0, 1], p[2]], [0, p[1], p[3]], [0, 0, 1.0]])
    return found, np.asarray(p[4:], np.float64), worst


def _over_the_frame(image_from_plane: Callable[[F64], F64], K: F64, width: int, height: int) -> tuple[F64, F64]:
    """Positions (N, 2) on the plane z = 1 that are projected into the frame or up to one pixel around it, and their
    pixels (N, 2)."""
    reach = np.array([max(K[0, 2], width - K[0, 2]) / K[0, 0], max(K[1, 2], height - K[1, 2]) / K[1, 1]])
    side = np.linspace(-1, 1, 2 * GRID)
    xy = np.stack(np.meshgrid(side, side), -1).reshape(-1, 2) * reach * 1.5
    with np.errstate(all="ignore"):
        uv = image_from_plane(xy)
    inside = np.isfinite(uv).all(1) & (uv > -1).all(1) & (uv < np.array([width, height]) + 1).all(1)
    return xy[inside], uv[inside]
