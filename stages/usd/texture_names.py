"""Names of the files in textures/: a pattern that the user may choose, and where an asset keeps its own.

A pattern has the words {asset}, {map} and {udim}. Where there is one tile, {udim} and the separator before it (. _ -)
are left out. An asset with another pattern than DEFAULT has it in internal/names.json, so that readers find its maps;
names in internal/ are always DEFAULT.
"""

from __future__ import annotations

import json
import re
from pathlib import Path

from pipeline.errors import StageError, UsageError

DEFAULT = "{asset}_{map}.{udim}"
NAMES = "internal/names.json"
WORDS = ("asset", "map", "udim")
LITERAL = re.compile(r"[A-Za-z0-9_.-]*")
LONGEST = 100


def check_pattern(pattern: str) -> str:
    """Return the pattern, or raise UsageError if it gives no names, or the same one to two files of an asset."""
    parts = re.split(r"\{(\w*)\}", pattern)
    literal, words = "".join(parts[::2]), parts[1::2]
    known = set(words) <= set(WORDS) and len(set(words)) == len(words) and {"map", "udim"} <= set(words)
    if known and LITERAL.fullmatch(literal) and pattern[:1] not in (".", "-", "") and len(pattern) <= LONGEST:
        return pattern
    raise UsageError(
        "the pattern of the textures' names is not valid",
        where="usd.texture_name",
        value=repr(pattern),
        limit="{map} and {udim} once each, {asset} at most once, between them letters, digits, _ . or -; not starting "
        f"with . or -; at most {LONGEST} characters; without {{map}} or {{udim}} two files would have one name",
        remedy=f"use for example {DEFAULT} or {{asset}}-{{map}}_{{udim}}",
    )


def texture_name(pattern: str, asset: str, which: str, udim: str = "") -> str:
    """The name of a file without its ending. udim: "1001", "<UDIM>", or "" where there is one tile."""
    if not udim:
        pattern = re.sub(r"[._-]?\{udim\}", "", pattern)
    return pattern.format(asset=asset, map=which, udim=udim).lstrip(".-")


def check_apart(pattern: str, assets: tuple[str, ...]) -> None:
    """Raise StageError if maps of two meshes of one asset, with these names, would have one name."""
    if len({texture_name(pattern, a, "albedo", "1001") for a in assets}) < len(assets):
        raise StageError(
            "two textures of the asset would have the same name",
            where="usd.texture_name",
            value=f"{pattern!r} for the maps of {' and '.join(assets)}",
            limit="{asset} in the pattern where the asset has two meshes with maps (uv.mesh=both)",
            remedy=f"add {{asset}}, for example {DEFAULT}",
        )


def keep_pattern(asset: Path, pattern: str) -> list[Path]:
    """Write the pattern into an asset's folder, if it is not DEFAULT; the written files."""
    if pattern == DEFAULT:
        return []
    path = asset / NAMES
    path.parent.mkdir(parents=True, exist_ok=True)
    path.write_text(json.dumps({"texture_name": pattern}) + "\n")
    return [path]


def pattern_of(asset: Path) -> str:
    """The pattern of a written asset. StageError if its file says nothing valid."""
    path = asset / NAMES
    if not path.is_file():
        return DEFAULT
    try:
        return check_pattern(str(json.loads(path.read_text())["texture_name"]))
    except (OSError, ValueError, KeyError, TypeError, UsageError) as e:
        raise StageError(
            "the names of the asset's textures can't be read",
            where=NAMES,
            value=str(e)[:200],
            limit='{"texture_name": a pattern of usd.texture_name}',
            remedy="keep the asset's folder as it was written, or run the usd stage again",
        ) from e
