"""Body, skin, shirt and eyes of a made-up person, from MakeHuman's mesh and shapes (lengths in decimetres)."""

from __future__ import annotations

from dataclasses import dataclass
from pathlib import Path

import numpy as np

from benchmarks.hm08.cut import Cut, cut_head
from benchmarks.hm08.regions import NAMES, labels
from benchmarks.hm08.source import Source, read_source, shape_targets
from pipeline.meshes import F64, Indices, area_vectors, unit

EYE_AT = np.array([0.0, 7.42, 1.069])  # of the left eye's centre, sideways aside: lines of the head's regions fit there
ORIGIN = np.array([0.0, 7.35, 0.55])  # becomes the world's
OTHERS = 0.1  # standard deviation of the weights of the shapes that are not a person's kind
LOWEST, WIDEST = 3.2, 3.2  # of the body: lower and wider parts leave every frame
NECKLINE, RISE, DEEP, AWAY = 5.72, 0.1, 0.35, 0.1  # of the shirt, its rise sideways and fall in front; off the skin


@dataclass(frozen=True, slots=True)
class Look:
    """kinds: weights of MakeHuman's kinds of people. skin, lips: linear albedo. style: of the hair. end: height where
    it ends; strands: their number; seed: of the face's shape and the hair."""

    kinds: dict[str, float]
    skin: tuple[float, float, float]
    lips: tuple[float, float, float]
    style: str
    end: float
    strands: int
    seed: int


LOOKS = {
    "bob": Look({"african-female-young": 0.9, "asian-female-young": 0.1}, (0.125, 0.066, 0.042), (0.16, 0.06, 0.055),
                "bob", 6.42, 26_000, 5),
    "long": Look({"caucasian-female-young": 0.7, "asian-female-young": 0.3}, (0.62, 0.40, 0.31), (0.52, 0.19, 0.17),
                 "long", 5.3, 30_000, 9),
}  # fmt: skip


@dataclass(frozen=True, slots=True)
class Figure:
    """vertices (N, 3) of the whole base mesh in its shape; cut: the head in it; skin, scalp, brows (., 4) quads; colour
    (N, 3) of the skin; shirt: vertices and quads; eyes: centres (2, 3) and radii (2,)."""

    source: Source
    cut: Cut
    vertices: F64
    skin: Indices
    scalp: Indices
    brows: Indices
    colour: F64
    shirt: tuple[F64, Indices]
    eyes: tuple[F64, F64]

    @property
    def mean(self) -> F64:
        """(V, 3) the head's vertices."""
        return self.vertices[self.cut.rows]


def make_figure(kit: Path, look: Look, rng: np.random.Generator) -> Figure:
    """The person. kit: the folder with base.obj and targets."""
    source = read_source(kit)
    targets, cut = shape_targets(source), cut_head(source)
    vertices = _shaped(source, targets, look, rng)
    regions = np.array(NAMES)[labels(vertices[cut.rows], cut, targets)]
    of_quad = {tuple(sorted(cut.rows[q])): r for q, r in zip(cut.quads, regions, strict=True)}
    region = np.array([of_quad.get(tuple(sorted(q)), "body") for q in source.quads])
    middle = vertices[source.quads].mean(1)
    body = (source.group == "body") & (middle[:, 1] > LOWEST) & (np.abs(middle[:, 0]) < WIDEST)
    skin = body & (region != "mouth_inside")
    neckline = NECKLINE + RISE * np.abs(middle[:, 0]) - DEEP * np.clip(middle[:, 2], 0, 1)
    shirt = body & (region == "body") & (middle[:, 1] < neckline)
    return Figure(
        source, cut, vertices, source.quads[skin], source.quads[skin & (region == "scalp")],
        source.quads[skin & np.isin(region, ["brows", "face"])], _colours(source, skin, region, look),
        _shirt(vertices, source.quads[skin], source.quads[shirt]), _eyes(source, vertices),
    )  # fmt: skip


def _shaped(source: Source, targets: dict[str, F64], look: Look, rng: np.random.Generator) -> F64:
    """The base mesh as this person: a kind of people, and random shapes, alike on both sides."""
    out = source.vertices.copy()
    for name, weight in look.kinds.items():
        out += weight * targets[name]
    for name, moved in targets.items():
        if "-female-" in name or "-male-" in name or "trans" in name or name.startswith("r-"):
            continue
        weight = rng.normal() * OTHERS
        if weight > 0:
            out += weight * moved
            if name.startswith("l-") and "r-" + name[2:] in targets:
                out += weight * targets["r-" + name[2:]]
    eye = out[np.unique(source.quads[source.group == "helper-l-eye"])]
    shift = EYE_AT - (eye.max(0) + eye.min(0)) / 2
    shift[0] = 0
    return out + shift


def _colours(source: Source, skin: np.ndarray, region: np.ndarray, look: Look) -> F64:
    total, count = np.zeros((len(source.vertices), 3)), np.zeros(len(source.vertices))
    for quad, name in zip(source.quads[skin], region[skin], strict=True):
        total[quad] += look.lips if name == "lips" else np.array(look.skin) * (0.8 if name == "lids" else 1)
        count[quad] += 1
    return total / np.maximum(count, 1)[:, None]


def _shirt(vertices: F64, skin: Indices, quads: Indices) -> tuple[F64, Indices]:
    """What lies off the skin, as a mesh of its own."""
    normals = np.zeros_like(vertices)
    for k in range(4):
        np.add.at(normals, skin[:, k], area_vectors(vertices, skin[:, :3]) + area_vectors(vertices, skin[:, [0, 2, 3]]))
    rows, own = np.unique(quads, return_inverse=True)
    return vertices[rows] + AWAY * unit(normals[rows]), own.reshape(quads.shape)


def _eyes(source: Source, vertices: F64) -> tuple[F64, F64]:
    balls = [vertices[np.unique(source.quads[source.group == g])] for g in ("helper-l-eye", "helper-r-eye")]
    centres = np.array([(b.max(0) + b.min(0)) / 2 for b in balls])
    return centres, np.array([np.median(np.linalg.norm(b - c, axis=1)) for b, c in zip(balls, centres, strict=True)])


def to_world(points: F64) -> F64:
    """Metres from the head's centre."""
    return 0.1 * (points - ORIGIN)
