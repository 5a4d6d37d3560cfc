"""The identity basis: what the shape targets can make of the head, as principal components.

Symbols: T targets; w (T,) a person's weights; D (T, V, 3) the targets' offsets without their rigid motion;
x = base + sum_t w_t D_t. Persons are sampled (SAMPLES, fixed seed) as MakeHuman mixes them:

    macro targets   ancestry a (3), sex s (2), age g (3), each >= 0 with sum 1: weight a_i s_j g_k
    other targets   opposite ones are one signed weight; those of left and right are a common part and a small own one

A person and the mirrored person are equally likely. So the components are each symmetric or antisymmetric, exactly.
"""

from __future__ import annotations

import re
from dataclasses import dataclass

import numpy as np

from benchmarks.hm08.cut import Cut, joint_centres
from benchmarks.hm08.source import MACRO, Source
from pipeline.meshes import F64, Indices

SAMPLES, SEED = 20_000, 8
KEPT, MOST = 0.995, 100  # share of the variance that is wanted, and the most components for it
SPREAD, OWN = 0.28, 0.07  # standard deviations of weights, and of what left and right differ by
ASYMMETRY = 0.15
CHILDREN = 0.1  # share of the sampled persons
OPPOSITE = {
    "incr": "decr", "up": "down", "out": "in", "forward": "backward", "convex": "concave", "uncompress": "compress",
}  # fmt: skip


@dataclass(frozen=True, slots=True)
class Identity:
    """mean (V, 3); basis (K, V, 3) of unit length and orthogonal; deviation (K,) the persons' standard deviation along
    each; joints (J, 3) of the mean, joint_basis (K, J, 3) per unit of the basis; symmetric (K,) bool; variance: share
    that the basis keeps. Decimetres."""

    mean: F64
    basis: F64
    deviation: F64
    joints: F64
    joint_basis: F64
    symmetric: np.ndarray
    variance: float


def sampled_weights(names: list[str], samples: int, seed: int) -> F64:
    """(samples, T) weights of the named targets for as many persons."""
    random = np.random.default_rng(seed)
    out = np.zeros((samples, len(names)))
    column = {n: i for i, n in enumerate(names)}
    macro = _macro_weights(random, samples)
    common: dict[str, F64] = {}
    for name in names:
        if MACRO.fullmatch(name):
            out[:, column[name]] = macro[name]
            continue
        positive, negative = _opposites(name, column)
        if name != positive:
            continue  # done with the other one
        value = _value(random, positive, samples, common)
        out[:, column[positive]] = np.maximum(value, 0)
        if negative is not None:
            out[:, column[negative]] = np.maximum(-value, 0)
    return out


def _value(random: np.random.Generator, name: str, samples: int, common: dict[str, F64]) -> F64:
    """(samples,) signed weight of a pair of targets, between -1 and 1."""
    if name.startswith("asym-"):
        return np.clip(ASYMMETRY * random.standard_normal(samples), -1, 1)
    place = re.sub(r"^[lr]-", "", name)
    if place not in common:
        common[place] = SPREAD * random.standard_normal(samples)
    own = OWN * random.standard_normal(samples) if place != name else 0.0
    return np.clip(common[place] + own, -1, 1)


def _opposites(name: str, known: dict[str, int]) -> tuple[str, str | None]:
    """The positive and the negative target of a pair; one without an opposite is positive."""
    stem, _, last = name.rpartition("-")
    if stem.startswith("asym-"):
        return f"{stem}-l", f"{stem}-r"
    for up, down in OPPOSITE.items():
        if last in (up, down) and f"{stem}-{up}" in known and f"{stem}-{down}" in known:
            return f"{stem}-{up}", f"{stem}-{down}"
    return name, None


def _macro_weights(random: np.random.Generator, samples: int) -> dict[str, F64]:
    """(samples,) weight of each of the 18 macro targets; they sum to one."""
    ancestry = random.dirichlet([0.5] * 3, samples)
    male = random.beta(0.4, 0.4, samples)
    old = random.uniform(0, 1, samples)
    child = np.where(random.uniform(0, 1, samples) < CHILDREN, random.uniform(0, 1, samples), 0.0)
    ages = {"child": child, "young": (1 - child) * (1 - old), "old": (1 - child) * old}
    sexes = {"female": 1 - male, "male": male}
    return {
        f"{a}-{s}-{g}": ancestry[:, i] * sexes[s] * ages[g]
        for i, a in enumerate(("african", "asian", "caucasian"))
        for s in sexes
        for g in ages
    }


def without_motion(offsets: F64, points: F64, anchor: Indices) -> F64:
    """Offsets (n, 3) of points (n, 3) less the small rigid motion that fits those of the rows `anchor` best."""
    centred = points - points[anchor].mean(0)
    modes = np.zeros((len(points), 3, 6))
    modes[:, :, :3] = np.eye(3)
    for k in range(3):
        modes[:, :, 3 + k] = np.cross(np.eye(3)[k], centred)
    motion = np.linalg.lstsq(modes[anchor].reshape(-1, 6), offsets[anchor].ravel(), rcond=None)[0]
    return offsets - modes @ motion


def target_offsets(source: Source, cut: Cut, targets: dict[str, F64], anchor: Indices) -> F64:
    """(T, V + J, 3) of vertices and joints, without rigid motion. anchor: our vertices that stay in place."""
    points = np.concatenate([source.vertices[cut.rows], joint_centres(source.vertices, cut)])
    return np.stack([
        without_motion(np.concatenate([d[cut.rows], joint_centres(d, cut)]), points, anchor) for d in targets.values()
    ])  # fmt: skip


def principal(base: F64, offsets: F64, weights: F64, mirror: Indices) -> Identity:
    """The basis of persons with `weights` (S, T). base (V + J, 3), offsets (T, V + J, 3), mirror (V,) of vertices."""
    count = len(mirror)
    other = np.concatenate([mirror, count + _mirrored_joints(base[count:])])
    flip = np.array([-1.0, 1.0, 1.0])
    average = base + np.tensordot(weights.mean(0), offsets, 1)
    average = (average + average[other] * flip) / 2
    covariance = np.cov(weights.T)
    found = []
    for sign in (1, -1):
        part = (offsets + sign * offsets[:, other] * flip) / 2
        flat = part[:, :count].reshape(len(part), -1)
        values, vectors = np.linalg.eigh(covariance)
        root = vectors * np.sqrt(np.maximum(values, 0))  # root root' = covariance
        spread, turn = np.linalg.eigh((root.T @ flat) @ (root.T @ flat).T)
        for s, t in zip(spread[::-1], turn.T[::-1], strict=True):
            if s > 1e-12 * spread[-1]:
                found.append((s, sign > 0, np.tensordot(root @ t, part, 1) / np.sqrt(s)))
    found.sort(key=lambda f: -f[0])
    share = np.cumsum([f[0] for f in found]) / sum(f[0] for f in found)
    keep = min(int(np.searchsorted(share, KEPT)) + 1, MOST)
    both = np.stack([f[2] for f in found[:keep]])
    return Identity(
        average[:count], both[:, :count], np.sqrt([f[0] for f in found[:keep]]), average[count:], both[:, count:],
        np.array([f[1] for f in found[:keep]]), float(share[keep - 1]),
    )  # fmt: skip


def _mirrored_joints(joints: F64) -> Indices:
    """(J,) the joint on the other side of each."""
    flipped = joints * [-1, 1, 1]
    return np.linalg.norm(flipped[:, None] - joints[None], axis=2).argmin(1)
