"""Which photos of a folder belong to one view: several exposures, and pairs under polarised light. No picture is read.

Exposures of one view                                        the view's photo
    a_ev-2.jpg, a_ev0.jpg, a_ev+2.jpg                        the one with the number nearest to 0
    brackets/a/*.jpg                                         a.* beside the cameras' file; else the middle one by name
    brackets.json: {"a": ["1.jpg", "2.jpg", "3.jpg"]}, or
      {"a": {"photos": [...], "seconds": [...]}}             the same, else the middle one of the list
Pairs
    a_cross.jpg and a_parallel.jpg, or a_x.jpg and a_p.jpg   the cross-polarised one
    cross/a.jpg and parallel/a.jpg; a.jpg and parallel/a.jpg the cross-polarised one
"""

from __future__ import annotations

import re
from collections.abc import Callable, Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Any

from pipeline.artifacts import FileRef
from pipeline.capture_artifacts import Bracket, PolarisedPair
from pipeline.errors import StageError
from stages.capture.readers.described import natural_key, read_json
from stages.capture.readers.values import printable, some_of

CROSS, PARALLEL, BRACKETS, LIST = "cross", "parallel", "brackets", "brackets.json"
NAMED = 5  # names in an error
_EV = re.compile(r"(?P<view>.+)_ev(?P<stops>[+-]?\d{1,2}(\.\d{1,3})?)", re.IGNORECASE)
_CROSS = re.compile(r"(?P<view>.+)_(cross|x)", re.IGNORECASE)
_PARALLEL = re.compile(r"(?P<view>.+)_(parallel|p)", re.IGNORECASE)
_LONG = re.compile(r".+_(cross|parallel)", re.IGNORECASE)
Listed = Callable[[Path], list[Path]]


@dataclass(frozen=True, slots=True)
class Shots:
    """photos: one for each view. brackets: (name, photo, others, stated exposures). pairs: (cross, parallel)."""

    photos: list[Path]
    brackets: list[tuple[str, Path, list[Path], list[float]]]
    pairs: list[tuple[Path, Path]]

    def files(self) -> list[Path]:
        """All files besides the views' photos."""
        return [f for _, _, others, _ in self.brackets for f in others] + [p for _, p in self.pairs]

    def manifest(self, folder: Path) -> tuple[tuple[Bracket, ...], tuple[PolarisedPair, ...]]:
        """The entries of the source's manifest."""
        made = tuple(
            Bracket(name=name, photo=photo.relative_to(folder).as_posix(),
                    others=tuple(FileRef.of(folder, o) for o in others), exposures=tuple(stated))
            for name, photo, others, stated in self.brackets
        )  # fmt: skip
        pairs = tuple(PolarisedPair(cross=c.relative_to(folder).as_posix(), parallel=FileRef.of(folder, p))
                      for c, p in self.pairs)  # fmt: skip
        return made, pairs


def grouped(folder: Path, photos: Sequence[Path], listed: Listed, *, given: bool) -> Shots:
    """The photos of a folder by views. photos: those in the folder, or with given cameras those that the cameras' file
    names; listed: the photos directly in a folder.

    Raises:
        StageError: photos without their other half, brackets.json or a folder that names no photos, a photo in two
            groups, both brackets and pairs.
    """
    found = list(photos)
    if not given and not found and (folder / CROSS).is_dir():
        found = listed(folder / CROSS)
    single, brackets = _brackets(folder, found, listed, given=given)
    found_pairs, lonely = _pairs(folder, single, listed, given=given)
    if brackets and any(p is not None for _, p in found_pairs):
        raise StageError(
            "the capture has both exposure brackets and polarised pairs",
            where=folder,
            value=f"{len(brackets)} brackets, {len(found_pairs)} polarised views",
            limit="one of them",
            remedy="merge the exposures to EXR first, or give one exposure of each pair",
        )
    if not found_pairs:
        return Shots(single, brackets, [])
    _all_paired(folder, found_pairs, lonely)
    return Shots([c for c, _ in found_pairs], brackets, [(c, p) for c, p in found_pairs if p is not None])


def _brackets(
    folder: Path, photos: list[Path], listed: Listed, *, given: bool
) -> tuple[list[Path], list[tuple[str, Path, list[Path], list[float]]]]:
    """The views' photos, and the brackets."""
    groups = [*_by_name(folder, photos, listed, given=given), *_in_folders(folder, photos, listed, given=given)]
    groups += _in_list(folder, photos, given=given)
    owner: dict[Path, str] = {}
    for name, photo, others, _ in groups:
        for path in (photo, *others):
            if path in owner:
                raise StageError(
                    "a photo is in two exposure brackets",
                    where=printable(path.name),
                    value=f"{printable(owner[path])} and {printable(name)}",
                    limit="one bracket for each photo",
                    remedy=f"use one of names with _ev, the folder {BRACKETS}/ and {LIST}",
                )
            owner[path] = name
    extra = {o for _, _, others, _ in groups for o in others}
    same = {(p.parent, p.stem) for p in owner}  # brackets.json may list a photo's file of another format
    own = [p for p in photos if p not in extra and (p in owner or (p.parent, p.stem) not in same)]
    own += [photo for _, photo, _, _ in groups if photo not in own]
    return own, groups


def _by_name(
    folder: Path, photos: list[Path], listed: Listed, *, given: bool
) -> list[tuple[str, Path, list[Path], list[float]]]:
    """Groups of `a_ev-2.jpg`, ... With given cameras the cameras' file names one photo of each group."""
    around = {f: listed(f) for f in {p.parent for p in photos}} if given else {folder: photos}
    out = []
    for where in sorted(around):
        views: dict[str, list[tuple[float, Path]]] = {}
        for path in around[where]:
            match = _EV.fullmatch(path.stem)
            if match:
                views.setdefault(match["view"], []).append((float(match["stops"]), path))
        for name, members in views.items():
            named = [m for m in members if m[1] in photos]
            if not named:
                continue  # a view that the cameras' file does not list
            base = min(named, key=lambda m: (abs(m[0]), m[0]))
            others = [m for m in members if m is not base]
            out.append((name, base[1], [p for _, p in others], [2.0**s for s, _ in (base, *others)]))
    return out


def _in_folders(
    folder: Path, photos: list[Path], listed: Listed, *, given: bool
) -> list[tuple[str, Path, list[Path], list[float]]]:
    """Groups in `brackets/a/`."""
    root = folder / BRACKETS
    if not root.is_dir():
        return []
    stems = {p.stem: p for p in photos}
    out: list[tuple[str, Path, list[Path], list[float]]] = []
    for sub in sorted((d for d in root.iterdir() if d.is_dir()), key=lambda d: natural_key(d.name)):
        members = listed(sub)
        if not members:
            raise _nothing(f"{BRACKETS}/{sub.name}/", "no photos", "photos of one view at several exposures")
        base = stems.get(sub.name)
        if base is None and given:
            continue
        base = members[len(members) // 2] if base is None else base
        out.append((sub.name, base, [m for m in members if m != base], []))
    return out


def _in_list(folder: Path, photos: list[Path], *, given: bool) -> list[tuple[str, Path, list[Path], list[float]]]:
    """Groups that brackets.json lists."""
    file = folder / LIST
    if not file.is_file():
        return []
    content = read_json(file, f"{LIST} can't be read", "write it again, or remove it")
    if not isinstance(content, dict) or not content:
        raise _nothing(LIST, type(content).__name__, "an object with a list of photos for each view")
    stems = {p.stem: p for p in photos}
    out = []
    for name, entry in content.items():
        names, seconds = _entry(name, entry)
        members = [_listed_photo(folder, name, n) for n in names]
        base = stems.get(name)
        if base is None and given:
            continue
        if base is None or base not in members:
            base = members[len(members) // 2]
        order = [base, *(m for m in members if m != base)]
        stated = [seconds[members.index(m)] for m in order] if seconds else []
        out.append((name, base, order[1:], stated))
    return out


def _entry(name: str, entry: Any) -> tuple[list[str], list[float]]:
    """Names and exposure times of one view of brackets.json."""
    shown = f"{LIST}, {printable(name)[:60]}"
    photos, seconds = (entry.get("photos"), entry.get("seconds", [])) if isinstance(entry, dict) else (entry, [])
    if not isinstance(photos, list) or not photos or not all(isinstance(p, str) for p in photos):
        raise _nothing(shown, printable(str(entry))[:80], "a list of file names")
    if len(set(photos)) < len(photos):
        raise _nothing(shown, "a name that stands there twice", "different photos")
    good = isinstance(seconds, list) and all(type(s) in (int, float) and 1e-9 < s < 1e9 for s in seconds)
    if not good or len(seconds) not in (0, len(photos)):
        raise _nothing(shown, printable(str(seconds))[:80], "one positive number of seconds for each photo")
    return photos, [float(s) for s in seconds]


def _listed_photo(folder: Path, view: str, name: str) -> Path:
    parts = Path(name.replace("\\", "/")).parts
    path = folder.joinpath(*parts)
    if not parts or ".." in parts or Path(name).is_absolute() or len(name) > 200 or not path.is_file():
        raise _nothing(f"{LIST}, {printable(view)[:60]}", printable(name)[:80], "a file in the capture's folder")
    return path


def _nothing(where: str, value: str, limit: str) -> StageError:
    return StageError("exposure brackets can't be read", where=where, value=value, limit=limit,
                      remedy="correct it, or remove it: photos are then taken one by one")  # fmt: skip


def _pairs(
    folder: Path, photos: list[Path], listed: Listed, *, given: bool
) -> tuple[list[tuple[Path, Path | None]], list[Path]]:
    """The cross-polarised photos with their parallel ones, and parallel ones that are alone; nothing of a capture that
    is not polarised."""
    around = {p for f in {q.parent for q in photos} for p in listed(f)} if given else set(photos)
    halves = {(p.parent, m["view"].lower()): p for p in around if (m := _PARALLEL.fullmatch(p.stem))}
    crossed = {p: halves.get((p.parent, m["view"].lower())) for p in photos if (m := _CROSS.fullmatch(p.stem))}
    by_suffix = any(crossed.values()) or (not given and any(_LONG.fullmatch(p.stem) for p in photos))
    beside = folder / PARALLEL
    if by_suffix:
        pairs = [(p, crossed.get(p)) for p in photos if p not in set(halves.values())]
        lonely = sorted({p for p in halves.values() if p in set(photos)} - {q for _, q in pairs if q is not None})
    elif beside.is_dir() or (photos and photos[0].parent == folder / CROSS):
        of = {p.stem: p for p in (listed(beside) if beside.is_dir() else [])}
        pairs, lonely = [(p, of.get(p.stem)) for p in photos], []
        if not given:
            lonely = sorted(set(of.values()) - {q for _, q in pairs if q is not None})
    else:
        return [], []
    return pairs, lonely


def _all_paired(folder: Path, pairs: Sequence[tuple[Path, Path | None]], lonely: Sequence[Path]) -> None:
    alone = [c.name for c, p in pairs if p is None] + [f"{p.parent.name}/{p.name}" for p in lonely]
    if alone:
        some = some_of([printable(n) for n in alone], NAMED)
        raise StageError(
            "polarised photos do not pair",
            where=folder,
            value=f"{len(alone)} without the other half: {some}",
            limit="a cross- and a parallel-polarised photo of every view",
            remedy="add the missing photos, or move single ones out of the folder; names are a_cross and a_parallel, "
            "or alike in cross/ and parallel/",
        )
