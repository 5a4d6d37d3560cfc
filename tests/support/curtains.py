"""Photos of the head template with hair that hangs beside its face as two flat curtains."""

from __future__ import annotations

import numpy as np

from pipeline.meshes import F64, Mask
from pipeline.ray_casting import RayCaster
from pipeline.template.load import load_template
from pipeline.template.model import SKIN
from pipeline.transforms import pixel_centres, rays

TEMPLATE = load_template()
SKIN_COLOUR, HAIR_COLOUR, WALL = (0.5, 0.33, 0.26), (0.03, 0.02, 0.015), (0.6, 0.6, 0.6)
NEAR, FAR = 0.05, 0.085  # metres: each curtain from x = NEAR to FAR on its side
LOW, HIGH, BACK, FRONT = -0.15, 0.06, -0.06, 0.1  # its ends in y and z
SIDE, FOCAL, AWAY = 160, 380.0, 0.9


def pose(angle: float) -> F64:
    """World from camera, looking at the head from an angle about the vertical; 0 is the front."""
    centre = AWAY * np.array([np.sin(angle), 0.0, np.cos(angle)])
    z = -centre / AWAY
    x = np.cross(z, [0.0, 1.0, 0.0])
    out = np.eye(4)
    out[:3, :3], out[:3, 3] = np.stack([x, np.cross(z, x), z], 1), centre
    return out


def matrix_k() -> F64:
    return np.array([[FOCAL, 0, SIDE / 2], [0, FOCAL, SIDE / 2], [0, 0, 1.0]])


def in_curtain(points: F64) -> Mask:
    """(N,) points (N, 3) inside a curtain."""
    x, y, z = np.abs(points[:, 0]), points[:, 1], points[:, 2]
    return (x > NEAR) & (x < FAR) & (y > LOW) & (y < HIGH) & (z > BACK) & (z < FRONT)


def photo(world_from_cam: F64, fringe: float = np.inf) -> tuple[F64, Mask]:
    """Colours (SIDE, SIDE, 3), and where the subject is. fringe: height above which the face is covered by hair."""
    centre, d = rays(matrix_k(), world_from_cam, np.zeros(5), pixel_centres(SIDE, SIDE))
    skin = np.zeros(len(TEMPLATE.quads), bool)
    skin[TEMPLATE.parts[SKIN]] = True
    faces = TEMPLATE.triangles()[np.repeat(skin, 2)]
    scalp = np.zeros(len(TEMPLATE.quads), bool)
    scalp[TEMPLATE.regions["scalp"]] = True
    far, face = RayCaster(TEMPLATE.vertices, faces).hits(np.broadcast_to(centre, d.shape).copy(), d)
    hit = np.isfinite(far)
    hair = hit & np.repeat(scalp, 2)[np.repeat(skin, 2)][face]
    at = centre + np.where(hit, far, 0)[:, None] * d
    hair |= hit & (at[:, 1] > fringe)
    for t in np.linspace(AWAY - 0.15, AWAY + 0.15, 121):
        hair |= in_curtain(centre + t * d) & (t < far)
    out = np.where(hit[:, None], SKIN_COLOUR, WALL)
    out[hair] = HAIR_COLOUR
    return out.reshape(SIDE, SIDE, 3), (hit | hair).reshape(SIDE, SIDE)
