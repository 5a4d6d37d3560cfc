"""Reads a template's mesh from an OBJ file: quads with texture coordinates in named groups."""

from __future__ import annotations

from dataclasses import dataclass
from pathlib import Path

import numpy as np

from pipeline.meshes import F64, Indices
from pipeline.template.files import MAX_FILE, limited, refuse

NO_GROUP = "default"


@dataclass(frozen=True, slots=True)
class ObjMesh:
    """vertices (V, 3); quads (Q, 4); uvs (U, 2); uv_quads (Q, 4); group (Q,) index into groups."""

    vertices: F64
    quads: Indices
    uvs: F64
    uv_quads: Indices
    group: Indices
    groups: tuple[str, ...]


def read_obj(path: Path) -> ObjMesh:
    """A mesh of quads; `g` and `o` lines name groups. StageError says which line is at fault."""
    vertices: list[list[float]] = []
    uvs: list[list[float]] = []
    corners: list[list[int]] = []
    group: list[int] = []
    groups: dict[str, int] = {}
    name = NO_GROUP
    with limited(path, MAX_FILE).open(encoding="utf-8", errors="replace") as file:
        for number, line in enumerate(file, 1):
            words = line.split()
            try:
                if not words:
                    continue
                if words[0] == "v":
                    vertices.append([float(x) for x in words[1:4]])
                elif words[0] == "vt":
                    uvs.append([float(x) for x in words[1:3]])
                elif words[0] in ("g", "o"):
                    name = words[1] if len(words) > 1 else NO_GROUP
                elif words[0] == "f":
                    corners.append(_face(words[1:], len(vertices), len(uvs), f"{path}, line {number}"))
                    group.append(groups.setdefault(name, len(groups)))
            except (ValueError, IndexError, OverflowError):
                refuse(
                    "a line of a template's OBJ file can't be read", f"{path}, line {number}", line.strip()[:80],
                    "v x y z, vt u v, and f with four v/vt", "export the mesh again, with texture coordinates",
                )  # fmt: skip
    try:
        found = np.array(vertices, np.float64).reshape(-1, 3), np.array(uvs, np.float64).reshape(-1, 2)
    except ValueError:
        refuse(
            "a template's OBJ file has vertices with too few numbers", path, "fewer than three, or two for vt",
            "v x y z and vt u v", "export the mesh again",
        )  # fmt: skip
    both = np.array(corners, np.int64).reshape(-1, 8)
    return ObjMesh(found[0], both[:, :4], found[1], both[:, 4:], np.array(group, np.int64), tuple(groups))


def _face(words: list[str], vertices: int, uvs: int, where: str) -> list[int]:
    """Four vertices, then four texture vertices, counted from 0; negative numbers count from the last."""
    if len(words) != 4:
        refuse(
            "a template must be all quads", where, f"a face of {len(words)} corners", "4 corners",
            "convert the mesh to quads before it becomes a template",
        )  # fmt: skip
    both = [word.split("/") for word in words]
    v, t = ([int(np.int64(int(word[k]))) for word in both] for k in (0, 1))  # OverflowError: no index is so large
    return [i - 1 if i > 0 else vertices + i for i in v] + [i - 1 if i > 0 else uvs + i for i in t]
