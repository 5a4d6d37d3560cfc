"""Checks the template's landmarks on rendered persons whose skin is known.

    python -m benchmarks.hm08.against_persons CAPTURE ...

CAPTURE has photos, truth/skin.obj, truth/cameras.json and truth/landmarks.json (person_c, person_e). The template is
laid on the true skin by identity alone (nearest points, no landmarks after the start). Then in mm: the named true
points against the template's, and what the face network sees in the photos, triangulated, against the template's.
"""

from __future__ import annotations

import json
import sys
from pathlib import Path

import cv2
import numpy as np
from scipy.spatial import cKDTree

from pipeline.artifacts import Camera
from pipeline.faces.find import find_face
from pipeline.faces.landmarks3d import triangulate
from pipeline.meshes import F64, vertex_normals
from pipeline.template.load import load_template
from pipeline.template.model import Template
from pipeline.transforms import apply, rows, umeyama

NAMED = {  # the truth's name: the template's
    "nose_tip": "nose_tip", "mouth_corner_left": "mouth_corner_left", "mouth_corner_right": "mouth_corner_right",
    "chin": "chin", "chin_lowest": "chin_lowest", "eye_inner_left": "eye_inner_left",
    "eye_outer_left": "eye_outer_left", "eye_inner_right": "eye_inner_right", "eye_outer_right": "eye_outer_right",
}  # fmt: skip
STEPS, RIDGE, FAR = 60, 2e-4, 0.008  # rounds; weight of the identity's prior, and how far a point may lie off: metres
SLIDE = 0.15  # weight of an offset along the surface, over that of one across it


def fitted(template: Template, skin: F64, normals: F64, start: F64) -> F64:
    """(V, 3) the template's identity in the skin's place. skin, normals (N, 3); start: 4x4 similarity."""
    assert template.shape is not None
    regions = ("face", "lids", "lips", "nose", "ears", "scalp", "brows")
    seen = np.unique(template.quads[np.concatenate([template.regions[r] for r in regions])])
    tree, weights, place = cKDTree(skin), np.zeros(len(template.shape.basis)), start
    basis = (template.shape.basis * template.shape.deviation[:, None, None])[:, seen]
    for _ in range(STEPS):
        shape = template.identity(weights)[seen]
        distance, nearest = tree.query(apply(place, shape))
        use = distance < max(FAR, float(np.median(distance)) * 3)
        place = umeyama(shape[use], skin[nearest[use]])
        back = np.linalg.inv(place)
        offset = apply(back, skin[nearest[use]]) - template.vertices[seen[use]]
        n = normals[nearest[use]] @ back[:3, :3].T
        n /= np.linalg.norm(n, axis=1, keepdims=True)
        A = basis[:, use]
        across = (A * n).sum(-1)
        flat = SLIDE * A.reshape(len(A), -1)
        left = across @ across.T + flat @ flat.T + RIDGE**2 * use.sum() * np.eye(len(A))
        weights = np.linalg.solve(left, across @ (offset * n).sum(1) + SLIDE * flat @ offset.ravel())
    return apply(place, template.identity(weights))


def read_skin(capture: Path) -> tuple[F64, F64]:
    """(N, 3) vertices of the true skin and their normals."""
    lines = (capture / "truth/skin.obj").read_text().splitlines()
    points = np.array([[float(x) for x in line.split()[1:4]] for line in lines if line.startswith("v ")])
    faces = [[int(c.split("/")[0]) - 1 for c in line.split()[1:]] for line in lines if line.startswith("f ")]
    triangles = np.array([t for f in faces for t in ([f[0], f[k], f[k + 1]] for k in range(1, len(f) - 1))], np.int32)
    return points, vertex_normals(points, triangles).astype(np.float64)


def cameras_of(capture: Path) -> tuple[list[Camera], list[Path]]:
    """True cameras with pixel centres at + 0.5, and the photos."""
    cameras, photos = [], []
    for c in json.loads((capture / "truth/cameras.json").read_text())["photos"]:
        photo = next(p for p in (capture / "images" / c["name"], capture / c["name"]) if p.is_file())
        K = np.array(c["K"], np.float64)
        K[:2, 2] += 0.5
        pose = np.linalg.inv(np.array(c["world_to_camera"]) @ np.array(c["head_motion"]))
        d = tuple(float(x) for x in (*c["distortion"], 0, 0, 0, 0, 0)[:5])
        cameras.append(Camera(index=len(cameras), name=photo.stem, width=c["width"], height=c["height"], K=rows(K),
                              world_from_cam=rows(pose), distortion=d))  # fmt: skip
        photos.append(photo)
    return cameras, photos


def seen_points(capture: Path) -> F64:
    """(468, 3) the face network's landmarks, triangulated with the true cameras."""
    kept, points = [], []
    for camera, photo in zip(*cameras_of(capture), strict=True):
        image = cv2.imread(str(photo))[..., ::-1]
        face = find_face(np.ascontiguousarray(image), camera.width / 2, camera.height / 2, camera.height / 2)
        if face is not None and face.sure > 0.95:
            kept.append(camera)
            points.append(face.points)
    found = triangulate(kept, np.stack(points))
    if found is None:
        raise SystemExit(f"no face in {capture}")
    return found.xyz


def report(capture: Path, template: Template) -> None:
    truth = json.loads((capture / "truth/landmarks.json").read_text())
    skin, normals = read_skin(capture)
    seen = seen_points(capture)
    own = template.landmark_points(template.vertices)
    start = umeyama(own, seen[template.landmarks.network])
    vertices = fitted(template, skin, normals, start)
    at = dict(zip(template.landmarks.names, template.landmark_points(vertices), strict=True))
    front = np.unique(template.quads[np.concatenate([template.regions[r] for r in ("face", "lids", "lips", "nose")])])
    off = cKDTree(skin).query(vertices[front])[0] * 1e3
    print(
        f"{capture.name}: template on the true skin: median {np.median(off):.2f}, 95 % {np.percentile(off, 95):.2f} mm"
    )
    for name, ours in NAMED.items():
        print(f"  {name:20s} {1e3 * np.linalg.norm(at[ours] - truth[name]):5.2f} mm")
    apart = 1e3 * np.linalg.norm(seen[template.landmarks.network] - np.stack(list(at.values())), axis=1)
    print(
        f"  network in photos against template: median {np.median(apart):.2f}, 95 % {np.percentile(apart, 95):.2f} mm"
    )
    worst = np.argsort(-apart)[:8]
    print("  worst: " + ", ".join(f"{template.landmarks.names[i]} {apart[i]:.1f}" for i in worst))


if __name__ == "__main__":
    for folder in sys.argv[1:]:
        report(Path(folder), load_template())
