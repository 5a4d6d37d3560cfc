"""Similarity and identity of the template by robust Gauss-Newton steps: the person's head from landmarks, and from
points of a surface where there are any.

Symbols: a datum is a place on the template (three corners c and weights a) and the point y (3,) of the world where it
is; s, R, t the similarity world_from_template; w (K,) identity weights in standard deviations; v(w) = mean + B w.

    r = sum_a a_i v_ci(w) - R^T (y - t) / s            the residual, in the template's metres
    E = sum rho(|r| / sigma) + |w|^2                   landmarks: all three coordinates; surface points: n . r only

rho is Cauchy's: its weight is 1 / (1 + (|r| / (SOFT sigma))^2), so that a landmark that is wrong, or that means another
place on this person, does not pull. Where many are wrong, only those take part that agree with one similarity, found
in samples of four. The prior |w|^2 is that of the persons of which the basis was made.

Source: Blanz and Vetter, A morphable model for the synthesis of 3D faces (1999), for the maximum a posteriori;
the similarity by linearised rotations.
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np

from pipeline.errors import StageError
from pipeline.meshes import F64, Indices, Mask
from pipeline.template.model import Template
from pipeline.transforms import apply, scale_of, similarity, umeyama

LANDMARK_SIGMA = 0.003  # metres: scatter of the network's landmarks around the template's, on persons and scans
MAX_RESIDUAL = 0.006  # metres, median: a template whose landmarks are further off does not fit this face
ROUNDS = 12  # Gauss-Newton steps at most; 6 are enough on all captures
STILL = 1e-7  # radians, metres and deviations: a smaller step is the last
SOFT = 2.0  # sigmas at which a datum has half of its weight
MIN_DATA = 8  # landmarks: fewer do not determine a similarity well
SAMPLES = 200  # fours of landmarks: one of 16 is right if half of the landmarks are
AGREE = 0.4  # share of the landmarks that a similarity must suit
WRONG, MANY = 5.0, 0.15  # sigmas from which a landmark is wrong; share of the landmarks that may be
STEP = 3.0  # largest change of an identity weight in one step


@dataclass(frozen=True, slots=True)
class Data:
    """N data: corners (N, 3) vertices, weights (N, 3), where (N, 3) in the world, sigma (N,) metres of the template.

    normals (N, 3) unit, world: only the distance along them counts; None: all three coordinates.
    """

    corners: Indices
    weights: F64
    where: F64
    sigma: F64
    normals: F64 | None = None

    def only(self, use: Mask) -> Data:
        """The data use (N,)."""
        normals = None if self.normals is None else self.normals[use]
        return Data(self.corners[use], self.weights[use], self.where[use], self.sigma[use], normals)


@dataclass(frozen=True, slots=True)
class PlacedHead:
    """world_from_template: 4x4 similarity. weights (K,): identity. vertices (V, 3): in the world. residual (N,): metres
    of the template, of the first data. scale_deviation: standard deviation of log s given the data and the prior."""

    world_from_template: F64
    weights: F64
    vertices: F64
    residual: F64
    scale_deviation: float

    @property
    def scale(self) -> float:
        """World units per metre of the template."""
        return scale_of(self.world_from_template)


def landmark_data(template: Template, landmarks: F64, sigma: float = LANDMARK_SIGMA) -> Data:
    """The template's landmarks that the network's points landmarks (468, 3) show; sigma: metres."""
    points = template.landmarks
    where = landmarks[points.network]
    known = np.isfinite(where).all(1)
    return Data(points.corners[known], points.weights[known], where[known], np.full(int(known.sum()), sigma))


def placed_on_landmarks(template: Template, landmarks: F64) -> PlacedHead | None:
    """The template on landmarks (468, 3), in any unit; None if fewer than half of its own are known."""
    data = landmark_data(template, landmarks)
    return place(template, (data,)) if len(data.where) >= len(template.landmarks.names) // 2 else None


def placed_on_face(template: Template, landmarks: F64) -> PlacedHead | None:
    """The same; None also if the landmarks do not look like a face's."""
    head = placed_on_landmarks(template, landmarks)
    return head if head is not None and float(np.median(head.residual)) <= MAX_RESIDUAL else None


def place(template: Template, data: tuple[Data, ...], start: PlacedHead | None = None) -> PlacedHead:
    """The most probable similarity and identity. data: landmarks first, without a start; then surface points.

    Raises:
        StageError: too few data, or they are not finite.
    """
    _check(data)
    every = data[0]
    if start is None:
        (world, use), weights = _start(template, every), np.zeros(0)
        data = (every if use.all() else every.only(use), *data[1:])
    else:
        world, weights = start.world_from_template, start.weights
    basis = None if template.shape is None else template.shape.basis * template.shape.deviation[:, None, None]
    weights = np.zeros(0) if basis is None else np.resize(weights, len(basis)) if len(weights) else np.zeros(len(basis))
    normal, moves = np.eye(7 + len(weights)), [_moves(basis, part) for part in data]
    for _ in range(ROUNDS):
        normal, right = _normal_equations(template, moves, data, world, weights)
        step: F64 = np.asarray(np.linalg.solve(normal, right), np.float64)
        weights = weights + np.clip(step[7:], -STEP, STEP)
        world = _turned(world, step[:7])
        if np.abs(step).max() < STILL:
            break
    vertices = apply(world, template.identity(weights))
    residual = np.linalg.norm(_residual(template, every, world, weights)[0], axis=1)
    # the covariance is the inverse of the normal matrix; robust weights are taken as they are
    deviation = float(np.sqrt(np.linalg.inv(normal)[6, 6]))
    return PlacedHead(world, weights, vertices, residual, deviation)


def _start(template: Template, landmarks: Data) -> tuple[F64, Mask]:
    """Least squares similarity of the mean head, then again without the worst third; and which landmarks (N,) are
    used: all, unless too many are wrong. Those would make the most probable head tiny under a huge scale."""
    at = (template.vertices[landmarks.corners] * landmarks.weights[..., None]).sum(1)
    off = _away(umeyama(at, landmarks.where), at, landmarks.where)
    use = off <= np.quantile(off, 0.67)
    plain = umeyama(at[use], landmarks.where[use])
    if (_away(plain, at, landmarks.where) > WRONG * LANDMARK_SIGMA).mean() <= MANY:
        return plain, np.ones(len(at), np.bool_)
    agree = _away(_sampled(at, landmarks.where), at, landmarks.where) <= WRONG * LANDMARK_SIGMA
    if agree.sum() < MIN_DATA:
        return plain, np.ones(len(at), np.bool_)
    return umeyama(at[agree], landmarks.where[agree]), agree


def _sampled(at: F64, where: F64) -> F64:
    """Of the similarities of SAMPLES fours of landmarks that with which a share AGREE of them agrees best."""
    random, best = np.random.default_rng(0), (umeyama(at, where), np.inf)
    for _ in range(SAMPLES):
        four = random.choice(len(at), 4, replace=False)
        world = umeyama(at[four], where[four])
        if not np.isfinite(world).all() or np.linalg.det(world[:3, :3]) <= 0:
            continue
        off = float(np.quantile(_away(world, at, where), AGREE))
        if off < best[1]:
            best = world, off
    return best[0]


def _away(world: F64, at: F64, where: F64) -> F64:
    """(N,) distances of the places at (N, 3) of the template from those of the world where (N, 3), in the template's
    metres."""
    return np.asarray(np.linalg.norm(apply(world, at) - where, axis=1) / max(scale_of(world), 1e-12))


def _residual(template: Template, data: Data, world: F64, weights: F64) -> tuple[F64, F64]:
    """r (N, 3), and the points of the world in the template's coordinates (N, 3)."""
    shape = template.vertices if template.shape is None else template.identity(weights)
    there = apply(np.asarray(np.linalg.inv(world), np.float64), data.where)
    return np.asarray((shape[data.corners] * data.weights[..., None]).sum(1) - there, np.float64), there


def _moves(basis: F64 | None, data: Data) -> F64:
    """(N, 3, K) how each identity weight moves the template's points of N data. basis (K, V, 3)."""
    if basis is None:
        return np.zeros((len(data.where), 3, 0))
    return np.asarray(np.einsum("knci,nc->nik", basis[:, data.corners], data.weights, order="C"), np.float64)


def _normal_equations(
    template: Template, moves: list[F64], data: tuple[Data, ...], world: F64, weights: F64
) -> tuple[F64, F64]:
    """Normal matrix and right side for (rotation, translation, log scale, identity), in the template's frame. moves: of
    each part of the data, see `_moves`."""
    size = 7 + len(weights)
    left, right = np.zeros((size, size)), np.zeros(size)
    left[range(7, size), range(7, size)] = 1.0
    right[7:] = -weights
    turn = world[:3, :3] / scale_of(world)
    for part, moved in zip(data, moves, strict=True):
        r, there = _residual(template, part, world, weights)
        J = np.zeros((len(r), 3, size))
        # a small similarity of the world's points: y' = y + omega x y + tau + sigma y, and r = v - y'
        J[:, :, 0:3] = _cross(there)
        J[:, :, 3:6] = -np.eye(3)
        J[:, :, 6] = -there
        J[:, :, 7:] = moved
        if part.normals is None:
            inlier = 1 / (1 + (np.linalg.norm(r, axis=1) / (SOFT * part.sigma)) ** 2)
            A, b = J.reshape(-1, size), r.ravel()
            weight = np.repeat(inlier / part.sigma**2, 3)
        else:
            n = part.normals @ turn
            A, b = np.einsum("ni,nik->nk", n, J), (n * r).sum(1)
            weight = 1 / (1 + (b / (SOFT * part.sigma)) ** 2) / part.sigma**2
        left += A.T @ (weight[:, None] * A)
        right -= A.T @ (weight * b)
    left[range(7), range(7)] += 1e-9 * max(float(np.abs(left).max()), 1.0)
    return left, right


def _cross(y: F64) -> F64:
    """(N, 3, 3) matrices M with M omega = -(omega x y) = y x omega."""
    zero = np.zeros(len(y))
    return np.stack([zero, -y[:, 2], y[:, 1], y[:, 2], zero, -y[:, 0], -y[:, 1], y[:, 0], zero], 1).reshape(-1, 3, 3)


def _turned(world: F64, step: F64) -> F64:
    """The similarity after the small change of the world's points in the template's frame."""
    from scipy.spatial.transform import Rotation

    change = similarity(
        float(np.exp(np.clip(step[6], -0.5, 0.5))), Rotation.from_rotvec(step[:3]).as_matrix(), step[3:6]
    )
    return np.asarray(world @ np.linalg.inv(change), np.float64)


def _check(data: tuple[Data, ...]) -> None:
    count = len(data[0].where) if data else 0
    finite = all(np.isfinite(d.where).all() and (d.sigma > 0).all() for d in data)
    if count < MIN_DATA or not finite:
        raise StageError(
            "the template can't be placed",
            where="registration",
            value=f"{count} landmarks" + ("" if finite else ", some not finite"),
            limit=f"at least {MIN_DATA}, all finite",
            remedy="take sharper photos of the face from the front and both sides",
        )
