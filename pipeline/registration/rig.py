"""What an animator moves on a registered head: expressions, and joints of head, jaw and eyes with their weights.

The jaw turns about the axis about which the template's lower teeth turn when the jaw opens. A place of the skin follows
the jaw joint by the share of that turn that it makes in the template's expression:

    w = d . r / r . r, from 0 to 1        d: its offset in jawOpen; r: its offset if it turned with the jaw

so that a turn of the joint opens the mouth as the expression does (which is linear: use one of the two).
"""

from __future__ import annotations

from dataclasses import dataclass
from pathlib import Path

import numpy as np

from pipeline.meshes import F64, Mask
from pipeline.registration.expressions import transferred
from pipeline.registration.followers import rigid_motion
from pipeline.registration.neck import neck_share
from pipeline.template.model import SKIN, Expressions, Template

HEAD, JAW, EYES = "head", "jaw", ("eye_left", "eye_right")
OPENS, WITH_JAW = "jawOpen", ("teeth_lower", "tongue")
NEAR = 0.05  # metres of the template: skin this far from a joint has half of its weight in placing it
LEAST_TURN = 0.02  # radians: a jaw that turns less has no axis


@dataclass(frozen=True, slots=True)
class Rig:
    """expressions over the cage's vertices, in asset units. joints: names, the first is the root and the parent of the
    others; places (J, 3); weights (V, J), rows of sum 1."""

    expressions: Expressions
    joints: tuple[str, ...]
    places: F64
    weights: F64

    def save(self, path: Path) -> None:
        """Write the npz."""
        e = self.expressions
        np.savez(
            path, names=np.array(e.names, np.str_), starts=e.starts, vertices=e.vertices.astype(np.int32),
            offsets=e.offsets.astype(np.float32), joints=np.array(self.joints, np.str_), places=self.places,
            weights=self.weights.astype(np.float32),
        )  # fmt: skip


def load_rig(path: Path) -> Rig:
    """The rig of an npz that `save` wrote."""
    with np.load(path, allow_pickle=False) as z:
        names, joints = (tuple(str(n) for n in z[k]) for k in ("names", "joints"))
        shapes = Expressions(names, z["starts"], z["vertices"].astype(np.int64), z["offsets"].astype(np.float64))
        return Rig(shapes, joints, z["places"], z["weights"].astype(np.float64))


def rig_of(template: Template, vertices: F64, world_from_template: F64, covered: Mask | None = None) -> Rig | None:
    """The rig of a person's vertices (V, 3); None if the template has no expressions and no joint of the head. covered
    (V,): vertices of the neck under clothes or hair, which stay still."""
    if HEAD not in template.joints:
        return None
    shapes = transferred(template, vertices, world_from_template, covered)
    own = {HEAD: np.ones(len(vertices), np.float64)}
    places = {HEAD: _placed(template, vertices, template.joints[HEAD])}
    jaw = jaw_axis(template)
    if jaw is not None:
        turn, on_axis = jaw
        own[JAW], places[JAW] = jaw_weights(template, turn, on_axis, covered), _placed(template, vertices, on_axis)
    for eye in EYES:
        if eye in template.parts:
            ball = vertices[template.part_vertices(eye)]
            own[eye], places[eye] = _inside(template, eye).astype(np.float64), 0.5 * (ball.min(0) + ball.max(0))
    weights = np.stack(list(own.values()), 1)
    weights[:, 0] = 1 - weights[:, 1:].sum(1)
    return Rig(shapes, tuple(own), np.stack(list(places.values())), weights)


def jaw_axis(template: Template) -> tuple[F64, F64] | None:
    """Rotation (3, 3) of the opening jaw, and the place (3,) on its axis in the middle of the head; None if the
    template has no lower teeth or they do not turn."""
    names = template.expressions.names if template.expressions else ()
    if OPENS not in names or WITH_JAW[0] not in template.parts:
        return None
    teeth = template.part_vertices(WITH_JAW[0])
    x = template.vertices[teeth]
    turn, shift = rigid_motion(x, x + template.expression(OPENS)[teeth], np.ones(len(x)))
    if np.arccos(np.clip((np.trace(turn) - 1) / 2, -1, 1)) < LEAST_TURN:
        return None
    # I - R is singular along the axis: the solution of least norm is the axis's place nearest to the origin
    return turn, np.asarray(np.linalg.lstsq(np.eye(3) - turn, shift, rcond=1e-3)[0])


def jaw_weights(template: Template, turn: F64, on_axis: F64, covered: Mask | None = None) -> F64:
    """(V,) how far each vertex follows the jaw. covered (V,): see `neck_share`."""
    moved = template.expression(OPENS) * neck_share(template, covered)[:, None]
    with_jaw = (template.vertices - on_axis) @ turn.T + on_axis - template.vertices
    share = (moved * with_jaw).sum(1) / np.maximum((with_jaw**2).sum(1), 1e-12)
    out = np.clip(share, 0, 1) * _inside(template, SKIN)
    for part in WITH_JAW:
        if part in template.parts:
            out[_inside(template, part)] = 1.0
    return np.asarray(out, np.float64)


def _inside(template: Template, part: str) -> Mask:
    return np.isin(np.arange(len(template.vertices)), template.part_vertices(part))


def _placed(template: Template, vertices: F64, place: F64) -> F64:
    """A place (3,) of the template in the person: moved as the skin around it, by the affine map of least squares."""
    skin = template.part_vertices(SKIN)
    x, y = template.vertices[skin], vertices[skin]
    w = 1 / (1 + ((x - place) ** 2).sum(1) / NEAR**2)
    a = np.sqrt(w)[:, None] * np.c_[x - place, np.ones(len(x))]
    return np.asarray(np.linalg.lstsq(a, np.sqrt(w)[:, None] * y, rcond=None)[0][3])
