"""How far an asset's hair is from pictures that label every pixel of the photos.

    python -m benchmarks.hair_against_labels RUN_DIR LABELS_DIR [--hair 2] [--all] [--each]

RUN_DIR is a finished run with uv.mesh=template whose store is still there. LABELS_DIR has a PNG with the name of each
photo, with the code --hair where it shows hair. The held-out photos (--all: every photo) are compared with what the
asset's mesh shows to their cameras: hair, or anything else. The labels' hair has beard, brows and lashes in it, which
the asset keeps with its skin: pixels that show brows, lids, lips, nose, or the face or neck below the eyes and in front
of the ears are not asked.
"""

from __future__ import annotations

import argparse
import json
from pathlib import Path
from typing import Any

import cv2
import numpy as np
import numpy.typing as npt

from pipeline import meshes
from pipeline.artifacts import Located
from pipeline.ray_casting import RayCaster
from pipeline.registration.head import load_head, of_triangles
from pipeline.store import Store
from pipeline.template.load import load_template
from pipeline.transforms import matrix, rays
from stages.registry import REGISTRY

NEEDED = ("capture", "poses", "template", "uv")
KEPT_WITH_SKIN = ("brows", "lids", "lips", "nose", "nostrils", "eyes")
BELOW_EYES, IN_FRONT = -0.012, 0.0  # on the template, m
Bool = npt.NDArray[np.bool_]


def agreement(hair: Bool, truth: Bool, asked: Bool) -> tuple[int, int, int]:
    """Pixels of both, of either, and of the truth alone, among those asked. All (H, W)."""
    a, b = hair & asked, truth & asked
    return int((a & b).sum()), int((a | b).sum()), int(b.sum())


def found_in(run: Path) -> dict[str, Located[Any]]:
    """Artifacts of the run that the comparison needs."""
    record = json.loads((run / "run.json").read_text())
    store, by_name, out = Store(Path(record["store"])), {s.name: s for s in REGISTRY}, {}
    for name in NEEDED:
        artifact = store.load(name, record["stages"][name]["key"], by_name[name].output)
        if artifact is None:
            raise SystemExit(f"{run}: its {name} is no longer in the store {store.root}; run it again")
        out[name] = artifact
    return out


def not_asked(head: Located[Any], count: int) -> Bool:
    """(F,) triangles of the textured mesh, `count` in all, whose hair is the skin's."""
    own, names, template = load_head(head.path(head.artifact.head)), head.artifact.regions, load_template()
    middle = template.vertices[template.quads].mean(1)
    low = (middle[:, 1] < BELOW_EYES) & (middle[:, 2] > IN_FRONT)
    kept = np.array([n in KEPT_WITH_SKIN for n in names])[own.region]
    kept |= low & np.array([n in ("face", "neck") for n in names])[own.region]
    out = np.zeros(count, np.bool_)
    of = of_triangles(own, kept.astype(np.int64), names)
    out[: len(of)] = of > 0
    return out


def main() -> None:
    """Compare, print."""
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("run", type=Path)
    parser.add_argument("labels", type=Path)
    parser.add_argument("--hair", type=int, default=2)
    parser.add_argument("--all", action="store_true", help="fitted photos too")
    parser.add_argument("--each", action="store_true", help="a line for each photo")
    args = parser.parse_args()
    found = found_in(args.run)
    uv = found["uv"]
    mesh = meshes.load(uv.path(uv.artifact.mesh))
    caster, first = RayCaster(mesh.vertices, mesh.faces), len(mesh.faces) - uv.artifact.hair_faces
    skipped = not_asked(found["template"], len(mesh.faces))
    views = {v.index: v for v in found["capture"].artifact.views}
    rows = []
    for camera in found["poses"].artifact.cameras:
        view = views[camera.index]
        labels = cv2.imread(str(args.labels / f"{Path(view.name).stem}.png"), cv2.IMREAD_GRAYSCALE)
        if labels is None or not (args.all or view.holdout):
            continue
        v, u = np.mgrid[: camera.height, : camera.width] + 0.5
        at = np.stack([u.ravel(), v.ravel()], 1)
        origin, toward = rays(matrix(camera.K), matrix(camera.world_from_cam), np.array(camera.distortion), at)
        face = caster.first_faces(np.broadcast_to(origin, toward.shape), toward)
        shape, hit = (camera.height, camera.width), face >= 0
        truth = cv2.resize(labels, shape[::-1], interpolation=cv2.INTER_NEAREST) == args.hair
        asked = ~(hit & skipped[np.maximum(face, 0)]).reshape(shape)
        rows.append(agreement((face >= first).reshape(shape), truth, asked))
        if args.each:
            both, either, own = rows[-1]
            print(f"{view.name}: IoU {both / max(either, 1):.3f}, {both / max(own, 1):.1%} of the hair found")
    if not rows:
        raise SystemExit(f"{args.labels}: no labels of these photos")
    both, either, own = np.array(rows).sum(0)
    print(f"{len(rows)} photos: IoU {both / max(either, 1):.3f}, {both / max(own, 1):.1%} of the hair found, "
          f"{(either - own) / max(own, 1):.1%} added")  # fmt: skip


if __name__ == "__main__":
    main()
