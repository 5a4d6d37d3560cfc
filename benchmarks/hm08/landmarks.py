"""Where the face network's landmarks lie on the template: it looks at pictures of it, as it will at a person's photos.

Pictures of several heads of the identity basis, each from VIEWS directions; the network's points are triangulated
(pipeline.faces.landmarks3d) and laid on the nearest place of the head's skin. As barycentric points they are places of
the topology, the same for all heads: the median over heads counts. Left and right are averaged. A landmark on which
heads, views or sides disagree is left out.
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np

from benchmarks.hm08 import pictures
from benchmarks.hm08.cut import Cut
from benchmarks.hm08.landmark_names import ABOVE, MIDDLE, PAIRS
from benchmarks.hm08.regions import NAMES, brow_share, eye_centres
from pipeline.artifacts import Camera
from pipeline.faces.find import find_face
from pipeline.faces.landmarks3d import residuals, triangulate
from pipeline.meshes import F64, Faces, Indices, Mask
from pipeline.transforms import rows as nested

VIEWS = tuple((a, e) for e in (-12.0, 0.0, 14.0) for a in (-33.0, -12.0, 12.0, 33.0))  # degrees
SIZE, RADIUS = 512, 1.7  # pixels; decimetres
COLOURS = {  # linear albedo
    "lips": (0.42, 0.17, 0.15), "scalp": (0.05, 0.035, 0.025), "nostrils": (0.2, 0.1, 0.08),
    "mouth_inside": (0.2, 0.06, 0.06), "sockets": (0.12, 0.07, 0.06), "lids": (0.5, 0.31, 0.25),
}  # fmt: skip
SKIN, BROW, WHITE, IRIS, PUPIL = (
    np.array(c) for c in ((0.6, 0.4, 0.31), (0.06, 0.04, 0.03), (0.75, 0.72, 0.7), (0.12, 0.07, 0.04), (0.005,) * 3)
)
IRIS_COSINE, PUPIL_COSINE = 0.913, 0.985  # of the angle to the front, seen from the eye's centre
SIDES_AGREE, HEADS_AGREE, ON_SKIN = (
    0.035,
    0.04,
    0.06,
)  # decimetres: largest half difference, spread, distance to the skin
VIEWS_AGREE = 0.02  # of the face's size in a picture


@dataclass(frozen=True, slots=True)
class Found:
    """names, network (L,) number in the face network's 468, corners (L, 3) vertices and weights (L, 3); left_out: names
    with the reason."""

    names: list[str]
    network: Indices
    corners: Indices
    weights: F64
    left_out: dict[str, str]


def picture(vertices: F64, cut: Cut, label: Indices, shot: pictures.Shot) -> pictures.U8:
    """Something like a person with skin, brows, eyes, lips and short hair. Without lashes: as sheets they hide lids."""
    shown = np.flatnonzero(label != NAMES.index("lashes"))
    triangles = cut.quads[shown][:, [0, 1, 2, 0, 2, 3]].reshape(-1, 3)
    seen = pictures.traced(vertices, triangles.astype(np.int32), shot)
    region = np.array(NAMES)[label[shown[seen.triangle // 2]]]
    colour = np.tile(SKIN, (len(region), 1))
    for name, value in COLOURS.items():
        colour[region == name] = value
    bare = np.isin(region, ["face", "brows", "nose"])
    dark = np.clip(brow_share(seen.position, vertices, cut) * 2.5, 0, 0.9)[:, None] * bare[:, None]
    colour = colour * (1 - dark) + BROW * dark
    for centre in eye_centres(vertices, cut):
        away = seen.position - centre
        cosine = away[:, 2] / np.maximum(np.linalg.norm(away, axis=1), 1e-9)
        own = (region == "eyes") & (np.abs(away[:, 0]) < 0.2)
        for value, least in ((WHITE, -1.0), (IRIS, IRIS_COSINE), (PUPIL, PUPIL_COSINE)):
            colour[own & (cosine > least)] = value
    return pictures.shaded(seen, colour, shot)


def seen_landmarks(vertices: F64, cut: Cut, label: Indices) -> tuple[F64, F64]:
    """(468, 3) in space and (468,) the views' median residual over the face's size."""
    centre = eye_centres(vertices, cut).mean(0) + [0, -0.25, -0.6]
    cameras, points = [], []
    for k, (azimuth, elevation) in enumerate(VIEWS):
        shot = pictures.orbit(centre, RADIUS, azimuth, elevation, SIZE)
        face = find_face(picture(vertices, cut, label, shot), SIZE / 2, SIZE / 2, SIZE / 2)
        if face is not None:
            pose = nested(shot.world_from_cam)
            cameras.append(Camera(index=k, name=str(k), width=SIZE, height=SIZE, K=nested(shot.K),
                                  world_from_cam=pose, distortion=(0, 0, 0, 0, 0)))  # fmt: skip
            points.append(face.points)
    uv = np.stack(points)
    found = triangulate(cameras, uv)
    if found is None or found.kept.sum() < len(VIEWS) - 3:
        raise SystemExit("the face network does not see a face in the pictures")
    off = residuals(cameras, uv, found.xyz)[found.kept]
    return found.xyz, np.median(off, 0) / np.ptp(uv[0], axis=0).max()


def find_landmarks(mean: F64, heads: list[F64], cut: Cut, label: Indices, v: F64) -> Found:
    """The landmarks of MIDDLE and PAIRS on the skin. heads: (V, 3) each; v: (Q, 4) texture coordinate, which tells
    what is above an opening from what is below it, even where the lips touch."""
    skin = np.isin(np.array(NAMES)[label], ["face", "brows", "lids", "lips", "nose"])
    xyz, spread = [], []
    for head in heads:
        seen, off = seen_landmarks(head, cut, label)
        xyz.append(seen)
        spread.append(off)
    chooser = _Places(mean, heads, cut, skin, label, v)
    names, network, at, left_out = [], [], [], {}
    views = np.median(spread, 0)
    for name, number in MIDDLE.items():
        here, fault = chooser.place(name, [x[number] for x in xyz])
        fault = fault or _off("sides", abs(here[0]), SIDES_AGREE) or _off("views", views[number], VIEWS_AGREE)
        if fault:
            left_out[name] = fault
            continue
        names.append(name)
        network.append(number)
        at.append(here * [0, 1, 1])
    for name, (right, left) in PAIRS.items():
        one, fault_one = chooser.place(name, [x[left] for x in xyz])
        two, fault_two = chooser.place(name, [x[right] for x in xyz])
        both = (one + two * [-1, 1, 1]) / 2
        apart = float(np.linalg.norm(one - both))
        view = max(views[right], views[left])
        fault = fault_one or fault_two or _off("sides", apart, SIDES_AGREE) or _off("views", view, VIEWS_AGREE)
        if fault:
            left_out[name] = fault
            continue
        for side, number, flip in (("left", left, 1), ("right", right, -1)):
            names.append(f"{name}_{side}")
            network.append(number)
            at.append(both * [flip, 1, 1])
    corners, weights = chooser.on_template(names, np.array(at))
    return Found(names, np.array(network), corners, weights, left_out)


def _off(what: str, value: float, limit: float) -> str:
    return "" if value <= limit else f"{what} disagree: {value:.3f}, limit {limit}"


@dataclass(frozen=True, slots=True)
class _Places:
    """Finds places on the skin; see `find_landmarks`."""

    mean: F64
    heads: list[F64]
    cut: Cut
    skin: Mask
    label: Indices
    v: F64

    def place(self, name: str, seen: list[F64]) -> tuple[F64, str]:
        """(3,) on the mean head: the median over heads of the nearest place; and why it can't be used, or nothing."""
        triangles = self._triangles(name, seen[0][1])
        there, far = [], []
        for head, point in zip(self.heads, seen, strict=True):
            row, weights, distance = nearest(head[triangles], point)
            there.append((self.mean[triangles[row]] * weights[:, None]).sum(0))
            far.append(distance)
        middle = np.median(there, 0)
        spread = float(np.median(np.linalg.norm(np.array(there) - middle, axis=1)))
        return middle, _off("heads", spread, HEADS_AGREE) or _off("skin and point", float(np.median(far)), ON_SKIN)

    def on_template(self, names: list[str], points: F64) -> tuple[Indices, F64]:
        """(L, 3) corners and weights on the mean head. The right one of a pair is the mirrored left one."""
        corners, weights, done = [], [], {}
        for name, point in zip(names, points, strict=True):
            stem, _, side = name.rpartition("_")
            if side == "right":
                c, w = done[stem]
                corners.append(self.cut.mirror[c])
                weights.append(w)
                continue
            triangles = self._triangles(name, point[1])
            row, weight, _ = nearest(self.mean[triangles], point)
            if side == "left":
                done[stem] = triangles[row], weight
            corners.append(triangles[row])
            weights.append(weight if side == "left" else self._in_the_middle(triangles[row], weight))
        return np.array(corners), np.array(weights)

    def _in_the_middle(self, corners: Indices, weights: F64) -> F64:
        """Weights of the corners on the middle line alone."""
        own = weights * (self.cut.mirror[corners] == corners)
        if own.sum() < 0.5:
            raise SystemExit("a landmark of the middle is not on the middle line")
        return np.asarray(own / own.sum(), np.float64)

    def _triangles(self, name: str, height: float) -> Faces:
        """(n, 3) triangles on which the landmark may lie."""
        which = self.skin.copy()
        region = np.array(NAMES)[self.label]
        middle = self.v.mean(1)
        for opening, near, prefix in (("sockets", "lids", "lid_"), ("mouth_inside", "lips", "lip_")):
            if name.startswith(prefix):
                at = middle[region == opening].mean()
                which = region == near
                which &= middle > at if name.startswith(ABOVE) else middle < at
        if name.startswith("mouth_corner"):
            which = np.isin(region, ["lips", "face"])
        quads = self.cut.quads[which]
        return np.asarray(np.concatenate([quads[:, [0, 1, 2]], quads[:, [0, 2, 3]]]), np.int32)


def nearest(triangles: F64, point: F64) -> tuple[int, F64, float]:
    """Row, barycentric weights (3,) and distance of the place of triangles (n, 3, 3) that is nearest to a point."""
    from trimesh.triangles import closest_point, points_to_barycentric

    found = closest_point(triangles, np.broadcast_to(point, (len(triangles), 3)))
    distance = np.linalg.norm(found - point, axis=1)
    row = int(distance.argmin())
    weights = points_to_barycentric(triangles[row : row + 1], found[row : row + 1])[0]
    weights = np.clip(weights, 0, 1)
    return row, np.asarray(weights / weights.sum(), np.float64), float(distance[row])
