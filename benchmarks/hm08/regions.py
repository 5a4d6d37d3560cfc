"""Which region of the head each quad belongs to: from the base mesh's texture islands, the supports of shape targets,
what the surroundings hide, and a few lines drawn on the average head.

Lengths are in decimetres, positions those of the average head in the base mesh's frame (x to the person's left, y up,
z to the front). Lines were drawn by eye on pictures of the average head.
"""

from __future__ import annotations

import numpy as np

from benchmarks.hm08.cut import Cut, islands
from benchmarks.hm08.pictures import hit
from pipeline.meshes import F64, Indices, Mask, area_vectors, unit

NAMES = (
    "face", "brows", "lids", "lips", "nose", "nostrils", "ears", "scalp", "neck", "mouth_inside", "sockets", "eyes",
    "teeth", "tongue", "lashes",
)  # fmt: skip
OF_PART = {
    "eye_left": "eyes", "eye_right": "eyes", "teeth_upper": "teeth", "teeth_lower": "teeth", "tongue": "tongue",
    "lashes_left": "lashes", "lashes_right": "lashes",
}  # fmt: skip
HAIRLINE = np.array([[6.60, 0.45], [7.00, 0.62], [7.35, 0.78], [7.70, 1.00], [7.92, 1.14], [8.08, 1.30], [8.10, 2.0]])
JAWLINE = np.array([[-0.50, 6.72], [0.20, 6.62], [0.50, 6.50], [0.90, 6.27], [1.30, 6.13], [2.0, 6.10]])
BROW = np.array([[-0.17, 0.135], [-0.02, 0.168], [0.13, 0.178], [0.25, 0.125]])  # from the left eye's centre
BROW_HALF = 0.042  # of its height
LID_RINGS, LIP_RINGS = 10, 7  # of quads round the eyes' sockets and round the inside of the mouth
EAR, NOSE_MOVED = 0.05, 0.35  # of a target's largest offset, from which a vertex belongs to what the target changes
SMALL = 0.006  # square decimetres: quads of the ear are smaller, those of the head around it larger
HIDDEN = 0.47  # share of the directions over a quad that are open, below which it lies in a nostril
EARS = ("ear-wing-incr", "ear-flap-incr", "ear-lobe-incr")
NOSE = ("nose-volume-incr", "nose-flaring-incr", "nose-point-up", "nose-hump-incr")


def labels(mean: F64, cut: Cut, targets: dict[str, F64]) -> Indices:
    """(Q,) index into NAMES. mean: (V, 3). Mirrored quads get the same one."""
    out = np.zeros(len(cut.quads), np.int64)
    middle = mean[cut.quads].mean(1)
    skin = np.arange(*cut.parts["skin"])
    x, y, z = middle[skin].T
    support = {n: np.linalg.norm(d[cut.rows], axis=1) for n, d in targets.items()}
    _, mouth, one, other, _ = islands(cut)
    _set(out, skin, "nose", _changed(cut, skin, [support[n] for n in NOSE], NOSE_MOVED, 3) & (np.abs(x) < 0.26))
    _set(out, skin, "brows", brow_share(middle[skin], mean, cut) > 0.5)
    _set(out, skin, "scalp", z < np.interp(y, *HAIRLINE.T))
    _set(out, skin, "neck", y < np.interp(z, *JAWLINE.T))
    _set(out, skin, "lids", _within(cut, skin, np.concatenate([one, other]), LID_RINGS))
    _set(out, skin, "lips", _within(cut, skin, mouth, LIP_RINGS))
    nostril = (np.abs(x) < 0.135) & (z > 1.36) & (y > 6.8) & (y < 7.05)
    _set(out, skin, "nostrils", nostril & (_openness(mean, cut, skin) < HIDDEN))
    _set(out, skin, "ears", _ears(mean, cut, skin, support))
    out[mouth] = NAMES.index("mouth_inside")
    out[np.concatenate([one, other])] = NAMES.index("sockets")
    for part, region in OF_PART.items():
        out[slice(*cut.parts[part])] = NAMES.index(region)
    return _both_sides(out, cut)


def _set(out: Indices, skin: Indices, name: str, which: Mask) -> None:
    out[skin[which]] = NAMES.index(name)


def _changed(cut: Cut, skin: Indices, supports: list[F64], least: float, corners: int) -> Mask:
    """(n,) quads of which a target moves so many corners by `least` of its largest offset."""
    moved = np.any([s > least * s.max() for s in supports], axis=0)
    return np.asarray(moved[cut.quads[skin]].sum(1) >= corners, np.bool_)


def _ears(mean: F64, cut: Cut, skin: Indices, support: dict[str, F64]) -> Mask:
    """(n,) what moves when an ear is bent or its lobe grows, and the small quads next to that."""
    both = [np.maximum(support[f"l-{n}"], support[f"r-{n}"]) for n in EARS]
    found = _changed(cut, skin, both, EAR, 2) & (np.abs(mean[cut.quads[skin]].mean(1)[:, 0]) > 0.5)
    size = np.linalg.norm(_area_vectors(mean, cut.quads[skin]), axis=1)
    near = found.copy()
    for _ in range(2):
        touched = np.zeros(len(mean), np.bool_)
        touched[cut.quads[skin[near]]] = True
        near |= touched[cut.quads[skin]].any(1) & (size < SMALL)
    return near


def _within(cut: Cut, skin: Indices, seed: Indices, rings: int) -> Mask:
    """(n,) quads of the skin in so many rings round some quads, those aside."""
    reached = np.zeros(len(cut.rows), np.bool_)
    reached[cut.quads[seed]] = True
    for _ in range(rings):
        found = reached[cut.quads[skin]].any(1)
        reached[cut.quads[skin[found]]] = True
    return np.asarray(found, np.bool_)


def _area_vectors(mean: F64, quads: Indices) -> F64:
    """(n, 3) along each quad's normal, as long as its area."""
    return area_vectors(mean, quads[:, :3]) + area_vectors(mean, quads[:, [0, 2, 3]])


def eye_centres(mean: F64, cut: Cut) -> F64:
    """(2, 3) left, right."""
    return np.stack([mean[np.unique(cut.part(p))].mean(0) for p in ("eye_left", "eye_right")])


def brow_share(points: F64, mean: F64, cut: Cut) -> F64:
    """(n,) 1 in the middle of a brow, 0.5 at its edge, 0 away from it; for points on the front."""
    left, _ = eye_centres(mean, cut)
    at = np.abs(points[:, 0]) - left[0], points[:, 1] - left[1]
    height = np.interp(at[0], *BROW.T)
    half = BROW_HALF * np.interp(at[0], [-0.17, -0.05, 0.1, 0.25], [0.9, 1.0, 0.8, 0.35])
    end = np.minimum(at[0] - BROW[0, 0], BROW[-1, 0] - at[0]) / 0.02 + 0.5
    inside = 1 - np.abs(at[1] - height) / (2 * half)
    front = points[:, 2] > 0.9
    return np.asarray(np.clip(np.minimum(inside, end), 0, 1) * front, np.float64)


def _openness(mean: F64, cut: Cut, skin: Indices, rays: int = 96) -> F64:
    """(n,) share of the directions over each quad in which nothing of the head is in the way."""
    quads = cut.quads[skin]
    every = np.concatenate([cut.quads[:, [0, 1, 2]], cut.quads[:, [0, 2, 3]]])
    normal = unit(_area_vectors(mean, quads))
    k = np.arange(rays) + 0.5
    z, turn = 1 - 2 * k / rays, np.pi * (1 + 5**0.5) * k
    sphere = np.stack([np.sqrt(1 - z * z) * np.cos(turn), np.sqrt(1 - z * z) * np.sin(turn), z], 1)
    start = mean[quads].mean(1) + 2e-3 * normal
    above = normal @ sphere.T > 0
    origin, direction = np.repeat(start, rays, 0), np.tile(sphere, (len(skin), 1))
    blocked = (hit(mean, every, origin, direction)[0] >= 0).reshape(-1, rays)
    return np.asarray((above & ~blocked).sum(1) / above.sum(1), np.float64)


def mirrored_quads(cut: Cut) -> Indices:
    """(Q,) the quad on the other side of each."""
    key = {tuple(sorted(q)): i for i, q in enumerate(cut.quads.tolist())}
    return np.array([key[tuple(sorted(q))] for q in cut.mirror[cut.quads].tolist()])


def _both_sides(label: Indices, cut: Cut) -> Indices:
    """The label of the left quad of each pair, for both."""
    other = mirrored_quads(cut)
    return label[np.minimum(np.arange(len(label)), other)]
