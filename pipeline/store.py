"""Content-addressed store of finished artifacts.

Layout: `<root>/<stage>/<key>/` is finished and contains `manifest.json`, the artifact's files and `run.json`;
`<key>.partial-*` is being written; `<key>.scratch/` contains checkpoints of unfinished work; `.locks/<stage>-<key>` is
locked while one process works on the key; `.lineage/<stage>-<key>.json` lists the inputs, so that all results of one
folder of photos can be found (docs/privacy.md). A partial folder becomes a finished one only by a rename, so that a
killed process never leaves an incomplete result that looks finished.
"""

from __future__ import annotations

import contextlib
import errno
import fcntl
import json
import logging
import os
import shutil
import uuid
from collections.abc import Iterator, Mapping
from contextlib import contextmanager
from pathlib import Path
from typing import Any, TypeVar

from pydantic import BaseModel, ValidationError

from pipeline.artifacts import Artifact, FileRef, Located, sha256_of
from pipeline.errors import stage_error_from_os_error

log = logging.getLogger(__name__)
A = TypeVar("A", bound=Artifact)
LINEAGE, LOCKS = ".lineage", ".locks"
MANIFEST, RUN = "manifest.json", "run.json"
MAX_BYTES = 1 << 28  # of a manifest: a larger file is not one
MAX_SECONDS = 1e9
LONGEST_PATH = 250  # bytes: the stages write names of a few dozen
MOST_FAULTS, LONGEST_WORDS = 1000, 300  # of a manifest, in a message


class Store:
    """Finished artifacts under `root`, found by stage name and content key."""

    def __init__(self, root: Path) -> None:
        self.root = root.absolute()  # stages join paths below it; a relative path would be joined twice

    # ---------------------------------------------------------------- where things are
    def folder(self, stage: str, key: str) -> Path:
        """Folder of the finished artifact; it may not exist yet."""
        return self.root / stage / key

    def scratch(self, stage: str, key: str) -> Path:
        """Folder of the checkpoints of unfinished work on this key."""
        return self.root / stage / f"{key}.scratch"

    # ---------------------------------------------------------------- reading
    def load(self, stage: str, key: str, kind: type[A]) -> Located[A] | None:
        """The finished artifact, or None. One that does not match its hashes is removed, with a warning."""
        folder = self.folder(stage, key)
        if not folder.is_dir():
            return None
        try:
            artifact = self.manifest(stage, key, kind)
        except (OSError, ValidationError) as e:
            self._discard(folder, f"the manifest can't be read: {_in_a_line(e)}")
            return None
        for ref in file_refs(artifact):
            fault = _fault(folder, ref)
            if fault:
                self._discard(folder, fault)
                return None
        with contextlib.suppress(OSError):  # time of last use, for the clean-up
            os.utime(folder)
        return Located(artifact, folder)

    def manifest(self, stage: str, key: str, kind: type[A]) -> A:
        """The manifest; its files are not checked. Raises OSError or ValidationError."""
        path = self.folder(stage, key) / MANIFEST
        if path.stat().st_size > MAX_BYTES:
            raise OSError(errno.EFBIG, f"more than {MAX_BYTES} bytes")
        return kind.model_validate_json(path.read_bytes())

    def load_run(self, stage: str, key: str) -> dict[str, object]:
        """`run.json` of a finished artifact: seconds, memory, versions. Empty if it is missing or damaged."""
        found = read_object(self.folder(stage, key) / RUN)
        seconds = found.get("seconds", 0.0)
        if isinstance(seconds, int | float) and 0 <= seconds < MAX_SECONDS:
            return found
        log.warning("%s/%s: run.json is damaged; the times of this stage are unknown", stage, key)
        return {}

    def _discard(self, folder: Path, fault: str) -> None:
        log.warning(
            "stored artifact %s/%s is damaged (%s) and will be computed again",
            folder.parent.name, folder.name, fault[: 3 * LONGEST_WORDS],
        )  # fmt: skip
        shutil.rmtree(folder)

    # ---------------------------------------------------------------- writing
    def trace(self, stage: str, key: str, folders: Mapping[str, Path]) -> None:
        """Record the inputs of a key: `stage/key` of other artifacts, absolute folders for the user's own files.

        The same photos may be in several folders; all of them are recorded. Call with the lock held.
        """
        path = self.root / LINEAGE / f"{stage}-{key}.json"
        known = lineage(path)
        merged = {n: sorted({*known.get(n, ()), self._name_of(f)}) for n, f in folders.items()}
        if merged != known:
            path.parent.mkdir(parents=True, exist_ok=True)
            partial = path.with_suffix(".partial")
            partial.write_text(json.dumps(merged))
            partial.replace(path)

    def _name_of(self, folder: Path) -> str:
        inside = folder.is_relative_to(self.root)
        return folder.relative_to(self.root).as_posix() if inside else str(folder.absolute())

    @contextmanager
    def lock(self, stage: str, key: str) -> Iterator[None]:
        """Lock one key. The kernel releases the lock when the process ends, however it ends."""
        folder = self.root / LOCKS
        try:
            folder.mkdir(parents=True, exist_ok=True)
            handle = (folder / f"{stage}-{key}").open("w")
        except OSError as e:
            raise stage_error_from_os_error(e, folder) or e from e
        try:
            fcntl.flock(handle, fcntl.LOCK_EX)
            yield
        finally:  # the file is kept: else a waiting process and a new one could hold two different locks
            handle.close()

    def begin(self, stage: str, key: str) -> Path:
        """Create an empty partial folder. Call with the lock held: it removes partial folders of dead processes."""
        for stale in (self.root / stage).glob(f"{key}.partial-*"):
            shutil.rmtree(stale)
        partial = self.root / stage / f"{key}.partial-{uuid.uuid4().hex[:8]}"
        partial.mkdir(parents=True)
        return partial

    def forget(self, stage: str, key: str) -> None:
        """Delete everything stored under a key, so that it is computed again."""
        with self.lock(stage, key):
            for folder in (self.folder(stage, key), self.scratch(stage, key)):
                if folder.is_dir():
                    shutil.rmtree(folder)

    def finish(self, stage: str, key: str, partial: Path, artifact: A, run: dict[str, object]) -> Located[A]:
        """Complete a partial folder: check that all files exist, flush them to disk, rename the folder. Files with the
        same bytes share their room."""
        first: dict[str, Path] = {}
        for ref in file_refs(artifact):
            fault = _fault(partial, ref)
            if fault:
                raise RuntimeError(f"stage {stage} returned a manifest that does not match its files: {fault}")
            sync(partial / ref.path)
            _share(first.setdefault(ref.sha256, partial / ref.path), partial / ref.path)
        write_synced(partial / MANIFEST, artifact.model_dump_json(indent=1))
        write_synced(partial / RUN, json.dumps(run, indent=1))
        sync(partial)
        final = self.folder(stage, key)
        partial.rename(final)
        sync(final.parent)
        shutil.rmtree(self.scratch(stage, key), ignore_errors=True)
        return Located(artifact, final)


def link_or_copy(source: Path, target: Path) -> None:
    """A second name for a finished file of the store, which nobody writes to any more; a copy where that can't be."""
    try:
        os.link(source, target)
    except OSError as e:
        if e.errno in (errno.ENOSPC, errno.EDQUOT):
            raise
        shutil.copyfile(source, target)


def _share(first: Path, path: Path) -> None:
    """Make a file a second name of another one with the same bytes."""
    if first.samefile(path):
        return
    second = path.with_name(f"{path.name}.partial")
    link_or_copy(first, second)
    second.replace(path)


def lineage(path: Path) -> dict[str, list[str]]:
    """The inputs of a key; empty if unknown."""
    found = read_object(path)
    return {k: v for k, v in found.items() if isinstance(v, list) and all(isinstance(x, str) for x in v)}


def read_object(path: Path) -> dict[str, Any]:
    """The JSON object in a file; empty if the file is missing, damaged, too large or holds something else."""
    try:
        found = json.loads(path.read_bytes()) if path.stat().st_size <= MAX_BYTES else {}
    except (OSError, ValueError, RecursionError):
        return {}
    return found if isinstance(found, dict) else {}


def file_refs(model: BaseModel) -> Iterator[FileRef]:
    """Every FileRef inside a model, at any depth."""
    if isinstance(model, FileRef):
        yield model
        return
    for name in type(model).model_fields:
        yield from _refs_in(getattr(model, name))


def _refs_in(value: object) -> Iterator[FileRef]:
    if isinstance(value, BaseModel):
        yield from file_refs(value)
    elif isinstance(value, dict):
        for v in value.values():
            yield from _refs_in(v)
    elif isinstance(value, tuple):
        for v in value:
            yield from _refs_in(v)


def _in_a_line(e: OSError | ValidationError) -> str:
    """Why a manifest can't be read: of many faults the first, and their number; of very many the number alone."""
    if isinstance(e, OSError):
        return str(e)
    count = e.error_count()
    if count > MOST_FAULTS:
        return f"{count} faults"
    first = e.errors(include_url=False, include_context=False, include_input=False)[0]
    place = ".".join(map(str, first["loc"]))[:LONGEST_WORDS] or "the whole"
    return f"{place}: {first['msg'][:LONGEST_WORDS]}" + (f", and {count - 1} more" if count > 1 else "")


def _fault(folder: Path, ref: FileRef) -> str | None:
    path = folder / ref.path
    if len(os.fsencode(ref.path)) > LONGEST_PATH or not path.is_file():
        return f"{ref.path[:200]} is missing"
    size = path.stat().st_size
    if size != ref.size:
        return f"{ref.path} has {size} bytes, not {ref.size}"
    return None if sha256_of(path) == ref.sha256 else f"{ref.path} does not match its sha256"


def sync(path: Path) -> None:
    """Flush a file or folder to the disk, so that it is complete after a power failure."""
    handle = os.open(path, os.O_RDONLY)
    try:
        os.fsync(handle)
    finally:
        os.close(handle)


def write_synced(path: Path, data: str | bytes, *, new: bool = False) -> None:
    """Write a file and flush it to the disk. new: FileExistsError if it is there."""
    with path.open("xb" if new else "wb") as f:
        f.write(data.encode() if isinstance(data, str) else data)
        f.flush()
        os.fsync(f.fileno())
