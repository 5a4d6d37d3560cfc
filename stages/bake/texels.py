"""Samples the field at texels: their points on the true surface, and the material there.

Symbols
    p       point of the UV mesh under a texel's centre
    N       interpolated vertex normal at p
    t       signed distance (m) along N from the mesh to the zero set of the SDF d
    x       p + t N, the point at which everything is evaluated
"""

from __future__ import annotations

from dataclasses import dataclass, fields, replace

import numpy as np
import numpy.typing as npt

from pipeline import tangents
from pipeline.colour import LUMA
from pipeline.errors import StageError
from pipeline.eyes import material
from pipeline.fields.protocol import Field
from pipeline.maths import microfacet
from pipeline.meshes import F32, F64, Mask, Mesh
from pipeline.raster import Hits
from pipeline.tangents import Frames
from stages.bake.detail import Detail, Points, shade
from stages.bake.eyes import Eyes
from stages.bake.lit import Measured
from stages.bake.relief import FAR, Relief
from stages.bake.standard_fit import Fitted

NEWTON_STEPS = 3
MIN_SLOPE = 0.3  # of d along N: lower limit of the slope in Newton's step
REACH_CELLS = 1.5  # cells of the field: the decimated mesh is never further from the zero set
MIN_FACING = 0.3  # least cosine between the mesh's normal and the field's gradient at x
ARRIVED_CELLS = 1e-3  # |d| below this many cells needs no further step: 2 micrometres
LANDED_CELLS = 0.05  # |d| below this many cells counts as on the surface
MIN_Z = 0.05  # of a tangent-space normal: shaders can't use normals that point into the surface
# Fresh snow is the brightest. Soot (0.005) is not the darkest: a phone's tone curve shows black hair as a third of
# that, and with soot's albedo it was a flat grey cap.
ALBEDO_RANGE = (0.001, 0.95)


@dataclass(frozen=True, slots=True)
class Samples:
    """One row per texel, in the order of its Hits. All float32, but `landed` is bool.

    albedo (N, 3) of the field, including photo detail; base_color (N, 3), f0 and roughness (N,) of standard shaders;
    rho (N,); coefficients (N, k), the c_j without rho; inv_kappa (N,); irradiance_ratio (N, 3); normal (N, 3) in
    tangent space, unit; displacement (N,) metres; ambient (N,): ambient occlusion. landed (N,): False where no zero set
    is near the mesh (the cap). support (N,): weight of the photos in the detail. unseen (N,): 1 where no photo shows
    the point. clamped (N,): largest change of an albedo channel by clamping to ALBEDO_RANGE. curvature (1/m), cavity,
    thickness (m) (N,): relief.py; measured (N, 3): sources.py. lit (N,): luminance of the irradiance over pi that the
    fitted light predicts.
    """

    albedo: F32
    base_color: F32
    rho: F32
    coefficients: F32
    inv_kappa: F32
    irradiance_ratio: F32
    f0: F32
    roughness: F32
    normal: F32
    displacement: F32
    ambient: F32
    landed: Mask
    support: F32
    unseen: F32
    clamped: F32
    curvature: F32
    cavity: F32
    thickness: F32
    measured: F32
    lit: F32


@dataclass(frozen=True, slots=True)
class Known:
    """Data at the mesh's vertices. ambient (V,); unseen (V,): 1 where no photo shows the vertex; replaced (V,): how far
    the albedo is replaced by albedo (V, 3), because no photo shows it well (unseen.py). relief: of the shape; sources
    (V, 3): sources.py. standard: the fitted material
    of standard shaders; None: it is converted from NeuFace's. eyes: the fitted eyes, if there are any; measured: what a
    light stage says of the material, if there is one."""

    ambient: F32
    unseen: F32
    replaced: F32
    albedo: F32
    relief: Relief | None = None
    sources: F32 | None = None
    standard: Fitted | None = None
    eyes: Eyes | None = None
    measured: Measured | None = None


@dataclass(frozen=True, slots=True)
class Placed:
    """Texels on the true surface. x (N, 3); world (N, 3): unit normal at x; t, b, n (N, 3): tangent frame of the mesh;
    moved (N,): metres along n; landed (N,)."""

    x: F64
    world: F64
    t: F64
    b: F64
    n: F64
    moved: F64
    landed: Mask


def place(field: Field, mesh: Mesh, frame: Frames, hits: Hits) -> Placed:
    """Find the points of the texels on the true surface."""
    weights = hits.weights.astype(np.float64)
    start = tangents.mixed(mesh.vertices.astype(np.float64)[mesh.faces[hits.face]], weights)
    t, b, n = tangents.at(frame, mesh, hits.face, weights)
    moved, gradient, landed = land(field, start, n)
    world = _unit(np.where(landed[:, None], gradient, n))
    return Placed(start + moved[:, None] * n, world, t, b, n, moved, landed)


def points(field: Field, mesh: Mesh, hits: Hits, at: Placed, albedo: F32, ratio: F32) -> Points:
    """The same texels as input of the photo detail. albedo, ratio (N, 3)."""
    lit = shade(field.light, at.world, ratio)
    return Points(at.x, at.world, mesh.faces[hits.face], hits.weights, np.asarray(albedo, np.float32), lit)


def sample(
    field: Field, mesh: Mesh, frame: Frames, hits: Hits, known: Known | None = None, detail: Detail | None = None
) -> Samples:
    """Sample everything that the maps need. Raises StageError if the field is not finite."""
    at = place(field, mesh, frame, hits)
    x, straight = at.x.astype(np.float32), at.world.astype(np.float32)
    own = field.material(x)
    ratio = np.asarray(field.irradiance_ratio(x), np.float32)
    strength = own.rho * tangents.dot(own.coefficients, field.basis(straight, straight))
    f0 = microfacet.f0_from_lobe(strength, own.inv_kappa)
    roughness = microfacet.roughness_from_inv_kappa(own.inv_kappa)
    albedo, support = np.asarray(own.albedo, np.float32), np.zeros(len(x), np.float32)
    _check("albedo", albedo)
    here = points(field, mesh, hits, at, albedo, ratio)
    if detail is not None:
        more, support = detail.added(here)
        albedo = albedo + more
    around, unseen = np.ones(len(x), np.float32), np.zeros(len(x), np.float32)
    shape, told = _shape(known, mesh, hits), np.ones((len(x), 3), np.float32)
    if known is not None:
        corner = mesh.faces[hits.face]
        around = tangents.dot(known.ambient[corner], hits.weights)
        unseen = tangents.dot(known.unseen[corner], hits.weights)
        nearby = tangents.mixed(known.albedo[corner], hits.weights)
        replaced = tangents.dot(known.replaced[corner], hits.weights)
        albedo = np.asarray(albedo + replaced[:, None] * (nearby - albedo), np.float32)
        if known.sources is not None:
            told = tangents.mixed(known.sources[corner], hits.weights).astype(np.float32)
    physical = base = albedo.clip(*ALBEDO_RANGE)
    if known is not None and known.standard is not None:
        fitted, corner = known.standard, mesh.faces[hits.face]
        f0, roughness = (tangents.dot(values[corner], hits.weights) for values in (fitted.f0, fitted.roughness))
        base = (albedo * tangents.mixed(fitted.correction[corner], hits.weights)).clip(*ALBEDO_RANGE)
    found = Samples(
        albedo=physical,
        base_color=np.asarray(base, np.float32),
        rho=np.asarray(own.rho, np.float32),
        coefficients=np.asarray(own.coefficients, np.float32),
        inv_kappa=np.asarray(own.inv_kappa, np.float32),
        irradiance_ratio=ratio,
        f0=np.asarray(f0, np.float32),
        roughness=np.asarray(roughness, np.float32),
        normal=in_frame(at.world, at.t, at.b, at.n),
        displacement=at.moved.astype(np.float32),
        ambient=around,
        landed=at.landed,
        support=support,
        unseen=unseen,
        clamped=np.abs(albedo - physical).max(1),
        curvature=shape[0],
        cavity=shape[1],
        thickness=shape[2],
        measured=told,
        lit=np.asarray(here.shade @ np.array(LUMA, np.float32), np.float32),
    )
    if known is not None and known.measured is not None:
        found = _with_measured(found, at, known.measured.at(hits.texel))
    if known is not None and known.eyes is not None:
        found = _with_eyes(found, mesh, hits, at, known.eyes, known.standard)
    for name in ("albedo", "rho", "coefficients", "inv_kappa", "irradiance_ratio", "normal"):
        _check(name, getattr(found, name))
    return found


def _shape(known: Known | None, mesh: Mesh, hits: Hits) -> tuple[F32, F32, F32]:
    """(N,) curvature, cavity and thickness; those of a plane without end where they are not known."""
    count = len(hits.face)
    if known is None or known.relief is None:
        return np.zeros(count, np.float32), np.full(count, 0.5, np.float32), np.full(count, FAR, np.float32)
    shape, corner = known.relief, mesh.faces[hits.face]
    curvature, cavity, thick = (
        np.asarray(tangents.dot(v[corner], hits.weights), np.float32)
        for v in (shape.curvature, shape.cavity, shape.thickness)
    )
    return curvature, cavity, thick


def _with_measured(found: Samples, at: Placed, values: F32) -> Samples:
    """The samples with what a light stage's single lights say, values (N, 9) of `Measured.at`."""
    length = np.linalg.norm(values[:, 5:8], axis=1, keepdims=True)
    normal = np.where(length > 0.1, values[:, 5:8] / np.maximum(length, 1e-9), at.world)
    return replace(
        found,
        base_color=values[:, :3].clip(*ALBEDO_RANGE),
        f0=values[:, 3].clip(0, 1),
        roughness=values[:, 4].clip(0.1, 1),
        normal=in_frame(normal.astype(np.float64), at.t, at.b, at.n),
        unseen=(values[:, 8] < 0.5).astype(np.float32),
        measured=np.repeat((values[:, 8:9] >= 0.5).astype(np.float32), 3, 1),
    )


def _with_eyes(found: Samples, mesh: Mesh, hits: Hits, at: Placed, eyes: Eyes, standard: Fitted | None) -> Samples:
    """The samples with the fitted eyes: their own colours, the cornea's reflection, and the ball as it is."""
    corner = mesh.faces[hits.face]
    rows, albedo = eyes.at(corner[:, 0].astype(np.int64), at.x - at.moved[:, None] * at.n)
    if not len(rows):
        return found
    base = albedo
    if standard is not None:
        base = albedo * tangents.mixed(standard.correction[corner[rows]], hits.weights[rows])
    changed = {f.name: getattr(found, f.name).copy() for f in fields(Samples)}
    changed["albedo"][rows] = albedo.clip(*ALBEDO_RANGE)
    changed["base_color"][rows] = base.clip(*ALBEDO_RANGE)
    changed["f0"][rows], changed["roughness"][rows] = material.F0, material.ROUGHNESS
    changed["measured"][rows, 1:] = 0
    changed["normal"][rows], changed["displacement"][rows] = (0, 0, 1), 0
    changed["clamped"][rows] = np.abs(albedo - albedo.clip(*ALBEDO_RANGE)).max(1)
    return Samples(**changed)


def land(field: Field, start: F64, normal: F64) -> tuple[F64, F64, Mask]:
    """Newton's method from start (N, 3) along normal (N, 3): t (N,), the gradient there (N, 3), and where it converged
    (N,).

        t <- t - d / max(g . N, MIN_SLOPE)

    t is clamped to REACH_CELLS cells, so that it does not jump to another sheet. Texels that do not converge keep t =
    0; those within ARRIVED_CELLS cells of the zero set are not moved.
    """
    reach = REACH_CELLS * field.cell
    t = np.zeros(len(start))
    value, gradient = _evaluate(field, start)
    for _ in range(NEWTON_STEPS):
        on = np.flatnonzero(np.abs(value) > ARRIVED_CELLS * field.cell)
        if not len(on):
            break
        slope = np.maximum(tangents.dot(gradient[on], normal[on]), MIN_SLOPE)
        t[on] = (t[on] - value[on] / slope).clip(-reach, reach)
        value[on], gradient[on] = _evaluate(field, start[on] + t[on, None] * normal[on])
    # a surface at a steep angle to the normal is not the one of this texel (the rim of the neck's cut)
    facing = tangents.dot(_unit(gradient), normal) > MIN_FACING
    landed = (np.abs(value) < LANDED_CELLS * field.cell) & facing
    return np.where(landed, t, 0.0), gradient, landed


def in_frame(world: F64, t: F64, b: F64, n: F64) -> F32:
    """(N, 3) directions `world` (N, 3) in the frame T, B, N, kept on the outer side of the surface."""
    local = np.stack([tangents.dot(world, axis) for axis in (t, b, n)], 1)
    local[:, 2] = np.maximum(local[:, 2], MIN_Z)
    return _unit(local).astype(np.float32)


def _evaluate(field: Field, points: F64) -> tuple[F64, F64]:
    value, gradient = field.sdf_and_gradient(points.astype(np.float32))
    return np.array(value, np.float64), np.array(gradient, np.float64)


def _unit(v: npt.NDArray[np.floating]) -> F64:
    w = np.asarray(v, np.float64)
    out: F64 = w / np.maximum(np.sqrt(tangents.dot(w, w))[:, None], 1e-30)
    return out


def _check(name: str, values: F32) -> None:
    if not np.isfinite(values).all():
        raise StageError(
            "the fitted field is not finite on the surface",
            where=f"bake: {name}",
            value=f"{(~np.isfinite(values)).sum()} of {values.size} values",
            limit="finite everywhere",
            remedy="fit the model again with another seed",
        )
