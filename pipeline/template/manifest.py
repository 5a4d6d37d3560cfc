"""The manifest of a template: what its folder holds, checked key by key (docs/template.md).

Only the words are checked here, and that numbers are numbers; pipeline.template.checks compares them with the mesh.
"""

from __future__ import annotations

import math
from collections.abc import Callable, Mapping
from dataclasses import dataclass
from pathlib import Path
from typing import Any, TypeVar

from pipeline.template.files import MANIFEST, read_json, refuse

FORMAT, VERSION = "neuface-template", 1
MAX_NAMES, MAX_LANDMARKS, MIN_LANDMARKS = 4096, 468, 12  # fewer can't place a head
REMEDY = "correct manifest.json; docs/template.md has an example"
T = TypeVar("T")


@dataclass(frozen=True, slots=True)
class Landmark:
    """One landmark: its number among the face network's, three vertices and their weights."""

    name: str
    network: int
    corners: tuple[int, ...]
    weights: tuple[float, ...]


@dataclass(frozen=True, slots=True)
class Manifest:
    """mesh and arrays: file names; parts and regions: name -> groups of the mesh; groups: their names where the mesh is
    an npz; joints: names; metres: of one unit of length."""

    path: Path
    name: str
    licence: str
    licence_file: str
    mesh: str
    arrays: str | None
    metres: float
    groups: tuple[str, ...]
    parts: Mapping[str, tuple[str, ...]]
    regions: Mapping[str, tuple[str, ...]]
    landmarks: tuple[Landmark, ...]
    joints: tuple[str, ...]
    expressions: tuple[str, ...]


def read_manifest(folder: Path) -> Manifest:
    """The checked manifest of a template's folder."""
    path = folder / MANIFEST
    if path.is_symlink() or not path.is_file():
        refuse(
            "a template has no manifest", path, "a link" if path.is_symlink() else "no such file",
            f"a folder with {MANIFEST}", "give the folder that holds the template",
        )  # fmt: skip
    found = _Keys(path, read_json(path))
    if found.data.get("format") != FORMAT or found.data.get("version") != VERSION:
        refuse(
            "a template's manifest has another format", path,
            f"format {found.data.get('format')!r}, version {found.data.get('version')!r}",
            f"format {FORMAT!r}, version {VERSION}", REMEDY,
        )  # fmt: skip
    return Manifest(
        path=path,
        name=found.get("name", _text),
        licence=found.get("licence", _text),
        licence_file=found.get("licence_file", _text),
        mesh=found.get("mesh", _text),
        arrays=found.get("arrays", _text, None),
        metres=found.get("metres_per_unit", _positive),
        groups=found.get("groups", _names, ()),
        parts=found.get("parts", _named_groups),
        regions=found.get("regions", _named_groups),
        landmarks=_landmarks(found),
        joints=found.get("joints", _names, ()),
        expressions=found.get("expressions", _names, ()),
    )


@dataclass(frozen=True, slots=True)
class _Keys:
    path: Path
    data: dict[str, Any]

    def get(self, key: str, check: Callable[[Any], T], *default: Any) -> T:
        """The checked value of a key; `check` raises ValueError with what would be right."""
        if key not in self.data:
            if default:
                missing: T = default[0]
                return missing
            refuse("a key of a template's manifest is missing", self.path, key, "all keys", REMEDY)
        try:
            return check(self.data[key])
        except (ValueError, TypeError, AttributeError, KeyError, OverflowError) as error:
            refuse("a value of a template's manifest is wrong", f"{self.path}: {key}", repr(self.data[key])[:200],
                   error, REMEDY)  # fmt: skip


def _text(value: Any) -> str:
    if not isinstance(value, str) or not 0 < len(value) <= 200 or not value.isprintable():
        raise ValueError("a text of 1 to 200 printable letters")
    return value


def _positive(value: Any) -> float:
    if isinstance(value, bool) or not isinstance(value, int | float) or not 1e-6 <= value <= 1e6:
        raise ValueError("a number from 1e-6 to 1e6")
    return float(value)


def _names(value: Any) -> tuple[str, ...]:
    if not isinstance(value, list) or len(value) > MAX_NAMES or len({str(v) for v in value}) != len(value):
        raise ValueError(f"a list of at most {MAX_NAMES} different names")
    return tuple(_text(v) for v in value)


def _named_groups(value: Any) -> dict[str, tuple[str, ...]]:
    if not isinstance(value, dict) or not 0 < len(value) <= MAX_NAMES:
        raise ValueError("an object: name -> list of groups")
    return {_text(k): _names(v) for k, v in value.items()}


def _landmarks(found: _Keys) -> tuple[Landmark, ...]:
    many = found.get("landmarks", _list)
    if not MIN_LANDMARKS <= len(many) <= MAX_LANDMARKS:
        refuse(
            "a template has too few or too many landmarks", f"{found.path}: landmarks", len(many),
            f"{MIN_LANDMARKS} to {MAX_LANDMARKS}", REMEDY,
        )  # fmt: skip
    out = tuple(_Keys(found.path, {f"landmarks[{i}]": v}).get(f"landmarks[{i}]", _landmark) for i, v in enumerate(many))
    for what, values in (("name", [x.name for x in out]), ("network number", [str(x.network) for x in out])):
        if len(set(values)) != len(values):
            twice = next(v for v in values if values.count(v) > 1)
            refuse(f"two landmarks have the same {what}", f"{found.path}: landmarks", twice, "each only once", REMEDY)
    return out


def _list(value: Any) -> list[Any]:
    if not isinstance(value, list):
        raise ValueError("a list")
    return value


def _landmark(value: Any) -> Landmark:
    network, corners, weights = value["network"], value["corners"], value["weights"]
    if not _whole(network) or not 0 <= network < MAX_LANDMARKS:
        raise ValueError(f"network: a number from 0 to {MAX_LANDMARKS - 1}")
    if not isinstance(corners, list) or len(corners) != 3 or not all(_whole(c) and abs(c) < 2**31 for c in corners):
        raise ValueError("corners: three vertices")
    good = isinstance(weights, list) and len(weights) == 3
    if not good or not all(isinstance(w, int | float) and not isinstance(w, bool) for w in weights):
        raise ValueError("weights: three numbers")
    if not all(math.isfinite(w) and -1e-6 <= w <= 1 + 1e-6 for w in weights) or abs(sum(weights) - 1) > 1e-4:
        raise ValueError("weights: from 0 to 1, of sum 1")
    return Landmark(_text(value["name"]), network, tuple(corners), tuple(float(w) for w in weights))


def _whole(value: Any) -> bool:
    return isinstance(value, int) and not isinstance(value, bool)
