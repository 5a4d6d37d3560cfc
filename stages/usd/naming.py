"""The asset's name. It names a prim and a file and is a prefix of textures, so it must be valid as all three."""

from __future__ import annotations

import re

from pipeline.errors import UsageError

IDENTIFIER = re.compile(r"[A-Za-z_][A-Za-z0-9_]*")
LONGEST = 64
RESERVED = ("payload", "lookdev", "environment", "light", "high")  # names of files beside the component


def check_name(name: str) -> str:
    """Return the name, or raise UsageError if it is not valid."""
    limit = (
        f"a letter or _, then letters, digits or _; at most {LONGEST} characters; not starting with "
        + " or ".join(RESERVED[:2])
        + f", not {' or '.join(RESERVED[2:])}"
    )
    taken = name.lower().startswith(RESERVED[:2]) or name.lower() in RESERVED
    if IDENTIFIER.fullmatch(name) and len(name) <= LONGEST and not taken:
        return name
    raise UsageError(
        "the asset's name is not valid in USD",
        where="usd.name (--name)",
        value=repr(name),
        limit=limit,
        remedy=f"use for example --name {name_from(name)}",
    )


def name_from(text: str) -> str:
    """A valid name similar to `text`, for example a folder's name."""
    out = re.sub(r"[^A-Za-z0-9_]+", "_", text).strip("_")[:LONGEST]
    out = out if re.match(r"[A-Za-z_]", out) else f"head_{out}".strip("_")
    return f"head_{out}"[:LONGEST] if out.lower().startswith(RESERVED[:2]) or out.lower() in RESERVED else out
