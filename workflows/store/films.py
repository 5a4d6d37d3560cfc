"""Which results of a store are of one video: other people's videos may lie beside it in its folder.

The lineage names the video's file. That of older versions named its folder, which does not say whose results they are.
"""

from __future__ import annotations

from collections.abc import Collection, Iterator, Mapping
from pathlib import Path

from pipeline.store import LINEAGE, MANIFEST, Store, lineage, read_object
from stages.capture.scan import FILM_SUFFIXES
from stages.registry import ALSO, SOURCE
from workflows.store.roots import Root

Known = Mapping[Path, set[str]]  # file of a key's lineage -> everything that the key was made from


def is_film(path: Path | str) -> bool:
    """Whether a path is that of a video."""
    return Path(path).suffix.lower() in FILM_SUFFIXES and not Path(path).is_dir()


def photos_of(root: Root, store: Store) -> Iterator[Path]:
    """What a run's first stages read, also of its second capture, which shows the same person: folders, or videos. The
    lineage has whole paths; those in run.json may be relative to an unknown folder."""
    for stage, key in root.keys.items():
        origins = lineage(store.root / LINEAGE / f"{stage}-{key}.json")
        for name in (SOURCE, ALSO + SOURCE):
            film = name == SOURCE and is_film(root.capture)
            for path in map(Path, origins.get(name, ())):
                if is_film(path) or not (film or _holds_a_film(store, stage, key)):
                    yield path
                elif film:
                    yield path / Path(root.capture).name


def _holds_a_film(store: Store, stage: str, key: str) -> bool:
    """Whether a finished capture is of a video."""
    return read_object(store.folder(stage, key) / MANIFEST).get("kind") == "video"


def films_in(folders: Collection[Path], known: Known) -> Iterator[Path]:
    """The video of each captured folder that has one: now, or else when it was read. Of several none is meant."""
    named = {Path(o) for origins in known.values() for o in origins if is_film(o)}
    for folder in (f for f in folders if f.is_absolute() and not is_film(f)):
        there = {p for p in folder.iterdir() if is_film(p)} if folder.is_dir() else set[Path]()
        once = there or {p for p in named if p.parent == folder}
        if len(once) == 1:
            yield from once


def is_made_from(origins: set[str], reached: set[str], store: Store, stage: str, key: str) -> bool:
    """Whether a key comes from anything that was reached. The folder of a video is not enough: see above."""
    hits = origins & reached
    folders = {h for h in hits if Path(h).is_absolute() and not is_film(h)}
    return bool(hits - folders) or (bool(folders) and not _holds_a_film(store, stage, key))


def of_older_versions(photos: Collection[Path], known: Known) -> Iterator[Path]:
    """Files of the lineage that name only the folder in which a video of `photos` lies."""
    folders = {str(p.parent) for p in photos if is_film(p)} | {str(p) for p in photos}
    yield from (p for p, origins in known.items() if origins & folders and not any(map(is_film, origins)))
