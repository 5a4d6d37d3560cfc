"""From the fitted surface and the face's landmarks to the registered template, with its figures."""

from __future__ import annotations

from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass, replace

import numpy as np
from scipy.sparse import csr_array, vstack

from pipeline.artifacts import Camera
from pipeline.eyes.ball import IRIS
from pipeline.eyes.fit import FittedBall, fitted_eyes, unseen_eye
from pipeline.eyes.place import eye_displacement, eye_rows, with_eyes
from pipeline.meshes import F64, Indices, Mesh, triangles_of
from pipeline.registration.cage import Cage, cage_of
from pipeline.registration.displacement import displacement
from pipeline.registration.followers import followed
from pipeline.registration.head import Head, limit_surface
from pipeline.registration.identity_fit import PlacedHead
from pipeline.registration.inside import beneath
from pipeline.registration.lids import LIDS, REST, UPPER_LIDS, between, closing, lids_closed, with_lids
from pipeline.registration.lips import LIPS, closing_lips, lips_closed
from pipeline.registration.neck import sunk
from pipeline.registration.nonrigid import Fitted, Guides, fitted
from pipeline.registration.quality import outer_quads
from pipeline.registration.refine_identity import refined
from pipeline.registration.rig import EYES
from pipeline.registration.scan import Scan
from pipeline.registration.subdivision import Level, limit, subdivided
from pipeline.template.model import SKIN, Template
from pipeline.transforms import apply, matrix
from pipeline.visibility import FittedPhoto, Occluder, seen_weight

AROUND = 0.25  # metres of the template: the surface further from the head's middle is not looked at
ASKED = 30_000  # vertices of the surface whose visibility is computed; the others take that of the nearest
LANDMARK_REACH = 0.006  # metres of the template: a landmark further from the surface does not guide
ADULT = 1.1  # metres per metre of the template of an average adult: the unit of a capture of unknown scale
CLOSED = 20.0  # weight of what holds closed lids and closed lips together, in that of a point on the surface
HIDDEN = 0.6  # share of the lids' margins in a point from which no surface shows it while they are closed

Step = Callable[[int, int, str], None]


@dataclass(frozen=True, slots=True)
class Registration:
    """placed: similarity and identity. fitted: the cage's skin; cage: its operators. head: the result; landmarks_mm:
    median distance of the face's landmarks from the template's, metres of the template times 1000; closed: whether the
    eyes are; eyes: by part, also those that stay the template's own."""

    placed: PlacedHead
    cage: Cage
    fitted: Fitted
    head: Head
    landmarks_mm: float
    closed: bool
    eyes: Mapping[str, FittedBall]


def scan_of(mesh: Mesh, head: PlacedHead, views: Sequence[FittedPhoto]) -> tuple[Scan, Indices]:
    """The part of the fitted surface around the head, and how well the photos see it; rows (V,) of its vertices in the
    surface."""
    middle = head.world_from_template[:3, 3]
    near = np.linalg.norm(mesh.vertices - middle, axis=1) < AROUND * head.scale
    faces = mesh.faces[near[mesh.faces].all(1)]
    used, flat = np.unique(faces, return_inverse=True)
    part = Mesh(mesh.vertices[used], mesh.normals[used], flat.reshape(-1, 3).astype(np.int32))
    return Scan(part, _seen(part, views, Occluder(mesh))), np.asarray(used, np.int64)


def iris_pixels(cameras: Sequence[Camera], head: PlacedHead) -> float:
    """Pixels across an iris of the placed head, seen from its front: of the median photo; 0 without any."""
    middle = apply(head.world_from_template, np.zeros(3))
    size = IRIS * 2 * head.scale / ADULT
    poses = [(matrix(c.K)[0, 0], matrix(c.world_from_cam)[:3, 3]) for c in cameras]
    across = [focal * size / max(float(np.linalg.norm(centre - middle)), 1e-12) for focal, centre in poses]
    return float(np.median(across)) if across else 0.0


def _seen(part: Mesh, views: Sequence[FittedPhoto], occluder: Occluder) -> F64:
    """(V,) sum of cosines, exact at every few vertices."""
    from scipy.spatial import cKDTree

    points, normals = part.vertices.astype(np.float64), part.normals.astype(np.float64)
    asked = np.arange(0, len(points), max(1, len(points) // ASKED))
    seen = seen_weight(points[asked], normals[asked], views, occluder)
    _, nearest = cKDTree(points[asked]).query(points)
    return np.asarray(seen[nearest], np.float64)


def register(
    template: Template,
    landmarks: F64,
    placed: PlacedHead,
    scan: Scan,
    levels: int,
    step: Step,
    views: Sequence[FittedPhoto] = (),
    metric: bool = True,
) -> Registration:
    """The template on the scan, from where the landmarks (468, 3) place it. views: photos that show the eyes; metric:
    whether the scan's unit is known."""
    step(0, 5, "identity")
    placed = refined(template, landmarks, placed, scan)
    cage = cage_of(template)
    closed = lids_closed(template, placed, cage, scan)
    start = with_lids(template, placed, REST if closed else 0.0)
    step(1, 5, "deformation")
    if closed:
        cage = replace(cage, shown=cage.shown & (between(template, cage) < HIDDEN))
    rest, guides = start[cage.of_template], guides_for(template, placed, cage, scan, landmarks, closed)
    found = fitted(cage, rest, scan, guides, placed.scale, lambda: step(1, 5, "deformation"))
    vertices = followed(template, start, cage.of_template, found.vertices, found.rotations, placed.scale)
    step(2, 5, "eyes")
    level = subdivided(template.quads, len(vertices), levels)
    unit = 1.0 if metric else placed.scale / ADULT
    eyes = eyes_between_lids(template, vertices, level, placed, scan, views, unit, closed=closed)
    known_eyes = {part: found.eye for part, found in eyes.items() if not found.reason}
    vertices = with_eyes(template, start, vertices, known_eyes)
    step(3, 5, "displacement")
    regions, parts = (index_of(x, len(template.quads)) for x in (template.regions, template.parts))
    free = np.repeat(outer_quads(regions, tuple(template.regions)), 4**levels)
    points, normals, quads = limit_surface(vertices, level)
    names = [LIDS] * closed + [LIPS] * lips_closed(template, landmarks, placed.scale)
    meet = np.isin(np.arange(len(template.quads)), [q for n in names for q in template.regions.get(n, ())])
    moved, seen = displacement(points, normals, quads, free, scan, placed.scale, np.repeat(meet, 4**levels))
    moved = moved - placed.scale * (level.stencil @ sunk(template))
    moved = moved + beneath(points, normals, moved, quads, np.repeat(regions, 4**levels), tuple(template.regions),
                            placed.scale)  # fmt: skip
    lids = points[np.unique(quads[free])]
    for part, eye in known_eyes.items():
        own = eye_rows(level, template.parts[part], levels)
        moved[own] = eye_displacement(points, normals, own, lids, eye, unit)
    known = np.isfinite(landmarks[template.landmarks.network]).all(1)
    away = np.linalg.norm(template.landmark_points(vertices) - landmarks[template.landmarks.network], axis=1)[known]
    step(4, 5, "figures")
    head = Head(
        vertices, template.quads, template.uvs, template.uv_quads, regions, parts,
        moved.astype(np.float32), seen.astype(np.float32), levels,
    )  # fmt: skip
    return Registration(placed, cage, found, head, 1000 * float(np.median(away)) / placed.scale, closed, eyes)


def eyes_between_lids(
    template: Template,
    vertices: F64,
    level: Level,
    placed: PlacedHead,
    scan: Scan,
    views: Sequence[FittedPhoto],
    unit: float,
    *,
    closed: bool,
) -> Mapping[str, FittedBall]:
    """The eyes of the registered head's vertices (V, 3), by part; level: its subdivisions; unit: world units of one
    metre."""
    balls = {part: vertices[template.part_vertices(part)] for part in EYES if part in template.parts}
    if not balls or not views:
        return {}
    axes = (placed.world_from_template[:3, :3] / placed.scale).T
    if closed:
        return {part: unseen_eye(ball, axes, unit, "the eyes are closed") for part, ball in balls.items()}
    points, normals, quads = limit_surface(vertices, level)
    steps = len(quads) // len(template.quads)
    skin = quads[np.repeat(np.isin(np.arange(len(template.quads)), template.parts[SKIN]), steps)]
    lids = Occluder(Mesh(points.astype(np.float32), normals.astype(np.float32), triangles_of(skin)))
    return fitted_eyes(balls, axes, scan, views, lids, unit)


def guides_for(template: Template, placed: PlacedHead, cage: Cage, scan: Scan, landmarks: F64, closed: bool) -> Guides:
    """The landmarks, laid on the scan (their depth is less certain than the surface's); closed lids and closed lips."""
    points = template.landmarks
    where = landmarks[points.network]
    known = np.isfinite(where).all(1)
    on, away = scan.nearest(np.nan_to_num(where))
    wrong = closed & np.isin(points.network, UPPER_LIDS)
    use = np.flatnonzero(known & (away < LANDMARK_REACH * placed.scale) & ~wrong)
    row = np.full(len(template.vertices), -1, np.int64)
    row[cage.of_template] = np.arange(len(cage.of_template))
    flat = csr_array(
        (points.weights[use].ravel(), (np.repeat(np.arange(len(use)), 3), row[points.corners[use]].ravel())),
        shape=(len(use), len(cage.of_template)),
    )
    stencil, place_at = csr_array(flat @ limit(cage.quads, len(cage.of_template)).point), on[use]
    held = [closing(template, placed, cage)] if closed else []
    if lips_closed(template, landmarks, placed.scale):
        held.append(closing_lips(template, placed, cage, placed.vertices[cage.of_template]))
    places = np.concatenate([place_at, *(there for _, there in held)])
    least = np.zeros(len(places))
    least[len(use) :] = CLOSED
    return Guides(csr_array(vstack([stencil, *(more for more, _ in held)])), places, least)


def index_of(named: Mapping[str, Indices], count: int) -> Indices:
    """(Q,) index of the entry that holds each quad, -1 for none. named: name -> quads."""
    out = np.full(count, -1, np.int64)
    for i, rows in enumerate(named.values()):
        out[rows] = i
    return out
