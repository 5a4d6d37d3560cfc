"""The folders that a run writes to: checked before any work, and left as they were if nothing came of it."""

from __future__ import annotations

import shutil
import uuid
from collections.abc import Iterator
from contextlib import contextmanager
from pathlib import Path

from pipeline.errors import StageError, UsageError, stage_error_from_os_error

OWN = (".locks", ".prefect", ".lineage", ".roots")  # in the store, but not results


@contextmanager
def writable(out: Path, store: Path) -> Iterator[None]:
    """Make both folders and see that files can be written there; on failure take away what holds no result.

    Raises:
        StageError: one of them is a file, or can't be written.
    """
    made = missing(out) + missing(store)
    try:
        for folder in (out, store):
            _probe(folder)
        yield
    except BaseException:
        sweep(made, store)
        raise


def missing(folder: Path) -> list[Path]:
    """The folder and its parents that are not there yet, the innermost first."""
    chain = [folder, *folder.parents]
    return [p for p in chain if not p.exists() and not p.is_symlink()]


def make_folder(folder: Path) -> None:
    """Make a folder for results, and those above it.

    Raises:
        StageError: a file is in its place. OSError: any other fault.
    """
    try:
        folder.mkdir(parents=True, exist_ok=True)
    except FileExistsError as e:
        raise StageError(
            "a file is where a folder is needed",
            where=folder,
            value="a file",
            limit="a folder, or nothing",
            remedy="remove that file or choose another folder",
        ) from e


def check_file(path: Path, option: str) -> None:
    """See, before any work, that a file which the user names can be there.

    Raises:
        UsageError: there is no such folder, or the name is that of a folder.
    """
    if path.is_dir() or not path.parent.is_dir():
        raise UsageError(
            "this file can't be written",
            where=f"{option} {path}",
            value="a folder" if path.is_dir() else f"no folder {path.parent}",
            limit="the name of a file in a folder that is there",
            remedy="name a file, and make its folder first",
        )


def _probe(folder: Path) -> None:
    try:
        make_folder(folder)
        probe = folder / f".probe-{uuid.uuid4().hex[:8]}"
        probe.write_bytes(b"x")
        probe.unlink()
    except OSError as e:
        known = stage_error_from_os_error(e, folder)
        raise known or StageError(
            "the folder can't be written",
            where=folder,
            value=e.strerror,
            limit="a folder that files can be made in",
            remedy="choose another with --out or --store",
        ) from e


def sweep(made: list[Path], store: Path) -> None:
    """Remove the folders that this run made, unless the store holds something finished or worth resuming."""
    if store.is_dir() and any(_results(store)):
        return
    if store in made and store.is_dir():  # what a store holds and no more: a file of the user's own keeps its folder
        for child in [c for c in store.iterdir() if c.is_dir() and not c.is_symlink()]:
            for left in [child] if child.name in OWN else child.glob("*.partial-*"):
                shutil.rmtree(left, ignore_errors=True)
        made = [*(c for c in store.iterdir() if c.is_dir()), store, *made]
    for folder in made:
        try:
            folder.rmdir()
        except OSError:
            continue  # gone already, or something else lies in it


def _results(store: Path) -> Iterator[Path]:
    for stage in store.iterdir():
        if stage.name not in OWN and stage.is_dir():
            yield from (p for p in stage.iterdir() if ".partial-" not in p.name)
