"""Registered heads of persons of the template's own identity basis, whose expressions and poses are known."""

from __future__ import annotations

from functools import lru_cache

import numpy as np
from scipy.spatial.transform import Rotation

from pipeline.registration.head import Head
from pipeline.registration.neck import neck_share
from pipeline.registration.rig import Rig
from pipeline.template.load import load_template
from pipeline.template.model import Template

TURN, SHIFT = Rotation.from_euler("yxz", (12, -5, 4), degrees=True).as_matrix(), np.array([0.012, -0.02, 0.03])
STRAIGHT, NOWHERE = np.eye(3), np.zeros(3)
SMILE = {"mouthSmileLeft": 0.8, "mouthSmileRight": 0.6, "cheekSquintLeft": 0.5}


@lru_cache
def template() -> Template:
    return load_template()


@lru_cache
def rig() -> Rig:
    """The template's own expressions, as far as the neck makes them."""
    t = template()
    assert t.expressions is not None
    offsets = t.expressions.offsets * neck_share(t)[t.expressions.vertices, None]
    shapes = type(t.expressions)(t.expressions.names, t.expressions.starts, t.expressions.vertices, offsets)
    return Rig(shapes, ("head",), np.zeros((1, 3)), np.ones((len(t.vertices), 1)))


def person(seed: int) -> np.ndarray:
    """(V, 3) the vertices of a person."""
    return template().identity(np.random.default_rng(seed).normal(0, 0.6, 60))


def expression(shares: dict[str, float]) -> np.ndarray:
    """(V, 3) offsets of a sum of expressions."""
    t = template()
    total = sum((a * t.expression(n) for n, a in shares.items()), np.zeros_like(t.vertices))
    return total * neck_share(t)[:, None]


def head(
    vertices: np.ndarray, seen: np.ndarray | float = 1.0, turn: np.ndarray = STRAIGHT, shift: np.ndarray = NOWHERE
) -> Head:
    """A head without subdivision or displacement, posed."""
    t = template()
    of = [np.full(len(t.quads), -1, np.int64) for _ in range(2)]
    for index, named in zip(of, (t.regions, t.parts), strict=True):
        for i, rows in enumerate(named.values()):
            index[rows] = i
    shown = np.broadcast_to(np.asarray(seen, np.float32), len(vertices)).copy()
    still = np.zeros(len(vertices), np.float32)
    return Head(vertices @ turn.T + shift, t.quads, t.uvs, t.uv_quads, of[0], of[1], still, shown, 0)


def names() -> tuple[tuple[str, ...], tuple[str, ...]]:
    """Of the regions and of the parts."""
    return tuple(template().regions), tuple(template().parts)


def degrees_between(a: np.ndarray, b: np.ndarray) -> float:
    return float(np.degrees(Rotation.from_matrix(a @ b.T).magnitude()))
