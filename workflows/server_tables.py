"""An empty database of Prefect's throw-away server, kept for the next run on this machine.

Prefect makes its tables one change of its history after the other: eight seconds of every run that begins with an empty
home. A copy taken when the server is up, and nothing has run on it yet, is where the next one begins. It lies in the
user's cache folder and is named after Prefect's version; whoever deletes it waits those seconds once more.
"""

from __future__ import annotations

import os
import shutil
import sqlite3
from contextlib import closing, suppress
from importlib.metadata import version
from pathlib import Path

DATABASE = "prefect.db"  # in the server's home


def template() -> Path:
    """Where the empty database is kept."""
    cache = os.environ.get("XDG_CACHE_HOME") or str(Path("~/.cache").expanduser())
    return Path(cache) / "neuface-asset" / f"prefect-{version('prefect')}.db"


def begin(home: Path) -> None:
    """Give a home without a database the empty one, if there is one."""
    if (home / DATABASE).exists():
        return
    partial = home / f"{DATABASE}.partial"
    with suppress(OSError):
        shutil.copyfile(template(), partial)
        partial.rename(home / DATABASE)


def keep(home: Path) -> None:
    """Keep a copy of a database on which nothing has run, if there is none yet. Call before a flow begins."""
    kept = template()
    if kept.is_file() or not (home / DATABASE).is_file():
        return
    partial = kept.with_name(f"{kept.name}.{os.getpid()}")
    with suppress(OSError, sqlite3.Error):
        kept.parent.mkdir(parents=True, exist_ok=True)
        with closing(sqlite3.connect(home / DATABASE)) as source, closing(sqlite3.connect(partial)) as target:
            if source.execute("SELECT count(*) FROM flow_run").fetchone()[0] == 0:
                source.backup(target)
                target.execute("PRAGMA journal_mode = DELETE")  # one file, without a log beside it
                target.close()
                partial.rename(kept)
    with suppress(OSError):
        partial.unlink(missing_ok=True)
