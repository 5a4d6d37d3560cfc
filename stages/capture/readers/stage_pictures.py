"""Where a light stage keeps its pictures, if not in full_on/, olat/ and tracking/: patterns in lights.json.

    "pictures": {"single": "light_{light}/cam{camera}.exr", "full_on": "all/cam{camera}.exr",
                 "tracking": "track/{frame}/cam{camera}.exr", "cameras": {"left": 0, "right": 1}}

`{camera}` is a number, or a name that `cameras` gives a number; `{light}` the index of a light; `{frame}` the number of
a picture in time, from which the light follows in `single`. A number may have leading zeros. Everything else is as it
stands in the path.
"""

from __future__ import annotations

import re
from collections.abc import Mapping
from dataclasses import dataclass
from glob import escape
from pathlib import Path
from typing import Any

from stages.capture.readers.described import PHOTO_SUFFIXES, natural_key
from stages.capture.readers.values import DIGITS, fault, shown

FIELDS = {"single": ("camera", "light or frame"), "full_on": ("camera",), "tracking": ("camera", "frame")}
KEYS = {"single": "olat", "full_on": "full_on", "tracking": "tracking"}  # names of the patterns in olat.py
FIELD = re.compile(r"\{(\w*)\}")
REMEDY = 'for example "single": "light_{light}/cam{camera}.exr", "full_on": "all/cam{camera}.exr"'


@dataclass(frozen=True, slots=True)
class Pattern:
    """Paths of pictures below the capture. text: as given; cameras: numbers of named cameras; by_light: whether the
    second number is a light's index (else a frame's, or there is none)."""

    text: str
    cameras: Mapping[str, int]
    by_light: bool

    def matches(self, folder: Path, doubled: list[str]) -> dict[tuple[int, int], Path]:
        """(camera, light or frame or 0) -> file. Of two files for one picture none is taken; `doubled` names them."""
        whole = re.compile(self._regular())
        found: dict[tuple[int, int], list[Path]] = {}
        places = "*".join(escape(part) for part in FIELD.split(self.text)[::2])
        for path in sorted(folder.glob(places), key=lambda p: natural_key(str(p))):
            match = whole.fullmatch(path.relative_to(folder).as_posix())
            camera = self._camera(match["camera"]) if match else None
            if match is None or camera is None or path.suffix.lower() not in PHOTO_SUFFIXES or not path.is_file():
                continue
            parts = match.groupdict()
            key = camera, int(parts.get("light") or parts.get("frame") or 0)
            found.setdefault(key, []).append(path)
        doubled += [
            " and ".join(p.relative_to(folder).as_posix() for p in files) for files in found.values() if len(files) > 1
        ]
        return {key: files[0] for key, files in found.items() if len(files) == 1}

    def _camera(self, name: str) -> int | None:
        return self.cameras.get(name) if self.cameras else int(name) if _is_number(name) else None

    def _regular(self) -> str:
        out, at, seen = "", 0, set[str]()
        for field in FIELD.finditer(self.text):
            name = field[1]
            any_of = r"[^/]+?" if name == "camera" and self.cameras else rf"[0-9]{{1,{DIGITS}}}"
            out += re.escape(self.text[at : field.start()]) + (
                f"(?P={name})" if name in seen else f"(?P<{name}>{any_of})"
            )
            seen.add(name)
            at = field.end()
        return out + re.escape(self.text[at:])


def read_patterns(given: Any, where: str) -> dict[str, Pattern]:
    """The patterns by the names of olat.py's folders.

    Raises:
        StageError: `single` or `full_on` is missing, or a pattern is not one of a path below the capture.
    """
    if not isinstance(given, dict) or not all(isinstance(given.get(k), str) for k in ("single", "full_on")):
        raise fault("the places of a light stage's pictures are not told", where, shown(given),
                    "patterns single and full_on", REMEDY)  # fmt: skip
    cameras = given.get("cameras", {})
    numbers = list(cameras.values()) if isinstance(cameras, dict) else [None]
    if any(not isinstance(n, int) or isinstance(n, bool) or n < 0 for n in numbers) or len(set(numbers)) < len(numbers):
        raise fault("the names of a light stage's cameras have no numbers", f"{where}, cameras", shown(cameras),
                    "a different camera's number of params.json for each name", REMEDY)  # fmt: skip
    return {
        KEYS[name]: Pattern(given[name], cameras, "{light}" in given[name])
        for name in FIELDS
        if name in given and _is_pattern(name, given[name], f"{where}, {name}")
    }


def _is_pattern(name: str, text: Any, where: str) -> bool:
    fields = [m[1] for m in FIELD.finditer(text)] if isinstance(text, str) else []
    needed = [set(f.split(" or ")) for f in FIELDS[name]]
    known = set().union(*needed)
    right = all(len(n & set(fields)) == 1 for n in needed) and set(fields) <= known
    inside = isinstance(text, str) and not text.startswith("/") and ".." not in text.split("/") and "*" not in text
    if not right or not inside:
        limit = "a path below the capture with " + " and ".join("{" + f + "}" for f in FIELDS[name])
        raise fault("a pattern of a light stage's pictures can't be used", where, shown(text), limit, REMEDY)
    return True


def _is_number(text: str) -> bool:
    return text.isascii() and text.isdecimal() and len(text) <= DIGITS
