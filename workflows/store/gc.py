"""Clearing up a store: unused results (gc), and everything made from one person's photos (purge)."""

from __future__ import annotations

import hashlib
import os
import re
import shutil
import time
from collections.abc import Iterable, Iterator
from dataclasses import dataclass
from pathlib import Path

from pipeline.store import LINEAGE, LOCKS, Store, lineage
from workflows.batch.captures import RECORDS
from workflows.batch.page import AVERAGE, TABLES, captures_in
from workflows.batch.state import Entry
from workflows.live.folder import FOLDER as LIVE
from workflows.live.folder import STATE, ours_in, read_small
from workflows.run.published import FOLDERS, LIST, TRUTH, is_ours, is_record, listed, published, split
from workflows.run.published import entries as files_in
from workflows.run.room import size_of
from workflows.run.run_lock import lock_is_free
from workflows.store.films import Known, films_in, is_made_from, of_older_versions, photos_of
from workflows.store.roots import Root, forget_root, notes_of_moved, roots

DAY = 86400.0
MEASURED = "measured"  # setting of usd, and folder in the store (workflows/batch/measure.py)
_KEY = re.compile(r"([0-9a-f]{64})(\.scratch|\.partial-[0-9a-f]+)?")
_HALF = re.compile(r"\..+\.(partial|swap|old)-[0-9a-f]{8}(\.\w+)?|\.probe-[0-9a-f]{8}")  # what killed runs left in OUT


@dataclass(frozen=True, slots=True)
class Piece:
    """Something in a store that may go. why: for the user. size: bytes."""

    path: Path
    why: str
    size: int


# ------------------------------------------------------------------ gc
def garbage(store: Store, older_than: float, now: float | None = None) -> list[Piece]:
    """Results that no published folder names and that were not used for `older_than` seconds.

    While a run is under way only what was not used for a day counts: the run has not named its artifacts yet.
    """
    now = time.time() if now is None else now
    needed = {(stage, key) for root in roots(store) for stage, key in root.keys.items()}
    needed |= {origin for stage, key in needed for origin in _measured(store, stage, key)}
    limit = max(older_than, DAY) if _busy(store) else older_than
    found = []
    for stage, key, kind, path in pieces(store):
        if not lock_is_free(store.root / LOCKS / f"{stage}-{key}"):
            continue
        if kind.startswith(".partial"):
            found.append(Piece(path, "left by a process that died", size_of(path)))
        elif now - path.stat().st_mtime < limit:
            continue
        elif kind == ".scratch":
            found.append(Piece(path, "checkpoints of an abandoned fit", size_of(path)))
        elif (stage, key) not in needed:
            found.append(Piece(path, "no published folder was made from it", size_of(path)))
    return found


def _measured(store: Store, stage: str, key: str) -> Iterator[tuple[str, str]]:
    """The measured expressions (stage, key) that a result was made with: its settings name their file."""
    for name in lineage(store.root / LINEAGE / f"{stage}-{key}.json").get(MEASURED, ()):
        kind, _, own = name.partition("/")
        if kind == MEASURED and _KEY.fullmatch(own):
            yield kind, own


def remove(store: Store, found: Iterable[Piece]) -> None:
    """Take pieces out of the store; one that a process took up meanwhile stays."""
    for piece in found:
        match = _KEY.fullmatch(piece.path.name)
        if match is None or not lock_is_free(store.root / LOCKS / f"{piece.path.parent.name}-{match[1]}"):
            continue
        shutil.rmtree(piece.path, ignore_errors=True)
        if match[2] is None:
            (store.root / LINEAGE / f"{piece.path.parent.name}-{match[1]}.json").unlink(missing_ok=True)


def _busy(store: Store) -> bool:
    return any(not lock_is_free(p) for p in (store.root / LOCKS).glob("run-*"))


def pieces(store: Store) -> Iterator[tuple[str, str, str, Path]]:
    """Every result: (stage, key, "" | ".scratch" | ".partial-...", folder). Other programs' folders are left out."""
    for stage in sorted(p for p in store.root.iterdir() if p.is_dir() and not p.name.startswith(".")):
        for path in sorted(stage.iterdir()):
            match = _KEY.fullmatch(path.name)
            if match is not None and path.is_dir() and not path.is_symlink() and _is_ours(store, stage.name, match[1]):
                yield stage.name, match[1], match[2] or "", path


def _is_ours(store: Store, stage: str, key: str) -> bool:
    """Whether a stage worked on this key here: other programs have folders with names of 64 digits too."""
    traces = (store.root / LOCKS / f"{stage}-{key}", store.root / LINEAGE / f"{stage}-{key}.json")
    return any(p.is_file() for p in traces)


# ------------------------------------------------------------------ purge
@dataclass(frozen=True, slots=True)
class Purge:
    """All that a subject left: folders and files to remove, and the runs among them.

    What stays: the photos, users: files of the user's own, and edited ones, in the folders of results, and unsure:
    results of an older version from a video in the same folder, perhaps of another person's. top: the folder that the
    user named.
    """

    top: Path
    paths: tuple[Path, ...]
    outs: tuple[Path, ...]
    photos: tuple[Path, ...]
    users: tuple[Path, ...]
    unsure: tuple[Path, ...] = ()

    @property
    def size(self) -> int:
        """Bytes."""
        return sum(size_of(p) if p.is_dir() else p.lstat().st_size for p in self.paths)


def belongings(subject: str, out: Path, store: Store) -> Purge:
    """Everything below `out` and in the store that was made from the subject's photos, finished or not."""
    out = out.absolute()
    runs = [r for r in _roots_of(out, store) if _is_of(subject, r, out)]
    entries = [(p, e) for p, e in _entries(out) if e.name == subject or e.name.startswith(f"{subject}/")]
    photos = {p for r in runs for p in photos_of(r, store)} | {Path(e.capture).absolute() for _, e in entries}
    photos |= set(_told_photos(subject, out))
    known = _lineages(store)
    photos |= set(films_in(photos, known))
    outs = {r.out for r in runs} | {out / e.name for _, e in entries}
    own = {f"{stage}/{key}" for r in runs for stage, key in r.keys.items()}
    paths, users = set(_made_from(photos, own, known, store)), set[Path]()
    paths |= {note for r in runs for note in notes_of_moved(store, r.keys)}
    unsure = set(_unsure(photos, known, store)) - paths
    outs |= {r.out for r in _roots_of(out, store) if any(store.folder(*m) in paths for m in _shapes_of(r, store))}
    outs |= {out} if _tells_of(subject, out) else set()
    for o in (o for o in outs if o.is_dir()):
        ours, theirs = _results(o)
        users |= theirs
        paths |= {o} if o != out and not theirs else ours  # the run's own folder: the store inside may serve others
    for path, entry in entries:
        log = out / RECORDS / "logs" / f"{entry.name.replace('/', '__')}.log"
        paths |= {p for p in (path, log) if p.exists()}
    if entries and (out / RECORDS).is_dir():  # the table names the subject; the next batch writes it anew
        ours, theirs = _tables(out / RECORDS)
        paths, users = paths | ours, users | theirs
    if entries and any(e.name in captures_in(out) for _, e in entries):  # the next batch averages the others
        ours, theirs = _average(out)
        paths, users = paths | ours, users | theirs
    for o in outs:  # the throw-away server of a run keeps its parameters
        home = store.root / ".prefect" / hashlib.sha256(str(o.resolve()).encode()).hexdigest()[:8]
        paths |= {home} if home.is_dir() else set()
    found = (paths, outs, photos, users, unsure)
    return Purge(out, *(tuple(sorted(f)) for f in found))


def _tells_of(subject: str, out: Path) -> bool:
    """Whether a run of this capture tells of itself in OUT/live: one that ended before its results leaves no more."""
    return Path(str(read_small(out / LIVE / STATE).get("capture", ""))).name == subject


def _told_photos(subject: str, out: Path) -> Iterator[Path]:
    """What a run read that tells of itself there: where it was stopped no list names it, and the store has copies."""
    if _tells_of(subject, out):
        told = read_small(out / LIVE / STATE)
        yield from (Path(str(p)) for p in (told.get("capture"), told.get("also")) if p and Path(str(p)).is_absolute())


def _shapes_of(root: Root, store: Store) -> Iterator[tuple[str, str]]:
    """The measured expressions that a published asset was made with: they may be from photos of other captures."""
    for stage, key in root.keys.items():
        yield from _measured(store, stage, key)


def _average(out: Path) -> tuple[set[Path], set[Path]]:
    """The average head of a batch, and files of the user's beside it."""
    mine, users = split(out, AVERAGE, published(out))
    ours = {out / AVERAGE / p for p in mine} if users else {p for p in (out / AVERAGE,) if p.is_dir()}
    return ours, {out / AVERAGE / p for p in users}


def _tables(folder: Path) -> tuple[set[Path], set[Path]]:
    """A batch's tables, as it wrote them, and files of the user's with such names. Older versions kept no list."""
    known, older = listed(folder), not (folder / LIST).exists()
    there = {folder / n for n in TABLES if os.path.lexists(folder / n)}
    ours = {p for p in there if is_ours(p, known.get(p.name, ())) or (older and p.is_file() and not p.is_symlink())}
    return ours, there - ours


def _results(out: Path) -> tuple[set[Path], set[Path]]:
    """What runs left in a folder of results, and what is the user's there: foreign files, and edited ones."""
    known = published(out)
    ours = {out / n for n in known if "/" not in n and is_ours(out / n, known[n])}  # run.json, truth.json, the zip
    ours |= {p for p in (out / LIST, out / "run.json") if is_record(p) or (p.name == LIST and p.is_file())}
    ours |= {p for p in out.iterdir() if _HALF.fullmatch(p.name)}
    folders = (*FOLDERS, TRUTH)
    theirs = {p for p in out.iterdir() if p.name not in (*folders, LIVE, ".store") and p not in ours}
    told = set(ours_in(out / LIVE))  # of a run that stopped
    users_beside = {out / LIVE / p for p in files_in(out / LIVE)} - told
    ours, theirs = ours | told, theirs | users_beside
    for name in folders:
        mine, users = split(out, name, known)
        theirs |= {out / name / p for p in users}
        if mine or not users:
            ours |= {out / name / p for p in mine} if users else {p for p in (out / name,) if p.is_dir()}
    links = {p for p in ours if p.is_symlink()}  # no run ever makes one
    return ours - links, theirs | links


def purge(found: Purge, store: Store) -> list[Path]:
    """Remove it. Returns what is still there: a process works on it, or it can't be removed."""
    for path in found.paths:
        if path.is_dir() and not path.is_symlink():
            shutil.rmtree(path, ignore_errors=True)
        else:
            path.unlink(missing_ok=True)
    for out in found.outs:
        forget_root(store, out)
        for folder in sorted({q for p in found.paths for q in p.parents if q.is_relative_to(out)}, reverse=True):
            _remove_empty(folder)
        _remove_empty(out)
        if found.top in out.parent.parents:
            _remove_empty(out.parent)
    return [p for p in found.paths if p.exists()]


def _remove_empty(folder: Path) -> None:
    """A folder, if it holds nothing. An empty folder of the user's own inside it counts as something."""
    if folder.is_dir() and not folder.is_symlink() and not any(folder.iterdir()):
        folder.rmdir()


def _roots_of(out: Path, store: Store) -> list[Root]:
    return [r for r in roots(store) if r.out == out.resolve() or out.resolve() in r.out.resolve().parents]


def _is_of(subject: str, root: Root, out: Path) -> bool:
    """The run's folder is OUT/SUBJECT or lies in it; or OUT is a single run of a capture of that name."""
    inside = root.out.resolve().relative_to(out.resolve()).parts
    return inside[:1] == (subject,) if inside else Path(root.capture).name == subject


def _entries(out: Path) -> Iterator[tuple[Path, Entry]]:
    for path in sorted((out / RECORDS / "captures").glob("*.json")):
        try:
            yield path, Entry.model_validate_json(path.read_bytes())
        except ValueError:
            continue


def _lineages(store: Store) -> dict[Path, set[str]]:
    files = sorted((store.root / LINEAGE).glob("*.json"))
    return {p: {x for names in lineage(p).values() for x in names} for p in files}


def _made_from(photos: set[Path], own: set[str], known: Known, store: Store) -> Iterator[Path]:
    """Every folder of the store that comes, over any number of stages, from one of these photos or is one of the runs'
    `own`; and its lineage."""
    reached, grown = {str(p) for p in photos}, True
    taken: set[Path] = set()
    while grown:
        grown = False
        for path, origins in known.items():
            stage, _, key = path.stem.rpartition("-")
            if path in taken or not _KEY.fullmatch(key):
                continue
            if f"{stage}/{key}" in own or is_made_from(origins, reached, store, stage, key):
                taken.add(path)
                reached.add(f"{stage}/{key}")
                grown = True
    for path in taken:
        yield path
        yield from _folders_of(path, store)


def _folders_of(path: Path, store: Store) -> Iterator[Path]:
    """What the store has of the key that a file of the lineage is of, finished or not."""
    stage, _, key = path.stem.rpartition("-")
    return (p for p in (store.root / stage).glob(f"{key}*") if _KEY.fullmatch(p.name))


def _unsure(photos: set[Path], known: Known, store: Store) -> Iterator[Path]:
    """What may be of this person's video or of another one's, and of no published run."""
    named = {f"{stage}-{key}" for r in roots(store) for stage, key in r.keys.items()}
    for path in of_older_versions(photos, known):
        yield from _folders_of(path, store) if path.stem not in named else ()
