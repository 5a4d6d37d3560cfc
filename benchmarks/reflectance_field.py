"""A reflectance field against the truth beside its capture: python -m benchmarks.reflectance_field RUN CAPTURE

RUN: the --out of `neuface run CAPTURE`. CAPTURE: with `truth/` as in a rendered capture (labels, albedo, motion.json,
relit/soft, maps, head.obj). Prints a table; --pictures DIR writes truth, field and blend side by side.

PSNR is of all scored pixels together (the mean of squared errors over pictures), after the sRGB curve, over skin and
eyes. Single lights are shown times 2, as the capture's page says.
"""

from __future__ import annotations

import argparse
import json
from pathlib import Path

import cv2
import numpy as np

from pipeline import meshes
from pipeline.colour import linear_from_srgb, srgb_from_linear
from pipeline.images import F32, read_linear, write_png
from pipeline.maths.latlong import latlong_directions, latlong_weights
from pipeline.meshes import vertex_normals
from pipeline.ray_casting import RayCaster
from pipeline.transforms import F64, apply, matrix, scale_of
from stages.capture.readers.olat import pictures_of, read_lights
from stages.reflectance.field import Field, load
from stages.reflectance.openpbr import OpenPbr
from stages.reflectance.relight import barycentric, lit_by, look_up, picture, under_lamps
from stages.reflectance.rig import Rig, rig_of
from stages.reflectance.score import COVERED, blended, camera_at, decibels, encoded, score
from stages.reflectance.texels import points_of
from workflows.bench.captures_figures import read_run
from workflows.cli.relight import environment
from workflows.cli.render import capture_from_asset_of, given_cameras

GAIN, SOFT_GAIN, SKIN, EYE = 2.0, 1.0, 1, 2
NEAR = 0.005  # metres: texels nearer to the true surface are compared with it


class Truth:
    """The true head in the capture's world, and what is known at its surface."""

    def __init__(self, folder: Path) -> None:
        vertices, uvs, corners, places = [], [], [], []
        for line in (folder / "head.obj").read_text().splitlines():
            words = line.split()
            if not words:
                continue
            if words[0] == "v":
                vertices.append([float(x) for x in words[1:4]])
            elif words[0] == "vt":
                uvs.append([float(x) for x in words[1:3]])
            elif words[0] == "f":
                quad = [w.split("/") for w in words[1:]]
                for k in range(1, len(quad) - 1):
                    corners.append([int(quad[i][0]) - 1 for i in (0, k, k + 1)])
                    places.append([int(quad[i][1]) - 1 for i in (0, k, k + 1)])
        self.vertices, self.uvs = np.array(vertices), np.array(uvs)
        self.faces, self.places = np.array(corners, np.int32), np.array(places)
        self.normals = vertex_normals(self.vertices, self.faces).astype(np.float64)
        self.caster = RayCaster(self.vertices, self.faces)
        self.specular = cv2.imread(str(folder / "maps/specular.jpg"), cv2.IMREAD_GRAYSCALE).astype(np.float64) / 255
        self.albedo = linear_from_srgb(cv2.imread(str(folder / "maps/albedo.jpg"))[..., ::-1].astype(np.float64) / 255)

    def at(self, points: F64, normals: F64) -> tuple[np.ndarray, F64, F64, F64]:
        """(N,) near the true surface; (N, 3) its normals; (N,) specular map; (N, 3) albedo."""
        start = points + 2 * NEAR * normals
        far, face = self.caster.hits(start, -normals)
        near = (face >= 0) & (np.abs(far - 2 * NEAR) < NEAR)
        face, hit = np.maximum(face, 0), start - np.where(np.isfinite(far), far, 0)[:, None] * normals
        weight = barycentric(self.vertices[self.faces[face]], hit)[..., None]
        place = (self.uvs[self.places[face]] * weight).sum(1)
        found = (self.normals[self.faces[face]] * weight).sum(1)
        return (
            near,
            found / np.linalg.norm(found, axis=1, keepdims=True),
            looked(self.specular, place),
            looked(self.albedo, place),
        )


def looked(image: F64, uv: F64) -> F64:
    """Values of a map (row 0 on top) at texture coordinates (N, 2)."""
    height, width = image.shape[:2]
    x = np.clip((uv[:, 0] * width).astype(int), 0, width - 1)
    y = np.clip(((1 - uv[:, 1]) * height).astype(int), 0, height - 1)
    return image[y, x]


def labels_of(capture: Path, camera: int) -> np.ndarray:
    """(H, W) 0 other, 1 skin, 2 eye."""
    return cv2.imread(str(capture / f"truth/labels/{camera}.png"), cv2.IMREAD_GRAYSCALE)


def placed(rig: Rig, capture: Path) -> tuple[dict[int, int], dict[tuple[int, int], Path]]:
    """Place in a rig of each of its lights, and the pictures under single lights by camera and place."""
    place = {index: n for n, index in enumerate(rig.index)}
    return place, {(c, place[n]): path for (c, n), path in pictures_of(capture).single.items() if n in place}


def rig_of_run(run: Path, capture: Path, basis: dict) -> Rig:
    """All lights and cameras of a capture with the run's own motion."""
    from pipeline.artifacts import Camera
    from pipeline.transforms import rows

    motion = {int(f): matrix(m) for f, m in basis["motion"].items()}
    lights = read_lights(capture / "lights.json").lights
    views = given_cameras(capture / "params.json", run)
    cameras = [
        Camera(index=i, name=str(i), width=v.width, height=v.height, K=rows(v.K), world_from_cam=rows(v.world_from_cam),
               distortion=tuple(float(x) for x in v.distortion))
        for i, v in sorted(views.items())
    ]  # fmt: skip
    return rig_of([lights[i] for i in sorted(lights)], cameras, capture_from_asset_of(run), motion)


def single_lights(
    field: Field, rig: Rig, capture: Path, basis: dict, cameras: list[int] | None, out: Path | None
) -> dict:
    """PSNR of left-out lights, of the field and of blending; with cameras, of those alone, also of fitted lights."""
    place, pictures = placed(rig, capture)
    fitted, held = [place[n] for n in basis["lights"]], [place[n] for n in basis["left_out"]]
    mask = {c: labels_of(capture, rig.cameras[c].index) > 0 for c in range(len(rig.cameras))}
    chosen = [n for n, c in enumerate(rig.cameras) if cameras is None or c.index in cameras]
    rows = {}
    for name, lights in (("left-out lights", held), *((("fitted lights", fitted[::6]),) if cameras else ())):
        wanted = [(c, i) for i in lights for c in chosen]
        found = score(field, rig, pictures, fitted, wanted, GAIN, lambda d, n: None, mask)
        rows[name] = {
            "field": decibels([s.field for s in found]), "blend": decibels([s.blend for s in found]),
            "field, mean over pictures": round(float(np.mean([-10 * np.log10(max(s.field, 1e-9)) for s in found])), 2),
            "by camera": {rig.cameras[c].index: decibels([s.field for s in found if s.camera == c]) for c in chosen},
            "angle": round(float(np.mean([s.angle for s in found])), 1),
        }  # fmt: skip
    if out is not None:
        for c, i in [(0, held[1]), (2, held[4]), (4, held[3])]:
            beside(
                field, rig, pictures, fitted, c, i, out / f"light_{rig.index[i]:03d}_camera_{rig.cameras[c].index}.png"
            )
    return rows


def beside(field: Field, rig: Rig, pictures: dict, fitted: list[int], camera: int, light: int, path: Path) -> None:
    """Truth, field, blend of three, and the field's error times 4."""
    from stages.reflectance.field import Lamp

    positions, axes = rig.lamps()
    lamp = Lamp(positions[light], axes[light], rig.strength[light])
    view = camera_at(rig, camera, light)
    made = picture(view, look_up(field, view), lit_by(field, view, lamp, field.arrives(lamp)))[..., :3]
    truth, blend = read_linear(pictures[camera, light]), blended(rig, pictures, fitted, camera, light)[0]
    shown = [encoded(p, GAIN) for p in (truth, made, blend)]
    write_png(path, np.hstack([*shown, np.abs(shown[1] - shown[0]) * 4]).clip(0, 1))


def standard(field: Field, run: Path, rig: Rig, capture: Path, basis: dict) -> dict:
    """PSNR of left-out lights as standard shaders show them, over skin and eyes: on the field's mesh, of which all, or
    only what cameras saw, throws shadows; and on the asset's mesh."""
    place, pictures = placed(rig, capture)
    fitted, held = [place[n] for n in basis["lights"]], [place[n] for n in basis["left_out"]]
    mask = {c: labels_of(capture, rig.cameras[c].index) > 0 for c in range(len(rig.cameras))}
    wanted = [(c, i) for i in held for c in range(len(rig.cameras))]
    stored = read_run(run)
    assert stored is not None
    path = stored.path("uv", stored.manifest("uv")["mesh"])
    mesh, charts = meshes.load(path), meshes.load_charts(path)
    points, rows = points_of(mesh, charts, field.points.size), {}
    asset = Field(mesh, charts, points, field.arrays, field.alphas, field.towards, field.centre)
    for name, one, trimmed in (("whole", field, False), ("trimmed", field, True), ("the asset's mesh", asset, False)):
        shown = OpenPbr.of(one, trimmed=trimmed)
        found = score(one, rig, pictures, fitted, wanted, GAIN, lambda d, n: None, mask, shown)
        rows[name] = decibels([s.standard for s in found])
    return rows


def environments(field: Field, run: Path, capture: Path, rig: Rig, out: Path | None, *, quick: bool) -> dict:
    """PSNR under the truth's environment of the field, and of the plain sum of the captured pictures."""
    lamps = environment(str(capture / "truth/relit/soft.exr"), capture_from_asset_of(run), quick=quick)
    views = {i: v for i, v in given_cameras(capture / "params.json", run).items() if i in (0, 2, 4)}
    found = under_lamps(field, list(views.values()), lamps, lambda d, n: None)
    rows = {}
    for (i, view), lit in zip(views.items(), found, strict=True):
        truth, label = read_linear(capture / f"truth/relit/soft/{i}.exr"), labels_of(capture, i)
        made = picture(view, look_up(field, view), lit)
        made, covered = made[..., :3], made[..., 3] > COVERED
        plain = plain_sum(capture, i)
        errors = {
            n: (encoded(p, SOFT_GAIN) - encoded(truth, SOFT_GAIN)) ** 2 for n, p in (("field", made), ("sum", plain))
        }
        rows[i] = {n: decibels([float(e[label > 0].mean())]) for n, e in errors.items()}
        rows[i] |= {f"{n}, covered": decibels([float(e[(label > 0) & covered].mean())]) for n, e in errors.items()}
        rows[i] |= {f"{n}, eyes": decibels([float(e[label == EYE].mean())]) for n, e in errors.items()}
        if out is not None:
            shown = [encoded(p, SOFT_GAIN) for p in (truth, made, plain)]
            write_png(out / f"soft_{i}.png", np.hstack([*shown, np.abs(shown[1] - shown[0]) * 4]).clip(0, 1))
    return rows


def plain_sum(capture: Path, camera: int) -> F32:
    """Sum of w_i times picture i, w_i = d^2 / intensity_i x the environment's integral over the light's share of the
    sphere: each direction belongs to the nearest light."""
    image = read_linear(capture / "truth/relit/soft.exr").astype(np.float64)
    height, width = image.shape[:2]
    weights = image * latlong_weights(width, height)[..., None]
    lights = read_lights(capture / "lights.json").lights
    index = sorted(lights)
    towards = -np.array([lights[i].axis for i in index])
    owner = np.argmax(latlong_directions(width, height).reshape(-1, 3) @ towards.T, 1)
    total = np.stack([np.bincount(owner, weights[..., c].ravel(), len(index)) for c in range(3)], 1)
    far = json.loads((capture / "lights.json").read_text()).get("light_distance", 1.3)
    out: F32 = np.zeros((1, 1, 3), np.float32)
    for n, i in enumerate(index):
        one = read_linear(capture / f"olat/{camera}/{i:03d}.exr")
        out = out + one * (far**2 / np.array(lights[i].intensity) * total[n]).astype(np.float32)
    return out


def material(field: Field, truth: Truth, capture_from_asset: F64) -> dict:
    """Albedo, F0, roughness and normals of seen texels near the true skin."""
    scale = scale_of(capture_from_asset)
    turn = capture_from_asset[:3, :3] / scale
    seen = field.known
    points, start = apply(capture_from_asset, field.points.position[seen]), field.points.normal[seen] @ turn.T
    near, normals, specular, albedo = truth.at(points, start)
    turned = field.normal[seen] @ turn.T

    def degrees(a: F64) -> float:
        return round(float(np.median(np.degrees(np.arccos(np.clip((a * normals).sum(1)[near], -1, 1))))), 2)

    own = field.albedo[seen][near]
    gain = float((own * albedo[near]).sum() / (own * own).sum())
    error = np.mean((srgb_from_linear(np.clip(own * gain, 0, 1)) - srgb_from_linear(albedo[near])) ** 2)
    f0, roughness = 0.08 * (0.15 + 0.45 * specular[near]), 0.5 - 0.15 * specular[near]
    rows = {
        "texels": int(near.sum()), "normals, surface": degrees(start), "normals, field": degrees(turned),
        "albedo, one gain": round(gain, 3), "albedo": round(float(-10 * np.log10(error)), 2),
    }  # fmt: skip
    for name, made, true in (("F0", field.f0[seen][near], f0), ("roughness", field.roughness[seen][near], roughness)):
        rows[name] = {
            "correlation": round(float(np.corrcoef(made, true)[0, 1]), 3),
            "bias": round(float(np.median(made) / np.median(true) - 1), 3),
        }
    return rows


def motion(basis: dict, capture: Path, capture_from_asset: F64) -> dict:
    """Errors of the head's motion over all frames: of the pivot's place in mm, of the rotation in degrees."""
    content = json.loads((capture / "truth/motion.json").read_text())
    pivot, far, turned = np.array(content["pivot"]), [], []
    for entry in content["frames"]:
        found = basis["motion"].get(str(entry["frame"]))
        if found is None:
            continue
        m = capture_from_asset @ matrix(found) @ np.linalg.inv(capture_from_asset)
        R = np.array(entry["R"])
        far.append(1000 * np.linalg.norm(apply(m, pivot[None])[0] - pivot - entry["t"]))
        cosine = (np.trace(m[:3, :3].T @ R) - 1) / 2
        turned.append(np.degrees(np.arccos(np.clip(cosine, -1, 1))))
    return {"mm": [round(float(q), 3) for q in (np.median(far), max(far))],
            "degrees": [round(float(q), 3) for q in (np.median(turned), max(turned))]}  # fmt: skip


def main() -> None:
    """Print the table as JSON lines."""
    p = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    p.add_argument("run", type=Path)
    p.add_argument("capture", type=Path)
    p.add_argument("--pictures", type=Path)
    p.add_argument("--camera", type=int, action="append", help="only these: of a run that left them out")
    p.add_argument("--quick", action="store_true", help="fewer lamps for the environment")
    p.add_argument(
        "--without", action="append", default=[], choices=["lights", "openpbr", "environment", "material", "motion"]
    )
    options = p.parse_args()
    folder = options.run / "reflectance"
    field, basis = load(folder), json.loads((folder / "basis.json").read_text())
    world, rig = capture_from_asset_of(options.run), rig_of_run(options.run, options.capture, basis)
    parts = {
        "motion": lambda: motion(basis, options.capture, world),
        "material": lambda: material(field, Truth(options.capture / "truth"), world),
        "lights": lambda: single_lights(field, rig, options.capture, basis, options.camera, options.pictures),
        "openpbr": lambda: standard(field, options.run, rig, options.capture, basis),
        "environment": lambda: environments(field, options.run, options.capture, rig, options.pictures,
                                            quick=options.quick),
    }  # fmt: skip
    print(json.dumps({"alphas": basis["alphas"], "size": basis["size"]}))
    for name, measure in parts.items():
        if name not in options.without:
            print(name, json.dumps(measure()), flush=True)


if __name__ == "__main__":
    main()
