"""What a shader outside of this project needs beside the field's maps. docs/field_look.md has such a shader.

surface.exr    c0 ... c5    position (metres) and normal of the mesh, asset coordinates, 32 bits
blocker.obj                 the triangles that throw shadows: those that a camera saw
basis.json                  entries `lobe`, `shadow`, `harmonics`: the constants of the formulas
"""

from __future__ import annotations

from pathlib import Path
from typing import Any

import numpy as np

from pipeline.images import write_exr
from pipeline.maths.sh_monomials import monomials
from stages.reflectance.field import Field
from stages.reflectance.lobe_kernels import FLAT, LOW, RISE
from stages.reflectance.texels import BEHIND, DISC, LIFT, RAYS, TURN, known_surface

SURFACE, BLOCKER = "surface.exr", "blocker.obj"


def write_sidecar(field: Field, folder: Path) -> dict[str, Any]:
    """Write the files of a field at rest; returns the entries of basis.json."""
    folder.mkdir(parents=True, exist_ok=True)
    size, near = field.points.size, field.nearest
    both = np.concatenate([field.points.position, field.points.normal], 1).astype(np.float32)
    write_exr(folder / SURFACE, both[near].reshape(size, size, 6), tuple(f"c{i}" for i in range(6)))
    faces = known_surface(field.mesh, field.points, field.known)
    used, corners = np.unique(faces, return_inverse=True)
    lines = ["# neuface: the faces of the reflectance field that throw shadows; metres, +Y up"]
    lines += [f"v {x:.7f} {y:.7f} {z:.7f}" for x, y, z in field.mesh.vertices[used].tolist()]
    lines += [f"f {a} {b} {c}" for a, b, c in (corners.reshape(-1, 3) + 1).tolist()]
    (folder / BLOCKER).write_text("\n".join(lines) + "\n")
    return {
        "lobe": {"fresnel_rise": RISE, "least_n_dot_l": LOW, "least_n_dot_v": FLAT},
        "shadow": {
            "lift": LIFT, "disc_radius": DISC, "rays": RAYS, "first_angle": TURN, "least_n_dot_l": BEHIND,
        },
        "channels": {"surface": [f"c{i}" for i in range(6)]},
        "harmonics": monomials(field.order),
    }  # fmt: skip
