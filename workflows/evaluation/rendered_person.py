"""A run's asset against a rendered person: skin and face in mm, depth of the face along rays, albedo, PSNR by label.

    truth/skin.obj        the skin, metres, in the head's own frame
    truth/cameras.json    photos: name, K (centre of the first pixel at 0), distortion, world_to_camera, head_motion,
                          so that world_to_camera @ head_motion leads from the head's frame to the camera
    truth/labels/STEM.png 0 background, 1 skin, 2 hair, 3 eyes, 4 cloth
    truth/landmarks.json  points; `eye_*` and `mouth_*` give the place of the face
    truth/albedo/STEM.exr linear albedo of the skin, alpha: share of the pixel that is skin

The asset comes into the head's frame by the similarity that takes the run's camera centres to the true ones
(Umeyama 1991), then by a few rounds of closest points [Chen and Medioni 1991] with scale on the skin: cameras that were
solved from photos of a head that moves are a millimetre off, and that is not the surface's fault.

Skin: points of skin.obj that at least three photos show as skin; distance to the asset. Face: those of them that are
within 75 mm of the middle of eyes and mouth and look to the front. Depth: how far the asset lies in front of or behind
such a point on the ray of the photo that sees it most squarely; a surface in shreds has a near point everywhere, but
not the right depth.
"""

from __future__ import annotations

import json
from dataclasses import dataclass
from pathlib import Path, PurePath
from typing import Any

import numpy as np
import numpy.typing as npt

from pipeline.camera import PinholeCamera
from pipeline.transforms import apply, corner_K_from_centre_K, inverse_rigid, matrix, rigid, scale_of, umeyama
from workflows.bench.captures_figures import Figures, Run
from workflows.evaluation import geometry
from workflows.evaluation.albedo import Labels, albedo_figures
from workflows.evaluation.geometry import F64, SEEN_BY, Mask
from workflows.evaluation.held_out import held_out_exr

SKIN = 1
NAMES = {"skin": SKIN, "hair": 2, "eyes": 3, "cloth": 4}
EDGE = 4  # pixels inside the outline that count as the outline: its blur is not the surface's
FACE_RADIUS = 0.075  # metres around the middle of eyes and mouth: brow to chin, without the ears
FRONT_Z = 0.1  # of the normal
SQUARE = 0.15  # cosine under which a photo shows a point too much from the side
POINTS = 40_000  # spread over the skin
ROUNDS, CLOSEST, REFINED = 25, 0.8, 10_000  # of the closest points: rounds, share that counts, points
FARTHEST = 0.02  # metres: what is further off is another surface
# What errors of solved cameras explain: beyond it the surface is wrong, and no alignment may hide that.
LARGEST_MOVE, LARGEST_GROWTH = 0.01, 0.03  # metres; of the scale


def measure(run: Run, truth: Path) -> tuple[Figures, Labels]:
    """All of it; figures without an aligned asset are left out."""
    cameras = true_cameras(truth)
    labels = by_label(run, truth)
    placed = placed_on_skin(run, truth, cameras)
    if placed is None:
        return {}, labels
    asset, st, points, normals, sight = placed.asset, placed.st, placed.points, placed.normals, placed.sight
    seen = sight.sum(1) >= SEEN_BY
    face = seen & near_face(truth, points, normals)
    off = 1000 * geometry.distances(asset, points[seen])
    eyes = np.array([c.eye for c in cameras.values()])
    depth = 1000 * depths(asset, points[face], eyes[squarest(points[face], normals[face], eyes, sight[face])])
    found = {"skin_mean_mm": off.mean(), "skin_median_mm": np.median(off), "face_missed": np.isnan(depth).mean()}
    there = np.abs(depth[np.isfinite(depth)])
    if len(there):
        found |= {"depth_median_mm": np.median(there), "depth_p95_mm": np.percentile(there, 95)}
    figures: Figures = {k: round(float(v), 4) for k, v in found.items()}
    return figures | albedo_figures(run, truth, asset, st, cameras), labels


# ------------------------------------------------------------------ where things are
@dataclass(frozen=True, slots=True)
class Placed:
    """asset: the mesh in the head's frame, head_from_asset (4, 4) the similarity that brought it there; st (F, 3, 2) of
    its corners. points, normals (N, 3) of the true skin; sight (N, cameras): see sight_of."""

    asset: Any
    st: F64
    head_from_asset: F64
    points: F64
    normals: F64
    sight: Mask


def placed_on_skin(run: Run, truth: Path, cameras: dict[str, PinholeCamera]) -> Placed | None:
    """The asset in the head's frame, by the cameras and then by the skin; None with too few cameras in common."""
    import trimesh

    by_cameras = head_from_asset(run, cameras)
    if by_cameras is None:
        return None
    asset, st = geometry.asset_mesh(run.out / run.record["asset"], by_cameras)
    skin = trimesh.load(truth / "skin.obj", process=False, force="mesh")
    points, normals = geometry.spread(skin, POINTS)
    sight = sight_of(skin, points, normals, cameras, truth)
    closer = refined(asset, points[sight.sum(1) >= SEEN_BY])
    return Placed(asset.copy().apply_transform(closer), st, closer @ by_cameras, points, normals, sight)


def true_cameras(truth: Path) -> dict[str, PinholeCamera]:
    """By the photo's stem, in the head's frame."""
    out = {}
    for photo in json.loads((truth / "cameras.json").read_text())["photos"]:
        motion = matrix(photo.get("head_motion", np.eye(4)))
        stem = PurePath(photo["name"]).stem
        out[stem] = PinholeCamera(
            corner_K_from_centre_K(matrix(photo["K"])),
            inverse_rigid(matrix(photo["world_to_camera"]) @ motion),
            int(photo["width"]),
            int(photo["height"]),
            np.pad(np.array(photo.get("distortion", []), np.float64), (0, 5))[:5],
        )
    return out


def head_from_asset(run: Run, cameras: dict[str, PinholeCamera]) -> F64 | None:
    """4x4 similarity by the centres of the run's cameras; None with fewer than three in common."""
    refined = {c["index"]: c["world_from_cam"] for c in run.manifest("inverse_rendering").get("refined", [])}
    own = {
        PurePath(c["name"]).stem: matrix(refined.get(c["index"], c["world_from_cam"]))[:3, 3]
        for c in run.manifest("poses")["cameras"]
    }
    both = [stem for stem in own if stem in cameras]
    if len(both) < SEEN_BY:
        return None
    return umeyama(np.array([own[s] for s in both]), np.array([cameras[s].eye for s in both]))


def sight_of(skin: Any, points: F64, normals: F64, cameras: dict[str, PinholeCamera], truth: Path) -> Mask:
    """(N, cameras) whether a photo shows each point, and as skin."""
    out = np.zeros((len(points), len(cameras)), np.bool_)
    for column, (stem, camera) in enumerate(cameras.items()):
        path = truth / "labels" / f"{stem}.png"
        if path.is_file():
            is_skin = (read_labels(path) == SKIN).astype(np.float32)
            out[:, column] = geometry.visible(skin, points, normals, camera, SQUARE, is_skin)
    return out


def near_face(truth: Path, points: F64, normals: F64) -> Mask:
    """(N,) around the middle of eyes and mouth, looking to the front."""
    marks = json.loads((truth / "landmarks.json").read_text())
    named = [v for k, v in marks.items() if k.startswith(("eye_", "mouth_")) and isinstance(v, list)]
    around = np.linalg.norm(points - np.mean(np.array(named, np.float64), 0), axis=1) < FACE_RADIUS
    return np.asarray(around & (normals[:, 2] > FRONT_Z))


def refined(asset: Any, points: F64) -> F64:
    """4x4 similarity that brings the asset closer to the points: point to plane, the farthest fifth left out. No change
    where it would be larger than the cameras' errors can be."""
    from scipy.spatial import cKDTree

    total: F64 = np.eye(4)
    if not len(points):
        return total
    samples, normals = geometry.spread(asset, 10 * geometry.SURFACE_SAMPLES)
    tree, target = cKDTree(samples), points[:: max(1, len(points) // REFINED)]
    for _ in range(ROUNDS):
        inverse = matrix(np.linalg.inv(total))
        distance, nearest = tree.query(apply(inverse, target))
        keep = distance <= min(float(np.quantile(distance, CLOSEST)), FARTHEST)
        if keep.sum() < 7:  # as many as there are unknowns
            return total
        scale = scale_of(total)
        on, plane = apply(total, samples[nearest[keep]]), normals[nearest[keep]] @ total[:3, :3].T / scale
        total = _step(on, plane, target[keep]) @ total
    moved = np.linalg.norm(apply(total, target) - target, axis=1).max()
    grown = abs(scale_of(total) - 1)
    return total if moved < LARGEST_MOVE and grown < LARGEST_GROWTH else np.eye(4)


def _step(on: F64, plane: F64, target: F64) -> F64:
    """The small similarity that takes `on` to the target along the planes' normals, least squares."""
    from scipy.spatial.transform import Rotation

    middle = target.mean(0)
    arm = on - middle
    unknown = np.concatenate([np.cross(arm, plane), plane, (arm * plane).sum(1, keepdims=True)], 1)
    wanted = ((target - on) * plane).sum(1)
    turn, shift, grow = np.split(np.linalg.lstsq(unknown, wanted, rcond=None)[0], [3, 6])
    linear = (1 + grow[0]) * Rotation.from_rotvec(turn).as_matrix()
    return rigid(linear, middle + shift - linear @ middle)


# ------------------------------------------------------------------ depth
def squarest(points: F64, normals: F64, eyes: F64, sight: Mask) -> npt.NDArray[np.int64]:
    """(N,) which of the eyes (C, 3) that see a point looks at it most squarely."""
    towards = eyes[None] - points[:, None]
    towards /= np.linalg.norm(towards, axis=2, keepdims=True)
    cosine = np.where(sight, (towards * normals[:, None]).sum(2), -1.0)
    return np.asarray(cosine.argmax(1), np.int64)


def depths(asset: Any, points: F64, eyes: F64) -> F64:
    """(N,) how far the asset lies before (+) or behind (-) each point on the ray from its eye (N, 3); NaN where the ray
    meets nothing."""
    out = np.full(len(points), np.nan)
    if not len(points):
        return out
    reach = np.linalg.norm(points - eyes, axis=1)
    directions = (points - eyes) / reach[:, None]
    met, ray, _ = asset.ray.intersects_location(eyes, directions, multiple_hits=False)
    out[ray] = reach[ray] - np.linalg.norm(met - eyes[ray], axis=1)
    return out


# ------------------------------------------------------------------ labels
def by_label(run: Run, truth: Path) -> Labels:
    """PSNR of model and asset on held-out views over each label's pixels, and over the outline, with the label's share
    of all pixels and of the whole squared error."""
    from pipeline.images import read_exr, read_linear, shrink_whole

    out: Labels = {}
    for kind, name in (("views", "model"), ("asset_views", "asset")):
        total: dict[str, tuple[float, int]] = {}
        for view in run.manifest("capture").get("views", []):
            render = held_out_exr(run.out, kind, view["index"])
            labels = truth / "labels" / f"{PurePath(view['name']).stem}.png"
            if not (view.get("holdout") and render.is_file() and labels.is_file()):
                continue
            got, photo = read_exr(render)[0][..., :3], read_linear(run.path("capture", view["image"]))
            factor = max(1, photo.shape[0] // got.shape[0])
            h, w = got.shape[:2]
            want = shrink_whole(photo, factor)[:h, :w]
            label = read_labels(labels)[factor // 2 :: factor, factor // 2 :: factor][:h, :w]
            error = ((geometry.as_seen(got) - geometry.as_seen(want)) ** 2).mean(2)
            for part, mask in _parts(label).items():
                before = total.get(part, (0.0, 0))
                total[part] = (before[0] + float(error[mask].sum()), before[1] + int(mask.sum()))
        if total:
            out[name] = _shares(total)
    return out


def _parts(label: npt.NDArray[np.uint8]) -> dict[str, Mask]:
    from scipy.ndimage import binary_erosion

    side = 2 * EDGE + 1
    inner = binary_erosion(label > 0, np.ones((side, side)), border_value=1)
    parts = {name: (label == code) & inner for name, code in NAMES.items()}
    return {**parts, "outline": (label > 0) & ~inner}


def _shares(total: dict[str, tuple[float, int]]) -> dict[str, dict[str, float]]:
    error, pixels = (max(sum(t[i] for t in total.values()), 1e-12) for i in (0, 1))
    return {
        part: {
            "psnr": round(float(-10 * np.log10(max(e / n, 1e-10))), 3),
            "pixels": round(n / pixels, 4),
            "error": round(e / error, 4),
        }
        for part, (e, n) in total.items()
        if n
    }


def read_labels(path: Path) -> npt.NDArray[np.uint8]:
    from pipeline.images import read_encoded

    return np.asarray(read_encoded(path)[..., 0], np.uint8)
