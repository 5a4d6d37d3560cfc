"""Errors that a user reads.

A failure names five things: what is wrong, where, the value found, the limit it broke and what to do about it.
Programming errors stay ordinary Python exceptions; only what a user can meet and mend is raised from here.
"""

from __future__ import annotations

import errno
from pathlib import Path


class NeufaceError(Exception):
    """Base of every error that is reported without a traceback."""

    exit_code = 1


class StageError(NeufaceError):
    """A stage can't go on. Exit code 1.

    Args:
        what: what is wrong, a short clause ("camera matrix K is singular").
        where: file, view, setting or stage that it concerns.
        value: what was found.
        limit: what would have been acceptable.
        remedy: what the user can do.
    """

    def __init__(self, what: str, *, where: object, value: object, limit: object, remedy: str) -> None:
        self.what, self.where, self.value, self.limit, self.remedy = what, where, value, limit, remedy
        super().__init__(f"{what}\n  where: {where}\n  found: {value}\n  limit: {limit}\n  what to do: {remedy}")

    def __reduce__(self) -> tuple[object, ...]:
        fields = {k: str(getattr(self, k)) for k in ("where", "value", "limit", "remedy")}
        return _rebuild, (type(self), self.what, fields)


class UsageError(StageError):
    """The command line or a setting is wrong. Exit code 2."""

    exit_code = 2


class DiskError(StageError):
    """A disk that is full, read-only, forbidden or failing: somebody has to mend it. Exit code 1."""


class TimeLimitError(StageError):
    """A stage took longer than it may. Exit code 1."""


class Cancelled(NeufaceError):
    """The user stopped the run; finished stages and checkpoints are kept. Exit code 130."""

    exit_code = 130


def _rebuild(kind: type[StageError], what: str, fields: dict[str, str]) -> StageError:
    return kind(what, **fields)


_DISK_REMEDIES = {
    errno.ENOSPC: ("no space is left on the disk", "free space on this disk, or choose another with --out or --store"),
    errno.EDQUOT: ("the disk quota is used up", "free space, or choose another disk with --out or --store"),
    errno.EFBIG: ("a file is larger than may be written here", "raise the limit (ulimit -f), or choose another disk"),
    errno.EIO: ("the disk fails to read or write", "look at the disk, or choose another with --out or --store"),
    errno.EROFS: ("the disk is read-only", "choose a writable folder with --out or --store"),
    errno.EACCES: ("permission denied", "choose a folder that this user may write to, or change its permissions"),
    errno.EPERM: ("permission denied", "choose a folder that this user may write to, or change its permissions"),
    errno.ENOTDIR: ("a file is where a folder is needed", "remove that file or choose another folder"),
}


def stage_error_from_os_error(error: OSError, where: Path | str) -> DiskError | None:
    """The user's message for a disk fault, or None when it is not one that a user can mend."""
    found = _DISK_REMEDIES.get(error.errno or 0)
    if found is None:
        return None
    what, remedy = found
    return DiskError(
        what,
        where=error.filename or where,
        value=error.strerror or error,
        limit="a writable folder with enough free space",
        remedy=remedy,
    )
