"""One zip of what an artist imports, beside the folder asset/. The same files give the same bytes."""

from __future__ import annotations

import re
import shutil
import zipfile
from collections.abc import Iterable, Mapping
from pathlib import Path, PurePosixPath

from stages.usd.layout import INTERNAL, is_read_by_the_asset
from workflows.run.owned import partial_name, put_owned

STAMP = (1980, 1, 1, 0, 0, 0)  # the earliest date in a zip: files have no dates of their own
READABLE = 0o644 << 16  # Unix permissions, where a zip keeps them


def packed(files: Iterable[str]) -> list[str]:
    """Which files of the asset are in the zip, sorted: all but what of internal/ no layer reads. Paths below asset/."""
    return sorted(f for f in files if not f.startswith(f"{INTERNAL}/") or is_read_by_the_asset(f))


def write_pack(out: Path, name: str, files: Mapping[str, Path]) -> str | None:
    """Write OUT/NAME.zip with the files in a folder NAME. files: path below asset/ -> where its content is.

    Returns the new name of a file of the user's that was there, None without one. Nothing half-written has the final
    name, and what a killed process left of an earlier attempt is removed.

    Raises:
        OSError: a file can't be read, or the zip can't be written; what was there before is still there.
    """
    _tidy(out, name)
    made = partial_name(out, f"{name}.zip")
    try:
        with zipfile.ZipFile(made, "x", zipfile.ZIP_STORED) as z:  # maps are compressed already, and zlibs differ
            for path in packed(files):
                _add(z, PurePosixPath(name, path).as_posix(), files[path])
        return put_owned(out, f"{name}.zip", made)
    finally:
        made.unlink(missing_ok=True)


def _add(z: zipfile.ZipFile, name: str, source: Path) -> None:
    info = zipfile.ZipInfo(name, STAMP)
    info.create_system, info.external_attr, info.file_size = 3, READABLE, source.stat().st_size
    with source.open("rb") as content, z.open(info, "w") as member:
        shutil.copyfileobj(content, member, 1 << 20)


def _tidy(out: Path, name: str) -> None:
    left = re.compile(re.escape(f".{name}.partial-") + r"[0-9a-f]{8}\.zip")
    for path in out.iterdir():
        if left.fullmatch(path.name) and path.is_file() and not path.is_symlink():
            path.unlink(missing_ok=True)
