"""Reads MakeHuman's hm08 files: base mesh with groups, mirror table and targets.

Lengths are in the source's unit, decimetres; vertex numbers are those of base.obj.
"""

from __future__ import annotations

import gzip
import re
from dataclasses import dataclass
from pathlib import Path

import numpy as np

from pipeline.meshes import F64, Indices

TARGET_FOLDERS = (
    "head", "eyes", "mouth", "nose", "ears", "cheek", "chin", "forehead", "eyebrows", "neck", "asym",
)  # fmt: skip
MACRO = re.compile(r"(african|asian|caucasian)-(female|male)-(child|young|old)")
NO_SHAPE = re.compile(r"head-trans-|asymm-")  # moves the whole head, or the chest


@dataclass(frozen=True, slots=True)
class Source:
    """vertices (N, 3) decimetres; quads (F, 4); uvs (M, 2) base.obj's texture vertices; uv_quads (F, 4) into them;
    group (F,) name of each quad's group; mirror (N,) the vertex on the other side, itself in the middle."""

    folder: Path
    vertices: F64
    quads: Indices
    uvs: F64
    uv_quads: Indices
    group: np.ndarray
    mirror: Indices


def read_source(folder: Path) -> Source:
    """The base mesh of a folder with base.obj and hm08.mirror."""
    vertices, quads, uvs, uv_quads, groups, group = [], [], [], [], [], ""
    for line in (folder / "base.obj").read_text().splitlines():
        kind, *rest = line.split() or [""]
        if kind == "v":
            vertices.append([float(x) for x in rest[:3]])
        elif kind == "vt":
            uvs.append([float(x) for x in rest[:2]])
        elif kind == "g":
            group = rest[0]
        elif kind == "f":
            corners = [x.split("/") for x in rest]
            quads.append([int(c[0]) - 1 for c in corners])
            uv_quads.append([int(c[1]) - 1 for c in corners])
            groups.append(group)
    mirror = np.arange(len(vertices))
    for line in (folder / "hm08.mirror").read_text().splitlines():
        if line.strip():
            a, b, _ = line.split()
            mirror[int(a)] = int(b)
    return Source(
        folder, np.array(vertices), np.array(quads), np.array(uvs), np.array(uv_quads), np.array(groups), mirror
    )


def read_target(path: Path, count: int) -> F64:
    """(count, 3) offsets of a target file, decimetres; zero where it names no vertex."""
    text = gzip.decompress(path.read_bytes()).decode() if path.suffix == ".gz" else path.read_text()
    rows = [line.split() for line in text.splitlines() if line.strip() and not line.startswith("#")]
    out = np.zeros((count, 3))
    for row in rows:
        out[int(row[0])] = [float(x) for x in row[1:4]]
    return out


def shape_targets(source: Source) -> dict[str, F64]:
    """Name -> (N, 3) of each target that changes the head's shape, macro targets included, in the order of names."""
    out = {}
    for name in (*TARGET_FOLDERS, "macro"):
        for path in sorted((source.folder / "targets" / name).glob("*.target.gz")):
            short = path.name.removesuffix(".target.gz")
            if not NO_SHAPE.match(short):
                out[short] = read_target(path, len(source.vertices))
    return out


def expressions(source: Source, names: tuple[str, ...]) -> dict[str, F64]:
    """Name -> (N, 3) of each facial expression: the mean of the file and of its other side's file mirrored, because
    the files differ from each other's mirror images by up to 2 mm at few vertices."""
    read = {n: read_target(source.folder / "faceunits" / f"{n}.target", len(source.vertices)) for n in names}
    return {n: (d + read[other_side(n)][source.mirror] * [-1, 1, 1]) / 2 for n, d in read.items()}


def other_side(name: str) -> str:
    """The expression of the other side; itself if it has none."""
    for one, two in (("Left", "Right"), ("Right", "Left")):
        if name.endswith(one):
            return name.removesuffix(one) + two
    return name
