"""What the fit of standard shaders starts from: the mesh's vertices in all photos, and the exported light on them."""

from __future__ import annotations

from collections.abc import Callable, Sequence
from dataclasses import replace

import numpy as np

from pipeline.fields.protocol import Field
from pipeline.lighting.captured import captured_environment
from pipeline.lighting.median_cut import Lamps, lamps
from pipeline.lighting.moving import MovingLight, Standpoint
from pipeline.lighting.moving_standard import MovingLamps
from pipeline.lighting.standard import COUNT, Arrivals, arrivals
from pipeline.lighting.surroundings import Surroundings
from pipeline.meshes import F32, F64, Indices, Mask, Mesh, unit
from pipeline.polarised import specular
from pipeline.smoothing import continued
from pipeline.thinning import thinned
from pipeline.transforms import inverse_rigid, matrix, project
from pipeline.visibility import FittedPhoto
from stages.bake import detail_kernels as kernels
from stages.bake import standard_fit
from stages.bake.detail import Detail, shade
from stages.bake.detail_views import Photos
from stages.bake.even_skin import Even
from stages.bake.odd_colours import apart
from stages.bake.regions import Poll
from stages.bake.skin import skin_of
from stages.bake.standard_seen import Lit, Seen

DOME_WIDTH = 256  # columns of the picture that is cut into lamps
MIN_FACING = 0.3  # least cosine between the mesh's normal and the field's gradient


def standard_material(
    field: Field, mesh: Mesh, views: Sequence[FittedPhoto], skin_code: int, seen: Mask, found: Detail,
    check: Callable[[], None], hair: Mask | None = None, look: F32 | None = None, region: Indices | None = None,
    even: Even | None = None, surroundings: Surroundings | None = None,
) -> standard_fit.Fitted:  # fmt: skip
    """The fitted material at the vertices. skin_code: label of the face in the photos, -1 for none; seen, hair (V,);
    look (V, 3): the albedo with what photos do not show filled, region (V,): of the head (skin.skin_of); even: takes
    errors of the light out of the base colour (V, 3) of seen skin (V,) (even_skin.py); surroundings: what the photos
    show behind the subject."""
    normals = field_normals(field, mesh)
    albedo = field.material(mesh.vertices).albedo.astype(np.float64)
    thin = thinned(len(mesh.vertices), mesh.faces)
    observations, view, face = _observed(field, mesh, normals, albedo, views, skin_code, found)
    skin, telling = skin_of(mesh, face, albedo if look is None else look.astype(np.float64), region)
    asked = telling | ~skin if thin is None else (telling | ~skin) & thin.chosen
    moving = field.moving_light
    at: Lit | Arrivals
    if moving is None:
        lit = exported_lamps(field.light, surroundings)
        at = arrivals(mesh.vertices, normals.astype(np.float32), mesh.faces, lit, albedo, check)
    else:
        poses = [matrix(v.camera.world_from_cam) for v in views]
        at = carried(moving, field.light, mesh, normals, observations, view, poses, check)
    out = standard_fit.fit(mesh, normals, at, albedo, observations, skin, check, hair, asked)
    off = apart(observations.vertex, observations.colour, observations.predicted, len(mesh.vertices))
    correction = continued(mesh, out.correction.astype(np.float64), seen)
    if even is None:
        return replace(out, correction=correction.astype(np.float32), apart=off)
    evened = even(skin & seen, albedo * correction)
    return replace(
        out, correction=(correction * evened.factor).astype(np.float32), figures=out.figures | evened.figures, apart=off
    )


def exported_lamps(light: F32, surroundings: Surroundings | None) -> Lamps:
    """The exported dome as lamps. light: the harmonics of the fitted one."""
    return lamps(captured_environment(light, DOME_WIDTH, surroundings), COUNT)


def carried(
    light: MovingLight, stand_in: F32, mesh: Mesh, normals: F64, seen: Seen, view: Indices,
    poses: Sequence[F64], check: Callable[[], None],
) -> Lit:  # fmt: skip
    """What arrives under a light that moves with the camera. stand_in: the still one; view (M,): number of each
    observation's photo; poses (4, 4) of the photos."""
    moving = MovingLamps(light)
    x, n = mesh.vertices[seen.vertex], normals[seen.vertex].astype(np.float32)
    eyes = [Standpoint.of(pose) for pose in poses]
    lit = np.empty((len(view), 3))
    for number, eye in enumerate(eyes):
        check()
        own = np.flatnonzero(view == number)
        lit[own] = moving.irradiance(x[own], n[own], eye) / np.pi

    def lobes(rows: Indices, alphas: F32) -> F32:
        out = np.empty((len(rows), len(alphas), 2, 3), np.float32)
        for number, eye in enumerate(eyes):
            check()
            own = np.flatnonzero(view[rows] == number)
            out[own] = moving.lobes(x[rows[own]], n[rows[own]], eye, alphas)
        return out

    still = shade(stand_in, normals, np.ones((len(normals), 3), np.float32)).astype(np.float64)
    return Lit(lobes, lit, still)


def field_normals(field: Field, mesh: Mesh) -> F64:
    """(V, 3) unit normals of the field at the vertices; the mesh's own where they do not agree (the neck's cut)."""
    n = unit(field.sdf_and_gradient(mesh.vertices)[1])
    own = unit(mesh.normals)
    return np.where((n * own).sum(1, keepdims=True) > MIN_FACING, n, own)


def _observed(
    field: Field, mesh: Mesh, normals: F64, albedo: F64, views: Sequence[FittedPhoto], skin_code: int, found: Detail
) -> tuple[Seen, Indices, Mask]:
    """The observations, the number of each one's photo, and which vertices the photos label as the face."""
    photos, x = found.photos, mesh.vertices.astype(np.float64)
    colour, cosines = np.zeros((len(views), len(x), 3)), np.zeros((len(views), len(x)))
    kernels.observed(photos.cameras, photos.pixels, photos.depth, photos.clipped, x, normals, colour, cosines)
    base = albedo * shade(field.light, normals, np.asarray(field.irradiance_ratio(mesh.vertices), np.float32))
    view, vertex = np.nonzero(cosines > 0)
    away = photos.cameras[view, 27:30] - x[vertex]
    wo = away / np.linalg.norm(away, axis=1, keepdims=True)
    own = found.relative[view, vertex] if len(found.relative) else 1.0
    predicted = base[vertex] * own + found.gloss[view, vertex]
    mirror = _mirrors(found.photos, x, normals, colour)
    observations = Seen(vertex, wo, colour[view, vertex], predicted, None if mirror is None else mirror[view, vertex])
    return observations, view, _face(views, x, cosines, skin_code)


def _mirrors(photos: Photos, x: F64, normals: F64, cross: F64) -> F64 | None:
    """(views, V, 3) the mirror reflection of polarised pairs, NaN where a pair does not show it; None without pairs.
    cross (views, V, 3): colours in the cross-polarised photos."""
    other = photos.parallel
    if other is None:
        return None
    cameras = photos.cameras.copy()
    cameras[:, 39] = other.peaks
    colour, cosines = np.zeros_like(cross), np.zeros(cross.shape[:2])
    kernels.observed(cameras, other.pixels, photos.depth, other.clipped, x, normals, colour, cosines)
    return np.where((cosines > 0)[..., None], specular(cross, colour), np.nan)


def _face(views: Sequence[FittedPhoto], x: F64, cosines: F64, code: int) -> Mask:
    """(V,) where the photos' labels vote for the face."""
    poll = Poll(len(x))
    for view, cosine in zip(views, cosines, strict=True):
        pose = inverse_rigid(matrix(view.camera.world_from_cam))
        uv = project(matrix(view.camera.K), pose, np.array(view.camera.distortion), x)[0]
        poll.ask(view, cosine, uv)
    return np.asarray((poll.winners() == code) & (code > 0), np.bool_)
