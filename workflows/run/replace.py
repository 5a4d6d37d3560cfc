"""A published folder in place of the one before it. Our old files go, the user's own stay where they are.

The new folder is made beside the old one, with hard links to the user's files; then the two change names in one step.
A process killed at any moment leaves the old folder or the new one under the final name, whole, and the user's files in
it; what else it leaves has a hidden name and is tidied by the next run.
"""

from __future__ import annotations

import ctypes
import errno
import os
import re
import shutil
import uuid
from collections.abc import Callable, Iterable, Iterator
from contextlib import suppress
from dataclasses import dataclass, field
from pathlib import Path, PurePosixPath

from pipeline.artifacts import sha256_of
from pipeline.store import sync
from workflows.run.published import Known, entries, is_ours, split

_AT_FDCWD, _RENAME_EXCHANGE = -100, 2  # linux/fcntl.h, linux/fs.h
_NO_EXCHANGE = {errno.ENOSYS, errno.EINVAL, errno.ENOTSUP, errno.EPERM}  # a kernel or file system without it
SIDE = ".yours-"  # NAME.yours-N: a file of the user's whose name a published one needs
_ASIDE = re.compile(re.escape(SIDE) + r"\d+(?=/|$)")


@dataclass(slots=True)
class Replacement:
    """A folder on its way to OUT/NAME. hashes: of its files, by path below OUT. aside: the user's that had to move.
    placed: it has its name, and under `partial` there may be the old folder."""

    out: Path
    name: str
    partial: Path
    hashes: dict[str, str]
    ours: dict[str, int] = field(default_factory=dict)  # in the old folder; time of the last change, ns
    places: dict[str, str] = field(default_factory=dict)  # of the user's files: in the old folder -> in the new one
    aside: dict[str, str] = field(default_factory=dict)  # path below OUT -> path below OUT
    placed: bool = False


def prepare(out: Path, name: str, fill: Callable[[Path], None], known: Known) -> Replacement:
    """Make the new folder beside OUT/NAME, flushed to the disk, with the user's files linked into it."""
    partial = out / f".{name}.partial-{uuid.uuid4().hex[:8]}"
    try:
        partial.mkdir()
        fill(partial)
        new = {p: sha256_of(partial / p) for p in entries(partial)}
        for p in new:
            sync(partial / p)
        made = Replacement(out, name, partial, {f"{name}/{p}": h for p, h in new.items()})
        _take_over(made, new, known)
        sync(partial)
    except BaseException:
        shutil.rmtree(partial, ignore_errors=True)
        raise
    return made


def _take_over(made: Replacement, new: dict[str, str], known: Known) -> None:
    final = made.out / made.name
    if not final.is_dir() or final.is_symlink():
        return
    shutil.copymode(final, made.partial)
    ours, users = split(made.out, made.name, known)
    same = [p for p in users if p in new and is_ours(final / p, {new[p]})]  # nothing is lost with it
    made.ours = {p: (final / p).lstat().st_mtime_ns for p in (*ours, *same)}
    users = [p for p in users if p not in same]
    made.places = _places(final, users, set(new))
    for path, place in made.places.items():
        _link(final / path, made.partial / place)
        if path != place:
            made.aside[f"{made.name}/{path}"] = f"{made.name}/{place}"


def _places(final: Path, users: Iterable[str], new: set[str]) -> dict[str, str]:
    """Where each of the user's files goes: where it was, or aside if a published file or folder needs its name."""
    users = list(users)
    folders = {str(parent) for p in new for parent in PurePosixPath(p).parents}
    taken = new | folders | set(users) | {str(parent) for p in users for parent in PurePosixPath(p).parents}
    renamed: dict[str, str] = {}
    places: dict[str, str] = {}
    for path in users:
        if path in folders and (final / path).is_dir() and not (final / path).is_symlink():
            continue  # an empty folder that the new one has too
        parts = PurePosixPath(path).parts
        prefixes = ["/".join(parts[: i + 1]) for i in range(len(parts))]
        clash = next((p for p in prefixes if p in new or (p == path and p in folders)), None)
        if clash is None:
            places[path] = path
            continue
        if clash not in renamed:
            renamed[clash] = next(n for n in _sides(clash) if n not in taken)
            taken.add(renamed[clash])
        places[path] = renamed[clash] + path.removeprefix(clash)
    return places


def free_side(folder: Path, name: str) -> str:
    """NAME.yours-N, a name that nothing in the folder has."""
    return next(n for n in _sides(name) if not os.path.lexists(folder / n))


def _sides(path: str) -> Iterator[str]:
    number = 1
    while True:
        yield f"{path}{SIDE}{number}"
        number += 1


def _link(source: Path, target: Path) -> None:
    target.parent.mkdir(parents=True, exist_ok=True)
    if source.is_dir() and not source.is_symlink():
        target.mkdir(exist_ok=True)
        return
    try:
        os.link(source, target, follow_symlinks=False)
    except OSError as e:
        if e.errno in (errno.ENOSPC, errno.EDQUOT):
            raise
        shutil.copy2(source, target, follow_symlinks=False)  # a file system without hard links


def put(made: Replacement) -> None:
    """Give the new folder its final name, then remove of the old one what is ours or stands in the new one."""
    final = made.out / made.name
    ready = made.partial.with_name(made.partial.name.replace(".partial-", ".swap-"))
    made.partial.rename(ready)
    made.partial = ready
    if final.is_symlink() or (final.exists() and not final.is_dir()):  # the user's: no run ever made such a thing
        side = free_side(made.out, made.name)
        final.rename(made.out / side)
        made.aside[made.name] = side
    old = swap(ready, final)
    made.placed = True
    if old is not None:
        made.aside |= _retire(old, final, made)


def drop(made: Replacement) -> None:
    """Forget a folder that did not get its final name. The user's files in it are links.

    One that has its name stays; what is left of the old one holds the user's files, and the next run tidies it."""
    if made.placed:
        return
    shutil.rmtree(made.partial, ignore_errors=True)


def swap(new: Path, final: Path) -> Path | None:
    """Put `new` under the name `final`. Returns where the folder is that had this name before, if one had.

    Raises:
        OSError: it did not work, and `final` is what it was.
    """
    if not os.path.lexists(final):
        new.rename(final)
        return None
    if _exchange(new, final):
        return new
    old = new.with_name(f".{final.name}.swap-{uuid.uuid4().hex[:8]}")
    final.rename(old)
    try:
        new.rename(final)
    except OSError:
        old.rename(final)
        raise
    return old


def _exchange(a: Path, b: Path) -> bool:
    """Let two paths change names in one step; False where the system can't."""
    libc = ctypes.CDLL(None, use_errno=True)
    if not hasattr(libc, "renameat2"):
        return False
    if libc.renameat2(_AT_FDCWD, os.fsencode(a), _AT_FDCWD, os.fsencode(b), _RENAME_EXCHANGE) == 0:
        return True
    number = ctypes.get_errno()
    if number in _NO_EXCHANGE:
        return False
    raise OSError(number, os.strerror(number), str(a), None, str(b))


def _retire(old: Path, final: Path, made: Replacement) -> dict[str, str]:
    """Remove the old folder. What changed in it while the new one was made is put aside, not lost."""

    def safe(path: str) -> bool:
        if path in made.ours:
            return (old / path).lstat().st_mtime_ns == made.ours[path]
        return path in made.places and _same(old / path, final / made.places[path])

    return _rescue(old, final, made.name, safe)


def tidy(out: Path, name: str, known: Known) -> dict[str, str]:
    """Remove what killed runs left beside OUT/NAME. Returns the user's files that were found and put aside."""
    final = out / name
    found: dict[str, str] = {}
    left = [*_left(out, name, "swap"), *_left(out, name, "old")]
    if left and not os.path.lexists(final):
        left.pop().rename(final)
    for folder in left:

        def safe(path: str, folder: Path = folder) -> bool:
            near = [final / path, final / _ASIDE.sub("", path), *final.glob(f"{_literal(path)}{SIDE}*")]
            return is_ours(folder / path, known.get(f"{name}/{path}", ())) or any(_same(folder / path, n) for n in near)

        found |= _rescue(folder, final, name, safe)
    for folder in _left(out, name, "partial"):  # copies and links, never the only one
        shutil.rmtree(folder, ignore_errors=True)
    return found


def _left(out: Path, name: str, kind: str) -> list[Path]:
    """What runs called .NAME.KIND-........ in out. A folder of the user's own with such a beginning is none of them."""
    ours = re.compile(re.escape(f".{name}.{kind}-") + r"[0-9a-f]{8}")
    return [p for p in sorted(out.iterdir()) if ours.fullmatch(p.name) and p.is_dir() and not p.is_symlink()]


def _rescue(old: Path, final: Path, name: str, safe: Callable[[str], bool]) -> dict[str, str]:
    moved: dict[str, str] = {}
    for path in [p for p in entries(old) if not safe(p)]:
        if (old / path).is_dir() and not (old / path).is_symlink():
            continue
        place = next(n for n in (path, *_first(_sides(path), 1000)) if not os.path.lexists(final / n))
        try:
            _link(old / path, final / place)
        except OSError:  # a file where a folder would be: keep the whole old folder
            kept = free_side(final.parent, name)
            old.rename(final.with_name(kept))
            return {**moved, name: kept}
        moved[f"{name}/{path}"] = f"{name}/{place}"
    shutil.rmtree(old, ignore_errors=True)
    return moved


def _first(names: Iterator[str], count: int) -> Iterator[str]:
    return (next(names) for _ in range(count))


def _same(a: Path, b: Path) -> bool:
    with suppress(OSError):
        x, y = a.lstat(), b.lstat()
        if (x.st_ino, x.st_dev) == (y.st_ino, y.st_dev):
            return True
        if a.is_dir() and b.is_dir():
            return True
        if not a.is_symlink() and a.is_file() and b.is_file():
            return x.st_size == y.st_size and sha256_of(a) == sha256_of(b)
        return a.is_symlink() and b.is_symlink() and a.readlink() == b.readlink()
    return False


def _literal(path: str) -> str:
    """A path as a pattern that matches itself alone."""
    return "".join(f"[{c}]" if c in "*?[" else c for c in path)
