"""Who may use a Prefect server that `neuface serve` starts, and what its runs may touch.

Whoever reaches the API of a server starts runs on its workers. So it asks for a login, answers no page of another
origin, wants a token against forged requests, and the folders that a run names lie below folders that the worker's
owner chose. A foreign page that reaches the port under a name of its own (DNS rebinding) does not know the login.
"""

from __future__ import annotations

import os
import secrets
from collections.abc import Iterable, Mapping
from pathlib import Path
from typing import Any

from pipeline.errors import UsageError
from stages.presets import parse_sets

ROOTS = "NEUFACE_ROOTS"  # folders below which runs from a server may read and write, like PATH
SERVER_LOGIN, CLIENT_LOGIN = "PREFECT_SERVER_API_AUTH_STRING", "PREFECT_API_AUTH_STRING"
ORIGINS, CSRF = "PREFECT_SERVER_CORS_ALLOWED_ORIGINS", "PREFECT_SERVER_CSRF_PROTECTION_ENABLED"
FILE_SETTINGS = {
    "masks": ("model", "hair_model"),
    "inverse_rendering": ("prior_file", "light_file"),
    "reflectance": ("paint",),
    "template": ("folder",),
    "usd": ("measured",),
}  # settings that name a file or a folder


# ------------------------------------------------------------------ the server
def login_file(home: Path) -> Path:
    """File with the login of a server, readable only by its owner."""
    return home / "login"


def lock_server(home: Path, addresses: Iterable[str]) -> Path | None:
    """Set the environment so that a server and its clients use a login. Returns its file; None: the user set one.

    addresses: of the server's own page, such as http://127.0.0.1:4200.
    """
    os.environ.setdefault(ORIGINS, ",".join(addresses))
    os.environ.setdefault(CSRF, "true")
    given = os.environ.get(SERVER_LOGIN)
    if given:
        os.environ.setdefault(CLIENT_LOGIN, given)
        return None
    path = login_file(home)
    os.environ[SERVER_LOGIN] = os.environ[CLIENT_LOGIN] = _login(path)
    return path


def _login(path: Path) -> str:
    """The login in `path`, made if there is none: USER:PASSWORD."""
    try:
        descriptor = os.open(path, os.O_WRONLY | os.O_CREAT | os.O_EXCL, 0o600)
    except FileExistsError:
        path.chmod(0o600)
        known = path.read_text().strip()
        if known:
            return known
        descriptor = os.open(path, os.O_WRONLY | os.O_TRUNC)
    made = f"neuface:{secrets.token_urlsafe(24)}"
    with os.fdopen(descriptor, "w") as f:
        f.write(f"{made}\n")
    return made


# ------------------------------------------------------------------ its runs
def set_roots(folders: Iterable[str]) -> None:
    """Let runs from the server touch these folders; none named: $NEUFACE_ROOTS, else the current folder."""
    named = [str(Path(f).expanduser().resolve()) for f in folders]
    if named or not os.environ.get(ROOTS):
        os.environ[ROOTS] = os.pathsep.join(named or [str(Path.cwd())])


def check_folders(asked: Mapping[str, Any]) -> None:
    """See that every folder and file that a run from a server names lies below one of $NEUFACE_ROOTS.

    Raises:
        UsageError: one does not, or no folders were allowed.
    """
    roots = [Path(r).resolve() for r in os.environ.get(ROOTS, "").split(os.pathsep) if r]
    for name, text in named_paths(asked):
        path = Path(text).resolve()  # links are followed: one that leads out is out
        if not any(path.is_relative_to(r) for r in roots):
            raise UsageError(
                "a run from a server may not use this path",
                where=name,
                value=text,
                limit=f"a path below {os.pathsep.join(map(str, roots)) or 'a folder in $' + ROOTS}",
                remedy=f"choose another, or allow it: {ROOTS}=FOLDER:FOLDER in the worker's environment, or "
                "neuface serve --root FOLDER",
            )


def named_paths(asked: Mapping[str, Any]) -> Iterable[tuple[str, str]]:
    """Every folder and file that a request names, after the name of its option or setting."""
    for name in ("capture", "root", "out", "store", "template", "light", "also"):
        if asked.get(name):
            yield name, str(asked[name])
    tables = (asked.get("config") or {}, parse_sets(tuple(asked.get("sets") or ())))
    for stage, settings in FILE_SETTINGS.items():
        for table in tables:
            for setting in settings:
                value = table.get(stage, {}).get(setting)
                if value:
                    yield f"{stage}.{setting}", str(value)
