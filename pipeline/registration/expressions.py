"""The template's expressions on a person, by deformation transfer.

Symbols: x, d the template's vertices and an expression's offsets; y the person's vertices, o the offsets wanted. On
each triangle S = [x~] [x]^-1 is the template's deformation gradient, [x] = (x2 - x1, x3 - x1, n / sqrt |n|) with the
normal n of the doubled area; Q (3, 2) an orthonormal basis of the person's triangle and A its area.

    minimise over o:   sum A |(S - I) Q - grad(o) Q|^2

which is Sumner and Popovic's problem with each triangle's fourth vertex eliminated (it takes the part of S along the
normal, exactly), triangles weighted by their area. A vertex that the expression leaves where it is on the template
stays on the person, so that an expression moves the same vertices on everybody. Near the border of the neck nothing
moves (neck.py). Each quad is cut both ways: the result does not depend on a choice of diagonals.

Eyes, teeth and tongue make the rigid motion that they make in the template, about their own middle; what is not rigid
in it (a tongue that comes out) is added.

Eyes that blink close until the lids meet: MakeHuman's shape takes the lids past each other, and a person whose eyes are
closed in the photos has little left to close. d is scaled by least squares so that the margins of the lids meet, and

    + CONTACT sum (up . (upper - lower) - GAP)^2

over the places of the upper lid's margin and those of the lower lid's below them is added to the sum.

Source: Sumner and Popovic, Deformation transfer for triangle meshes (2004); Botsch, Sumner, Pauly and Gross,
Deformation transfer for detail-preserving surface editing (2006), for the weights by area.
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from scipy.sparse import csr_array, diags_array

from pipeline.maths.sparse import factorised
from pipeline.meshes import F64, Indices, Mask
from pipeline.registration.followers import BENDING, rigid_motion
from pipeline.registration.lids import BLINK, GAP, facing
from pipeline.registration.neck import neck_share
from pipeline.template.model import SKIN, Expressions, Template
from pipeline.transforms import scale_of

CONTACT = 10.0  # of the mean diagonal of the system: weight of lids that meet
MOST = 1.5  # largest scale of a blink
RIDGE = 1e-7  # of the mean diagonal: pulls to the template's own offsets, so that a part that moves as a whole has one
LEAST = 1e-7  # metres of the template: what an expression moves by less it leaves where it is
EMPTY = 1e-12  # square metres of the template: a triangle of less area has no gradient and does not count


@dataclass(frozen=True, slots=True)
class Triangles:
    """corners (T, 3) into the vertices; frame (T, 3, 2) Q; area (T,); gradient (2 T, V): of a field, along Q."""

    corners: Indices
    frame: F64
    area: F64
    gradient: csr_array


def transferred(
    template: Template, vertices: F64, world_from_template: F64, covered: Mask | None = None
) -> Expressions:
    """The expressions on a person's vertices (V, 3), whose similarity (4, 4) from the template is known; offsets in the
    unit of vertices. Lashes get none. covered (V,): see `neck_share`."""
    given = template.expressions
    if given is None:
        return Expressions((), np.zeros(1, np.int64), np.zeros(0, np.int64), np.zeros((0, 3)))
    scale = scale_of(world_from_template)
    turn = world_from_template[:3, :3] / scale
    person = (vertices - world_from_template[:3, 3]) @ turn / scale  # in the template's frame
    skin = template.quads[template.parts[SKIN]]
    before, after = triangles(template.vertices, skin), triangles(person, skin)
    system = csr_array(after.gradient.T @ diags_array(np.repeat(after.area, 2)) @ after.gradient)
    starts, rows, offsets = [0], [], []
    share = neck_share(template, covered)[:, None]
    for name in given.names:
        wanted = template.expression(name) * share
        moves = np.linalg.norm(wanted, axis=1) > LEAST
        out = _on_skin(template.vertices, wanted, moves, before, after, system)
        if name in BLINK:
            margins = facing(template, 1.0 if name == BLINK[0] else -1.0)
            wanted = wanted * blink_scale(margins, person, out)
            out = _on_skin(template.vertices, wanted, moves, before, after, system, (margins, person))
        for part, quads in template.parts.items():
            if part != SKIN and not part.startswith(BENDING):
                own = np.setdiff1d(np.unique(template.quads[quads]), skin)
                if moves[own].any():
                    out[own] = _carried(template.vertices[own], wanted[own], person[own])
        own = np.flatnonzero(np.linalg.norm(out, axis=1) > LEAST)
        rows.append(own)
        offsets.append(scale * out[own] @ turn.T)
        starts.append(starts[-1] + len(own))
    return Expressions(given.names, np.array(starts, np.int64), np.concatenate(rows), np.concatenate(offsets))


def triangles(vertices: F64, quads: Indices) -> Triangles:
    """The triangles of quads (Q, 4), each cut both ways, which counts half."""
    corners = np.concatenate([quads[:, list(cut)] for cut in ((0, 1, 2), (0, 2, 3), (1, 2, 3), (1, 3, 0))])
    x = vertices[corners]
    edges = np.stack([x[:, 1] - x[:, 0], x[:, 2] - x[:, 0]], 2)
    area = 0.25 * np.linalg.norm(np.cross(edges[..., 0], edges[..., 1]), axis=1)
    sound = area > EMPTY
    edges[~sound] = np.eye(3)[:, :2]
    frame, upper = np.linalg.qr(edges)
    inverse = np.linalg.inv(upper)  # (T, 2, 2): of the edges' coordinates in the frame
    inverse[~sound] = 0.0
    values = np.concatenate([-inverse.sum(1, keepdims=True), inverse], 1)  # (T, corner, direction)
    count = len(corners)
    lines = np.broadcast_to(np.arange(2 * count).reshape(count, 1, 2), values.shape)
    columns = np.broadcast_to(corners[:, :, None], values.shape)
    gradient = csr_array((values.ravel(), (lines.ravel(), columns.ravel())), shape=(2 * count, len(vertices)))
    return Triangles(corners.astype(np.int64), frame, np.where(sound, area, 0.0), gradient)


def gradients(before: F64, after: F64, corners: Indices) -> F64:
    """(T, 3, 3) deformation gradients of triangles from vertices before to after (V, 3); the identity where a triangle
    is empty."""
    frames = []
    for x in (before[corners], after[corners]):
        a, b = x[:, 1] - x[:, 0], x[:, 2] - x[:, 0]
        normal = np.cross(a, b)
        length = np.linalg.norm(normal, axis=1, keepdims=True)
        frames.append(np.stack([a, b, normal / np.sqrt(np.maximum(length, 1e-30))], 2))
    sound = np.abs(np.linalg.det(frames[0])) > EMPTY**1.5
    frames[0][~sound] = np.eye(3)
    out = frames[1] @ np.linalg.inv(frames[0])
    out[~sound] = np.eye(3)
    return np.asarray(out, np.float64)


def blink_scale(margins: csr_array, person: F64, offsets: F64) -> float:
    """How much of offsets (V, 3) closes the lids of person (V, 3), whose margins (n, V) are to meet; 1 without any."""
    gap, closes = GAP - (margins @ person)[:, 1], (margins @ offsets)[:, 1]
    total = float((closes**2).sum())
    return float(np.clip((gap * closes).sum() / total, 0, MOST)) if total > 0 else 1.0


def _on_skin(
    x: F64,
    wanted: F64,
    moves: Mask,
    before: Triangles,
    after: Triangles,
    system: csr_array,
    meeting: tuple[csr_array, F64] | None = None,
) -> F64:
    """(V, 3) offsets of the skin, 0 elsewhere. wanted (V, 3): the template's; system: of all skin vertices. meeting:
    margins (n, V) that meet, and the person (V, 3)."""
    out = np.zeros_like(x)
    free = np.flatnonzero(moves & (system.diagonal() > 0))
    if not len(free):
        return out
    change = (gradients(x, x + wanted, before.corners) - np.eye(3)) @ after.frame  # (T, 3, 2)
    goal = change.transpose(0, 2, 1).reshape(-1, 3) * np.repeat(after.area, 2)[:, None]
    own = csr_array(system[free][:, free])
    mean = float(own.diagonal().mean())
    own = csr_array(own + RIDGE * mean * diags_array(np.ones(len(free))))
    right = (after.gradient.T @ goal)[free] + RIDGE * mean * wanted[free]
    out[free] = factorised(own).solve(right)
    if meeting is not None and meeting[0].shape[0]:
        margins, person = meeting
        pull = csr_array(margins[:, free])
        own = csr_array(own + CONTACT * mean * (pull.T @ pull))
        up = right[:, 1] + CONTACT * mean * (pull.T @ (GAP - (margins @ person)[:, 1]))
        out[free, 1] = factorised(own).solve(up)
    return out


def _carried(x: F64, wanted: F64, y: F64) -> F64:
    """(N, 3) offsets of a part y (N, 3) that moves as x (N, 3) does by `wanted`."""
    turn, shift = rigid_motion(x, x + wanted, np.ones(len(x)))
    middle, own = x.mean(0), y.mean(0)
    rest = x + wanted - (x @ turn.T + shift)
    step = middle @ turn.T + shift - middle
    return np.asarray((y - own) @ turn.T + own + step + rest - y)
