"""Where the error of left-out lights is: python -m benchmarks.reflectance_errors RUN CAPTURE [--camera N ...]

RUN, CAPTURE: as for reflectance_field.py. Every pixel of skin and eyes is of one kind, the first that holds:

    missing      the mesh does not cover it
    outline      within 2 pixels of the head's outline
    eye          by the labels
    shadow wrong the field has light of less than half or more than half where the true head is lit or is not
    shadow edge  within 2 pixels of the edge of a true shadow
    dark         lit by nothing but other skin
    lit          everything else

Prints the share of pixels, the share of the squared error and the PSNR of each kind; and the PSNR of the field if what
arrives at its texels were traced on the true head instead (`true shadows`).
"""

from __future__ import annotations

import argparse
import json
from pathlib import Path

import numpy as np
from scipy.ndimage import binary_dilation, binary_erosion

from benchmarks.reflectance_field import EYE, GAIN, Truth, labels_of, placed, rig_of_run
from pipeline.images import F32, read_linear
from pipeline.ray_casting import RayCaster
from pipeline.transforms import apply, matrix, pixel_centres
from stages.reflectance.field import Field, Lamp, load
from stages.reflectance.relight import lit_by, look_up, picture
from stages.reflectance.rig import Rig
from stages.reflectance.score import COVERED, camera_at, encoded
from stages.reflectance.texels import arriving
from workflows.cli.render import capture_from_asset_of

KINDS = ("missing", "outline", "eye", "shadow wrong", "shadow edge", "dark", "lit")
BAND, LIFT, HALF = 2, 1e-3, 0.5


def true_light(caster: RayCaster, faces_normal: np.ndarray, view: object, lamp: Lamp) -> tuple[np.ndarray, np.ndarray]:
    """(H, W) whether the true head is lit by a lamp, and whether it faces it."""
    eye, rays = view.rays(pixel_centres(view.width, view.height))
    far, face = caster.hits(np.broadcast_to(eye, rays.shape), rays)
    hit = np.flatnonzero(face >= 0)
    normal, at = faces_normal[face[hit]], eye + far[hit, None] * rays[hit]
    towards = lamp.position - at
    towards /= np.linalg.norm(towards, axis=1, keepdims=True)
    facing = (towards * normal).sum(1) > 0
    free = caster.first_faces(at + LIFT * normal, towards) < 0
    out = np.zeros((2, view.height * view.width), np.bool_)
    out[0, hit], out[1, hit] = facing & free, facing
    return out[0].reshape(view.height, view.width), out[1].reshape(view.height, view.width)


def kinds_of(label: np.ndarray, alpha: F32, lit: np.ndarray, field_lit: F32) -> np.ndarray:
    """(H, W) place in KINDS, -1 where the pixel does not count."""
    head = label > 0
    inside = binary_erosion(head, np.ones((3, 3)), iterations=BAND)
    edge = binary_dilation(lit, np.ones((3, 3)), iterations=BAND) & ~binary_erosion(
        lit, np.ones((3, 3)), iterations=BAND
    )
    tests = (alpha < COVERED, ~inside, label == EYE, (field_lit > HALF) != lit, edge, ~lit, np.ones_like(lit))
    out = np.full(label.shape, -1)
    for n in range(len(tests) - 1, -1, -1):
        out[head & tests[n]] = n
    return out


def measured(
    field: Field, rig: Rig, single: dict, held: list[int], cameras: list[int], capture: Path, world: np.ndarray
) -> dict:
    """Sums over pictures."""
    truth = Truth(capture / "truth")
    vertices = apply(matrix(np.linalg.inv(world)), truth.vertices)
    caster = RayCaster(vertices.astype(np.float32), truth.faces)
    a, b, c = vertices[truth.faces].transpose(1, 0, 2)
    normal = np.cross(b - a, c - a)
    normal /= np.maximum(np.linalg.norm(normal, axis=1, keepdims=True), 1e-12)
    positions, axes = rig.lamps()
    total, count, better = np.zeros(len(KINDS)), np.zeros(len(KINDS)), []
    for i in held:
        lamp = Lamp(positions[i], axes[i], rig.strength[i])
        arrives, traced = field.arrives(lamp), arriving(field.points, caster, lamp.position, lamp.axis)
        above = ((lamp.position - field.points.position) * field.normal).sum(1) > 0
        for n in cameras:
            view = camera_at(rig, n, i)
            table, image = look_up(field, view), encoded(read_linear(single[n, i]), GAIN)
            made, other = (picture(view, table, lit_by(field, view, lamp, v)) for v in (arrives, traced))
            shown = np.asarray(table @ (arrives * above)).reshape(view.height, view.width)
            lit, _ = true_light(caster, normal, view, lamp)
            kind = kinds_of(labels_of(capture, rig.cameras[n].index), made[..., 3], lit, shown)
            error = ((encoded(made[..., :3], GAIN) - image) ** 2).mean(2)
            np.add.at(total, kind[kind >= 0], error[kind >= 0])
            np.add.at(count, kind[kind >= 0], 1)
            better.append(float(((encoded(other[..., :3], GAIN) - image) ** 2).mean(2)[kind >= 0].mean()))
    rows = {k: {"pixels": round(100 * c / count.sum(), 1), "error": round(100 * t / total.sum(), 1),
                "PSNR": round(float(-10 * np.log10(max(t / max(c, 1), 1e-9))), 1)}
            for k, t, c in zip(KINDS, total, count, strict=True)}  # fmt: skip
    whole = round(float(-10 * np.log10(total.sum() / count.sum())), 2)
    return {"all": whole, "true shadows": round(float(-10 * np.log10(np.mean(better))), 2), **rows}


def main() -> None:
    """Print the table as JSON."""
    p = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    p.add_argument("run", type=Path)
    p.add_argument("capture", type=Path)
    p.add_argument("--camera", type=int, action="append", help="only these")
    options = p.parse_args()
    folder = options.run / "reflectance"
    field, basis = load(folder), json.loads((folder / "basis.json").read_text())
    rig = rig_of_run(options.run, options.capture, basis)
    place, single = placed(rig, options.capture)
    cameras = [n for n, c in enumerate(rig.cameras) if options.camera is None or c.index in options.camera]
    held = [place[n] for n in basis["left_out"]]
    found = measured(field, rig, single, held, cameras, options.capture, capture_from_asset_of(options.run))
    print(json.dumps(found, indent=1))


if __name__ == "__main__":
    main()
