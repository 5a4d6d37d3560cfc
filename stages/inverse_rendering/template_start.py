"""Initial geometry of a person's head where the visual hull hides the face: the hull, cut by the head template.

Photos from one side leave a hull that reaches centimetres in front of and behind the face. No sweep along its normals
finds the nose in it. But the photos' face landmarks tell where the face is, and the template placed on them how it
goes on. The hull remains the outer limit; the template only carves.

Symbols: H the hull's signed distance, T the placed template's, a >= 0 how far this place of a person may stand out of
the template (hair, ears, a collar): S = max(H, T - a).
"""

from __future__ import annotations

from collections.abc import Mapping

import numpy as np
import torch
from scipy import ndimage

from pipeline.meshes import F64, vertex_normals
from pipeline.registration.identity_fit import PlacedHead, landmark_data, place
from pipeline.registration.shell import outer_shell, shell_distance
from pipeline.template.model import SKIN, Template
from stages.inverse_rendering.initial_geometry import Start
from stages.inverse_rendering.stereo import distances

SIGMA = 0.003  # metres: scatter of the network's landmarks around the template's, on rendered persons and head scans
FAR = 0.006  # metres of the template: median distance of the landmarks from a surface that does not have the face.
# Measured: 1 to 3 mm on surfaces that are right, 14 to 45 mm where the hull hides the face.
MAX_RESIDUAL = 0.006  # metres: a template whose own landmarks are further off does not fit this face
# Metres that a person may stand out of the placed template, by region. Everywhere a little: the sweep that follows finds
# a surface that lies inside of its start more easily than one outside.
ALLOWED: Mapping[str, float] = {"scalp": 0.045, "ears": 0.012, "neck": 0.06}  # neck: long hair beside it
FRONT, THROAT = 0.3, 0.015  # the same for the front of the neck: its normals have this cosine to the front
HIDDEN = 0.012  # the same where no camera faces the template: nothing tells how thick hair is there
ALLOWED_ELSEWHERE = 0.002
UNBOUNDED = 0.3  # metres: below the neck's end the hull alone counts
SMOOTH_STEPS = 12  # of averaging over neighbours: the bound changes over about two centimetres
BLUR = 0.006  # metres: so that the bound has no steps where the nearest place of the template changes


def placed_on_face(template: Template, landmarks: F64) -> PlacedHead | None:
    """The template on landmarks (468, 3); None if they do not look like a face's."""
    data = landmark_data(template, landmarks, SIGMA)
    if len(data.where) < len(template.landmarks.names) // 2:
        return None
    head = place(template, (data,))
    return head if float(np.median(head.residual)) <= MAX_RESIDUAL else None


def landmarks_off(start: Start, landmarks: F64, unit: float) -> float:
    """Median distance of the landmarks (468, 3) from the zero set of the start, in metres of the template. unit: world
    units per metre of the template."""
    known = landmarks[np.isfinite(landmarks).all(1)]
    values, _ = start.surface("cpu")(torch.from_numpy(known.astype(np.float32)))
    return float(values.detach().abs().median()) / unit


def carved_by_template(start: Start, template: Template, head: PlacedHead, centres: F64) -> Start:
    """The start without what lies in front of the placed head; unchanged below the neck. centres (N, 3): of the
    cameras."""
    shell = outer_shell(template)
    found = shell_distance(
        shell.vertices(head.vertices), shell.faces, start.lo.astype(np.float64), start.cell, _shape(start)
    )
    allowed = np.concatenate([_allowance(template, head, centres), np.zeros(len(shell.loops))])
    allowed[len(template.vertices)] = UNBOUNDED  # the neck's cap
    bound = head.scale * allowed[shell.faces].mean(1)[found.face]
    bound = ndimage.gaussian_filter(bound, BLUR * head.scale / start.cell)
    values = np.maximum(start.values, found.values - bound)
    return Start(distances(values, start.lo, start.cell), start.lo, start.cell)


def _allowance(template: Template, head: PlacedHead, centres: F64) -> F64:
    """(V,) metres, smooth over the skin."""
    normals = vertex_normals(head.vertices, template.triangles()).astype(np.float64)
    front = head.world_from_template[:3, 2] / head.scale
    base = np.full(len(template.vertices), ALLOWED_ELSEWHERE)
    for name, metres in ALLOWED.items():
        if name in template.regions:
            base = np.maximum(base, metres * template.region_weights(name))
    if "neck" in template.regions:
        throat = (template.region_weights("neck") > 0) & (normals @ front > FRONT)
        base[throat] = np.minimum(base[throat], THROAT)
    faced = np.zeros(len(base), np.bool_)
    for centre in centres:
        faced |= ((centre - head.vertices) * normals).sum(1) > 0
    base[~faced] = np.minimum(base[~faced], HIDDEN)
    quads = template.quads[template.parts[SKIN]]
    a, b = quads.ravel(), np.roll(quads, -1, axis=1).ravel()
    neighbours = np.bincount(np.concatenate([a, b]), minlength=len(base))
    smooth = base
    for _ in range(SMOOTH_STEPS):
        sums = np.bincount(a, smooth[b], len(base)) + np.bincount(b, smooth[a], len(base))
        smooth = np.where(neighbours > 0, 0.5 * smooth + 0.5 * sums / np.maximum(neighbours, 1), smooth)
    return np.asarray(np.minimum(base, smooth), np.float64)  # the face stays free of it


def _shape(start: Start) -> tuple[int, int, int]:
    x, y, z = start.values.shape
    return x, y, z
