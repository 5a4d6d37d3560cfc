"""Which files of OUT are ours: the ones that runs published there, each with its hash. All others are the user's.

OUT/.published.json lists them. It is written before a folder is replaced and names both the old files and the new ones
until the run has published all, so that a process killed in between leaves nothing of ours that looks like the user's.
"""

from __future__ import annotations

import glob
import json
import re
import uuid
from collections.abc import Iterable, Iterator, Mapping
from contextlib import contextmanager, suppress
from pathlib import Path

from pipeline.artifacts import sha256_of
from pipeline.store import MANIFEST, read_object, write_synced
from workflows.run.report_timing import report_hash

LIST = ".published.json"
FOLDERS = ("asset", "report", "reflectance")
TRUTH = "truth"  # folder, and .json: of the demo, its result against the truth
_PARTIAL = re.compile(r"\.partial-[0-9a-f]{8}$")
Known = dict[str, frozenset[str]]  # path below OUT -> sha256 of each content that was published there


def published(out: Path) -> Known:
    """What runs published in `out`. Without a list (of an older version), what run.json names and the store has."""
    return listed(out) if isinstance(read_object(out / LIST).get("files"), dict) else _of_an_older_run(out)


def listed(folder: Path) -> Known:
    """What the list in a folder names; nothing where there is none."""
    found = read_object(folder / LIST).get("files")
    files = found if isinstance(found, dict) else {}
    return {path: frozenset(map(str, hashes)) for path, hashes in files.items() if isinstance(hashes, list)}


def note_published(out: Path, files: Mapping[str, Iterable[str]]) -> None:
    """Write the list."""
    write_whole(out / LIST, json.dumps({"files": {path: sorted(files[path]) for path in sorted(files)}}, indent=1))


def write_whole(path: Path, text: str) -> None:
    """Write a file of ours that is never seen half-written."""
    with written_whole(path, text.encode()) as partial:
        partial.replace(path)


@contextmanager
def written_whole(path: Path, data: bytes) -> Iterator[Path]:
    """A hidden file beside `path` with this content, flushed to the disk, that the caller gives its final name.

    It removes what a killed process left of an earlier attempt.
    """
    for left in path.parent.glob(f".{glob.escape(path.name)}.partial-*"):
        if _PARTIAL.search(left.name) and left.is_file():
            left.unlink(missing_ok=True)
    partial = path.with_name(f".{path.name}.partial-{uuid.uuid4().hex[:8]}")
    try:
        write_synced(partial, data, new=True)
        yield partial
    finally:
        partial.unlink(missing_ok=True)


def is_ours(path: Path, hashes: Iterable[str]) -> bool:
    """Whether a file is as a run published it. A link, or one that can't be read, is not."""
    known = frozenset(hashes)
    if not known or path.is_symlink() or not path.is_file():
        return False
    try:
        return sha256_of(path) in known
    except OSError:
        return False


def is_record(path: Path) -> bool:
    """Whether a file is a run.json, whoever wrote it: older versions did not list theirs."""
    return not path.is_symlink() and {"request", "stages", "timing", "store"} <= read_object(path).keys()


def entries(folder: Path) -> Iterator[str]:
    """All files, links and empty folders below `folder`, as paths relative to it. Links are not followed."""
    if not folder.is_dir() or folder.is_symlink():
        return
    for entry in sorted(folder.iterdir()):
        if entry.is_dir() and not entry.is_symlink() and any(entry.iterdir()):
            yield from (f"{entry.name}/{below}" for below in entries(entry))
        else:
            yield entry.name


def split(out: Path, name: str, known: Known) -> tuple[list[str], list[str]]:
    """What lies in the folder OUT/NAME: (our files, the user's), relative to it."""
    ours: list[str] = []
    users: list[str] = []
    for path in entries(out / name):
        mine = is_ours(out / name / path, known.get(f"{name}/{path}", ()))
        (ours if mine else users).append(path)
    return ours, users


# ------------------------------------------------------------------ before there was a list
def _of_an_older_run(out: Path) -> Known:
    """From run.json and the manifests in its store. Files in neither are taken for the user's and kept."""
    record = read_object(out / "run.json")
    stages, timing = record.get("stages"), record.get("timing")
    if not isinstance(stages, dict) or not isinstance(timing, dict):
        return {}
    found: Known = {}
    for stage in ("usd", "inverse_rendering", "report"):
        key = stages.get(stage, {}).get("key")
        if key:
            folder = Path(str(record.get("store", ""))) / stage / str(key)
            with suppress(OSError, ValueError, TypeError, KeyError, AttributeError):  # a manifest of another shape
                found |= {p: frozenset({h}) for p, h in _published_of(stage, folder, timing)}
    return found


def _published_of(stage: str, folder: Path, timing: Mapping[str, float]) -> Iterator[tuple[str, str]]:
    manifest = read_object(folder / MANIFEST)
    files = [f for f in manifest.get("files", ()) if isinstance(f, dict) and {"path", "sha256"} <= f.keys()]
    if stage == "usd":
        top = str(manifest.get("root", "")).rpartition("/")[0]
        inside = f"{top}/" if top else ""
        yield from ((f"asset/{f['path'].removeprefix(inside)}", f["sha256"]) for f in files)
    if stage == "report":
        for f in files:
            if (folder / f["path"]).is_file():
                yield f"report/{f['path']}", report_hash(folder, f["path"], timing)
    views = {"inverse_rendering": ("held_out", "views"), "usd": ("views", "asset_views")}
    field, below = views.get(stage, ("", ""))
    for view in manifest.get(field, ()):
        for kind in ("exr", "png"):
            yield f"report/{below}/{view['index']}.{kind}", view[kind]["sha256"]
