"""Errors for users.

An error has five parts: what is wrong, where, the value found, the limit, and what to do. Programming errors are
ordinary Python exceptions; only errors that a user can cause and correct are raised from here.
"""

from __future__ import annotations

import errno
import os
from pathlib import Path

MAX_LETTERS = 1000  # characters in one line of a message


class NeufaceError(Exception):
    """Base of every error that is reported without a traceback."""

    exit_code = 1


class StageError(NeufaceError):
    """A stage can't continue. Exit code 1.

    Args:
        what: what is wrong, a short clause ("camera matrix K is singular").
        where: file, view, setting or stage.
        value: the value found.
        limit: what is accepted.
        remedy: what the user can do.
    """

    def __init__(self, what: str, *, where: object, value: object, limit: object, remedy: str) -> None:
        self.what, self.where, self.value, self.limit, self.remedy = what, where, value, limit, remedy
        place, found = (_cut(str(x)) for x in (where, value))
        super().__init__(f"{what}\n  where: {place}\n  found: {found}\n  limit: {limit}\n  what to do: {remedy}")

    def __reduce__(self) -> tuple[object, ...]:
        fields = {k: str(getattr(self, k)) for k in ("where", "value", "limit", "remedy")}
        return _rebuild, (type(self), self.what, fields)


def _cut(text: str) -> str:
    """Shorten text and escape characters that can't be printed: it may come from a file."""
    text = text.encode("utf-8", "backslashreplace").decode()
    return text if len(text) <= MAX_LETTERS else f"{text[: MAX_LETTERS // 2]} ... {text[-MAX_LETTERS // 4 :]}"


class UsageError(StageError):
    """The command line or a setting is wrong. Exit code 2."""

    exit_code = 2


class DiskError(StageError):
    """The disk is full, read-only or failing, or access is denied; somebody must correct this. Exit code 1."""


class MemoryLimitError(StageError):
    """A stage does not fit into the memory. Exit code 1."""


class TimeLimitError(StageError):
    """A stage exceeded its time limit. Exit code 1."""


class Cancelled(NeufaceError):
    """The user stopped the run; finished stages and checkpoints are kept. Exit code 130."""

    exit_code = 130


def _rebuild(kind: type[StageError], what: str, fields: dict[str, str]) -> StageError:
    return kind(what, **fields)


_DISK_REMEDIES = {
    errno.ENOSPC: (
        "no space is left on the disk",
        "free space on this disk, or choose another one with --out or --store",
    ),
    errno.EDQUOT: ("the disk quota is used up", "free space, or choose another disk with --out or --store"),
    errno.EFBIG: ("a file is larger than the limit for files", "raise the limit (ulimit -f), or choose another disk"),
    errno.EIO: ("the disk has a read or write error", "check the disk, or choose another one with --out or --store"),
    errno.EROFS: ("the disk is read-only", "choose a writable folder with --out or --store"),
    errno.EACCES: ("permission denied", "choose a folder that this user may write to, or change its permissions"),
    errno.EPERM: ("permission denied", "choose a folder that this user may write to, or change its permissions"),
    errno.ESTALE: ("the network disk was disconnected", "connect it again, and repeat the command"),
    errno.ENOTCONN: ("the network disk was disconnected", "connect it again, and repeat the command"),
    errno.ENODEV: ("the disk was removed", "connect it again, and repeat the command"),
    errno.EMFILE: ("too many files are open", "raise the limit (ulimit -n)"),
    errno.ENFILE: ("too many files are open on this machine", "close other programs, or raise fs.file-max"),
    errno.ENOTDIR: ("a file is where a folder is needed", "remove that file or choose another folder"),
}


_WRITING = (errno.ENOSPC, errno.EDQUOT, errno.EFBIG, errno.EROFS)  # when copying, these are errors of the target


def stage_error_from_os_error(error: OSError, where: Path | str) -> StageError | None:
    """The error for a user, or None if the user can't correct it."""
    if error.errno == errno.ENAMETOOLONG:
        return _name_too_long(os.fsdecode(error.filename or where))
    closed = _unreadable(error)
    if closed is not None:
        return _can_not_be_read(closed)
    found = _DISK_REMEDIES.get(error.errno or 0)
    if found is None:
        return None
    what, remedy = found
    return DiskError(
        what,
        where=(error.errno in _WRITING and error.filename2) or error.filename or where,
        value=error.strerror or error,
        limit="a writable folder with enough free space",
        remedy=remedy,
    )


def _unreadable(error: OSError) -> Path | None:
    """The file or folder that this user may not read; None if the error is about writing."""
    if error.errno not in (errno.EACCES, errno.EPERM) or not isinstance(error.filename, str | bytes | Path):
        return None
    path = Path(os.fsdecode(error.filename))
    for place, right in ((path.parent, os.X_OK), (path, os.R_OK | (os.X_OK if os.path.isdir(path) else 0))):  # noqa: PTH112
        if os.path.exists(place) and not os.access(place, right):  # noqa: PTH110  (a Path's own raises here)
            return place
    return None


def _can_not_be_read(place: Path) -> StageError:
    return StageError(
        "this user may not read a file or folder",
        where=place,
        value="permission denied",
        limit="read permission (of a folder: read and search)",
        remedy=f"give it with: chmod u+rX '{place}', as its owner; or copy the photos to a folder of your own",
    )


def _name_too_long(path: str) -> StageError:
    name = max(path.split("/"), key=len)
    return StageError(
        "a file's name is too long for the file system",
        where=f"{name[:60]}...",
        value=f"{len(os.fsencode(name))} bytes in a name, {len(os.fsencode(path))} in the whole path",
        limit="255 bytes in a name, 4096 in a path",
        remedy="use shorter names, or folders that are nested less deeply",
    )
