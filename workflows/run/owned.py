"""Single files of ours in a folder of the user's, such as run.json, a batch's table, or rendered pictures.

A file is replaced only while it is as we wrote it (`published.py` has the list). Any other file, folder or link in its
place is the user's, and is renamed to NAME.yours-N first.
"""

from __future__ import annotations

import os
import uuid
from collections.abc import Callable
from pathlib import Path

from pipeline.artifacts import sha256_of
from workflows.run.output_dirs import make_folder
from workflows.run.published import is_ours, listed, note_published, written_whole
from workflows.run.replace import free_side


def write_owned(
    folder: Path, name: str, content: str | bytes, before_lists: Callable[[Path], bool] = lambda path: False
) -> str | None:
    """Write FOLDER/NAME as a whole. Returns the new name of a file of the user's that was there, None without one.

    name: a path below folder. before_lists: whether an unlisted file is of an older version, which kept no list.
    """
    target = folder / name
    make_folder(target.parent)
    data = content.encode() if isinstance(content, str) else content
    with written_whole(target, data) as partial:
        return put_owned(folder, name, partial, before_lists)


def put_owned(
    folder: Path, name: str, made: Path, before_lists: Callable[[Path], bool] = lambda path: False
) -> str | None:
    """As `write_owned`, with a finished file on the same disk, which gets the name."""
    target, digest, known = folder / name, sha256_of(made), listed(folder)
    hashes = known.get(name, frozenset()) | {digest}
    note_published(folder, {**known, name: hashes})  # both, so that a process killed in between loses track of neither
    aside = None
    if os.path.lexists(target) and not is_ours(target, hashes) and not (name not in known and before_lists(target)):
        aside = free_side(folder, name)
        target.rename(folder / aside)
    made.replace(target)
    note_published(folder, {**known, name: {digest}})
    return aside


def partial_name(folder: Path, name: str) -> Path:
    """A hidden name beside FOLDER/NAME with its suffix, for a file on its way there."""
    path = folder / name
    return path.with_name(f".{path.stem}.partial-{uuid.uuid4().hex[:8]}{path.suffix}")
