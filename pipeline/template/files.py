"""Reads a template's files: only files of its own folder, of a sane size, and arrays without pickles."""

from __future__ import annotations

import json
import zipfile
from pathlib import Path, PurePosixPath
from typing import Any, NoReturn

import numpy as np
import numpy.typing as npt

from pipeline.errors import StageError

MANIFEST = "manifest.json"
MAX_TEXT = 4 << 20  # bytes of the manifest and of the licence
MAX_FILE = 256 << 20  # of a mesh or of arrays
MAX_UNPACKED = 1 << 30  # of all arrays of a file


def refuse(what: str, where: object, value: object, limit: object, remedy: str) -> NoReturn:
    """The user's message about a template that can't be used."""
    raise StageError(what, where=where, value=value, limit=limit, remedy=remedy)


def inside(folder: Path, name: str) -> Path:
    """The file of a template's folder that a manifest names. Neither paths that leave the folder nor links."""
    pure = PurePosixPath(name)
    if not name or "\0" in name or "\\" in name or pure.is_absolute() or ".." in pure.parts:
        refuse(
            "a template's file lies outside its folder",
            f"{folder / MANIFEST}", repr(name), "a path below the template's folder, with /",
            "copy the file into the folder and name it there",
        )  # fmt: skip
    path = folder
    for part in pure.parts:
        path = path / part
        if path.is_symlink():
            refuse(
                "a template's file is a symbolic link", path, "a link", "plain files", "put the file itself there"
            )  # fmt: skip
    if not path.is_file():
        refuse(
            "a template's file is missing", path, "no such file", f"the files that {MANIFEST} names",
            "add the file, or correct the manifest",
        )  # fmt: skip
    return path


def limited(path: Path, most: int) -> Path:
    """The path, if its file is not larger than `most` bytes."""
    size = path.stat().st_size
    if size > most:
        refuse(
            "a template's file is too large", path, f"{size:,} bytes", f"{most:,} bytes",
            "leave out what the template does not need",
        )  # fmt: skip
    return path


def read_text(path: Path) -> str:
    """A small UTF-8 text."""
    try:
        return limited(path, MAX_TEXT).read_text(encoding="utf-8")
    except UnicodeDecodeError as error:
        refuse("a template's text is not UTF-8", path, error.reason, "UTF-8", "save it as UTF-8")


def read_json(path: Path) -> dict[str, Any]:
    """A JSON object without NaN."""
    try:
        found = json.loads(read_text(path), parse_constant=_no_constant)
    except (ValueError, RecursionError) as error:
        refuse("a template's manifest is not JSON", path, error, "JSON", "correct it: `python -m json.tool` says where")
    if not isinstance(found, dict):
        refuse(
            "a template's manifest is not an object", path, type(found).__name__, "an object: {...}",
            "see docs/template.md for an example",
        )  # fmt: skip
    return found


def _no_constant(name: str) -> NoReturn:
    raise ValueError(f"{name} is not a JSON number")


def read_arrays(path: Path) -> dict[str, npt.NDArray[Any]]:
    """All arrays of an npz."""
    try:
        with zipfile.ZipFile(limited(path, MAX_FILE)) as archive:
            unpacked = sum(i.file_size for i in archive.infolist())
        if unpacked > MAX_UNPACKED:
            refuse(
                "a template's arrays are too large", path, f"{unpacked:,} bytes unpacked", f"{MAX_UNPACKED:,} bytes",
                "leave out what the template does not need",
            )  # fmt: skip
        with np.load(path, allow_pickle=False) as data:
            return {k: np.asarray(data[k]) for k in data.files}
    except StageError:
        raise
    except (ValueError, OSError, EOFError, KeyError, zipfile.BadZipFile, NotImplementedError, RuntimeError,
            MemoryError, SyntaxError, UnicodeError, OverflowError, TypeError, zlib_error()) as error:  # fmt: skip
        refuse(
            "a template's arrays can't be read", path, f"{type(error).__name__}: {error}", "an npz without pickles",
            "write it again with numpy.savez_compressed",
        )  # fmt: skip


def zlib_error() -> type[Exception]:
    """What a damaged deflate stream raises."""
    import zlib

    return zlib.error
