"""Writes the template's folder: manifest, arrays, licence and provenance (docs/template.md)."""

from __future__ import annotations

import json
import shutil
from pathlib import Path
from typing import Any

import numpy as np

from benchmarks.hm08.arkit import NAMES as ARKIT
from benchmarks.hm08.cut import Cut
from benchmarks.hm08.identity import Identity
from benchmarks.hm08.landmarks import Found
from benchmarks.hm08.regions import NAMES
from pipeline.meshes import F64, Indices
from pipeline.template.manifest import FORMAT, VERSION

METRES = 0.1  # of a decimetre
TINY = 2e-6  # decimetres: offsets of expressions below that are left out
ARRAYS = "head.npz"
PROVENANCE = """# Where this head comes from
Made from MakeHuman's base mesh hm08, its shape targets and its mirror table (Data Collection AB, Joel Palmius, Jonas
Hauquier and the MakeHuman team), and from the Face Units pack with the 52 ARKit expressions (Mika Suominen). All of it
is CC0 1.0, and so is this folder: see LICENSE-CC0.md.

Changed: head and neck cut out, with eyes, teeth, tongue and lashes; the average of sampled persons instead of the base
mesh; metres instead of decimetres, the origin in the head's middle; shape targets turned into {components} principal
components; regions, landmarks and the texture layout are new. Nothing is taken from the face network but where it sees
its landmarks on pictures of this head.

Command: `python -m benchmarks.build_template SOURCE`
"""


def group_names(cut: Cut) -> tuple[list[str], dict[str, list[str]], dict[str, list[str]]]:
    """Groups, and of which parts and regions they are: one for each region of the skin and for each other part."""
    from benchmarks.hm08.regions import OF_PART

    skin = [n for n in NAMES if n not in OF_PART.values()]
    others = [p for p in cut.parts if p != "skin"]
    regions = {n: [n] for n in skin}
    for part in others:
        regions.setdefault(OF_PART[part], []).append(part)
    return skin + others, {"skin": skin, **{p: [p] for p in others}}, regions


def quad_groups(cut: Cut, label: Indices, groups: list[str]) -> Indices:
    """(Q,) index into groups."""
    out = np.zeros(len(cut.quads), np.uint8)
    for part, (first, end) in cut.parts.items():
        names = np.array(NAMES)[label[first:end]] if part == "skin" else [part] * (end - first)
        out[first:end] = [groups.index(n) for n in names]
    return out


def joined_uvs(cut: Cut, uv: F64) -> tuple[F64, Indices]:
    """Texture vertices (U, 2) and (Q, 4) into them, from coordinates by corner: one for each vertex and place."""
    flat = np.round(uv.reshape(-1, 2), 7)
    key = np.column_stack([cut.quads.ravel(), flat])
    found, inverse = np.unique(key, axis=0, return_inverse=True)
    return found[:, 1:], inverse.reshape(-1, 4)


def one_side(cut: Cut) -> Indices:
    """Vertices of which each is itself or the lower of its pair."""
    return np.flatnonzero(np.arange(len(cut.mirror)) <= cut.mirror)


def stored_identity(identity: Identity, cut: Cut) -> dict[str, Any]:
    """The basis as half floats over each component's largest value, one side of the head."""
    rows = one_side(cut)
    scale = np.abs(identity.basis).max((1, 2))
    return {
        "identity_basis": (identity.basis[:, rows] / scale[:, None, None]).astype(np.float16),
        "identity_scale": scale,
        "identity_vertices": rows.astype(np.uint16),
        "identity_deviation": identity.deviation,
        "identity_symmetric": identity.symmetric,
        "identity_joints": identity.joint_basis.astype(np.float32),
    }


def stored_expressions(offsets: dict[str, F64], cut: Cut) -> dict[str, Any]:
    """Offsets of the vertices that move, as half floats over the largest value."""
    scale = max(float(np.abs(d[cut.rows]).max()) for d in offsets.values())
    starts, vertices, moved = [0], [], []
    for name in ARKIT:
        own = offsets[name][cut.rows]
        rows = np.flatnonzero(np.abs(own).max(1) > TINY)
        vertices.append(rows.astype(np.uint16))
        moved.append((own[rows] / scale).astype(np.float16))
        starts.append(starts[-1] + len(rows))
    return {
        "expression_scale": np.array(scale),
        "expression_starts": np.array(starts, np.int32),
        "expression_vertices": np.concatenate(vertices),
        "expression_offsets": np.concatenate(moved),
    }


def write_template(out: Path, source: Path, cut: Cut, label: Indices, identity: Identity, centre: F64, uv: F64,
                   offsets: dict[str, F64], found: Found, figures: dict[str, Any]) -> None:  # fmt: skip
    """All files of the template. centre: what becomes the origin; uv (Q, 4, 2) by corner."""
    out.mkdir(parents=True, exist_ok=True)
    groups, parts, regions = group_names(cut)
    uvs, uv_quads = joined_uvs(cut, uv)
    arrays = {
        "vertices": (identity.mean - centre).astype(np.float64),
        "quads": cut.quads.astype(np.uint16),
        "group": quad_groups(cut, label, groups),
        "uvs": uvs,
        "uv_quads": uv_quads.astype(np.uint16),
        "mirror": cut.mirror.astype(np.uint16),
        "joints": identity.joints - centre,
        **stored_identity(identity, cut),
        **stored_expressions(offsets, cut),
    }
    np.savez_compressed(out / ARRAYS, **arrays)
    landmarks = [
        {"name": n, "network": int(k), "corners": c.tolist(), "weights": [round(float(x), 6) for x in w]}
        for n, k, c, w in zip(found.names, found.network, found.corners, found.weights, strict=True)
    ]
    manifest = {
        "format": FORMAT, "version": VERSION, "name": "hm08", "licence": "CC0-1.0", "licence_file": "LICENSE-CC0.md",
        "mesh": ARRAYS, "metres_per_unit": METRES, "groups": groups, "parts": parts, "regions": regions,
        "joints": list(cut.cubes), "expressions": list(ARKIT), "landmarks": landmarks, "figures": figures,
    }  # fmt: skip
    (out / "manifest.json").write_text(_compact(manifest) + "\n")
    shutil.copyfile(source / "LICENSE-CC0.md", out / "LICENSE-CC0.md")
    (out / "LICENSE-CC0.md").chmod(0o644)
    (out / "PROVENANCE.md").write_text(PROVENANCE.format(components=len(identity.basis)))


def _compact(manifest: dict[str, Any]) -> str:
    """JSON with one line for each key, and for each landmark."""
    lines = []
    for key, value in manifest.items():
        text = json.dumps(value)
        if key == "landmarks":
            text = "[\n" + ",\n".join(f"    {json.dumps(x)}" for x in value) + "\n  ]"
        lines.append(f"  {json.dumps(key)}: {text}")
    return "{\n" + ",\n".join(lines) + "\n}"
