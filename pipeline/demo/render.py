"""Ray tracer of the demo head: camera rays, exact hits, sampled shading, antialiasing.

Conventions
    camera     OpenCV axes (x right, y down, z forward); pixel centres at integers, so the middle of a
               picture W wide is (W - 1) / 2
    radiance   linear RGB; black where nothing is hit
    hit        the mesh gives the first point, one Newton step along the ray puts it on the signed distance,
               whose gradient is the normal: the mesh never shows in the shading

Light is not shadowed by default: the truth is then one bounce of an unoccluded light, which is what a
single-bounce model can explain. With `shadows` each light sample is tested against the mesh.
"""

from __future__ import annotations

from dataclasses import dataclass
from typing import Any

import numpy as np
import numpy.typing as npt
from embreex.mesh_construction import TriangleMesh
from embreex.rtcore_scene import EmbreeScene
from scipy.stats import qmc

from pipeline.demo import brdf, head, light, skin
from pipeline.demo.mesh import Mesh

F64 = npt.NDArray[np.float64]
F32 = npt.NDArray[np.float32]
Bool = npt.NDArray[np.bool_]

_MISS = 1e6  # metres; embree reports 1e37 for a ray that hits nothing
_SHADOW_START = 5e-4  # metres that a shadow ray starts above the surface, more than the mesh's sag
_TABLE_CELLS = 96
_CORNERS = ((-0.25, -0.25), (0.25, -0.25), (-0.25, 0.25), (0.25, 0.25))  # of a pixel, for antialiasing


@dataclass(frozen=True, slots=True)
class Camera:
    """`k` (3, 3) intrinsics; `cam_from_world` (3, 4), metres; a square picture of `size` pixels."""

    k: F64
    cam_from_world: F64
    size: int

    @property
    def centre(self) -> F64:
        """Position in the world (3,)."""
        return np.asarray(-self.cam_from_world[:, :3].T @ self.cam_from_world[:, 3])


@dataclass(frozen=True, slots=True)
class Picture:
    """`radiance`, `albedo` (H, W, 3) linear; `normal` (H, W, 3) world, unit; `alpha` (H, W) in [0, 1].

    Radiance is already covered by alpha; albedo and normal are means over the covered part of a pixel.
    `specular`: the mirror reflection's part of the radiance.
    """

    radiance: F64
    albedo: F64
    normal: F64
    alpha: F64
    specular: F64


@dataclass(frozen=True, slots=True)
class Hits:
    """First hits of the rays that hit: `pixel` (N,) flat index, `points`, `normals`, `to_eye` (N, 3)."""

    pixel: npt.NDArray[np.int64]
    points: F64
    normals: F64
    to_eye: F64


@dataclass(frozen=True, slots=True)
class Scene:
    """Data for rendering: the mesh in Embree, the light's table, the net of samples (4 S, 2), and the seed."""

    embree: Any
    table: F32
    net: F64
    seed: int
    shadows: bool


def scene_from_mesh(mesh: Mesh, coefficients: F64, samples: int, seed: int, shadows: bool = False) -> Scene:
    """Build the scene. `samples`, a power of two, counts the samples of each lobe in a quarter pixel."""
    embree = EmbreeScene()
    TriangleMesh(embree, mesh.vertices[mesh.faces].astype(np.float32))
    # Every aligned quarter of the net is a net too, so the four corners of a pixel have complementary samples.
    net = np.asarray(qmc.Sobol(2, scramble=False).random(4 * samples), dtype=np.float64)
    table = brdf.cube_table(lambda w: light.radiance(coefficients, w), _TABLE_CELLS)
    return Scene(embree, table, net, seed, shadows)


def render(scene: Scene, camera: Camera, stream: int) -> Picture:
    """Render one picture; `stream` selects its random numbers, for example the view's number."""
    pixels = camera.size * camera.size
    shift = np.random.default_rng((scene.seed, stream)).random((pixels, 2))
    radiance, albedo, normal, specular = (np.zeros((pixels, 3)) for _ in range(4))
    count = np.zeros(pixels)
    quarter = len(scene.net) // len(_CORNERS)
    for corner, offset in enumerate(_CORNERS):
        hits = _trace(scene, camera, offset)
        look = skin.material(hits.points, scene.seed)
        net = scene.net[corner * quarter : (corner + 1) * quarter]
        shaded, mirror = _shade(scene, hits, look, shift[hits.pixel], net)
        radiance[hits.pixel] += shaded
        specular[hits.pixel] += mirror
        albedo[hits.pixel] += look.albedo
        normal[hits.pixel] += hits.normals
        count[hits.pixel] += 1.0
    shape = (camera.size, camera.size)
    covered = np.maximum(count, 1.0)[:, None]
    length = np.maximum(np.linalg.norm(normal, axis=1, keepdims=True), 1e-12)
    return Picture(
        (radiance / len(_CORNERS)).reshape(*shape, 3),
        (albedo / covered).reshape(*shape, 3),
        (normal / length).reshape(*shape, 3),
        (count / len(_CORNERS)).reshape(shape),
        (specular / len(_CORNERS)).reshape(*shape, 3),
    )


def _trace(scene: Scene, camera: Camera, offset: tuple[float, float]) -> Hits:
    """First hits of one ray for each pixel, `offset` pixels (x, y) from the pixel's centre."""
    pixel = _pixels_near(camera)
    row, column = np.divmod(pixel, camera.size)
    in_plane = np.stack([column + offset[0], row + offset[1], np.ones(len(pixel))])
    direction = (camera.cam_from_world[:, :3].T @ np.linalg.solve(camera.k, in_plane)).T
    direction /= np.linalg.norm(direction, axis=1, keepdims=True)
    origin = camera.centre
    starts = np.broadcast_to(origin.astype(np.float32), direction.shape)
    ray_t = scene.embree.run(np.ascontiguousarray(starts), direction.astype(np.float32), query="DISTANCE")
    hit = np.asarray(ray_t) < _MISS
    direction = direction[hit]
    points = origin + direction * np.asarray(ray_t, dtype=np.float64)[hit][:, None]
    points, normals = _refine(points, direction)
    return Hits(pixel[hit], points, normals, -direction)


def _refine(points: F64, direction: F64) -> tuple[F64, F64]:
    """Move hits along their rays onto the zero level, and give its unit normals.

    t' = t - f / (g . d)

    The mesh lies within some 20 um of the surface, so one step leaves less than a micrometre; the gradient
    hardly changes over such a step and is taken before it.
    """
    value, gradient = head.distance_and_gradient(points)
    normals = gradient / np.maximum(np.linalg.norm(gradient, axis=1, keepdims=True), 1e-9)
    slope = np.einsum("ni,ni->n", gradient, direction)
    # At a silhouette the ray only grazes the surface: there a step along it means nothing and is bounded.
    step = value / np.minimum(slope, -0.05)
    return points - direction * np.clip(step, -1e-3, 1e-3)[:, None], normals


def _pixels_near(camera: Camera) -> npt.NDArray[np.int64]:
    """Flat indices of the pixels inside the picture of the head's bounding box."""
    corners = np.array(np.meshgrid(*head.BOUNDS.T)).reshape(3, -1)
    seen = camera.k @ (camera.cam_from_world[:, :3] @ corners + camera.cam_from_world[:, 3:])
    xy = seen[:2] / seen[2]
    low = np.clip(np.floor(xy.min(axis=1)).astype(int) - 1, 0, camera.size)
    high = np.clip(np.ceil(xy.max(axis=1)).astype(int) + 2, 0, camera.size)
    rows, columns = np.arange(low[1], high[1]), np.arange(low[0], high[0])
    return np.asarray((rows[:, None] * camera.size + columns).reshape(-1), dtype=np.int64)


def _shade(scene: Scene, hits: Hits, look: skin.Material, shift: F64, net: F64) -> tuple[F64, F64]:
    """Radiance (N, 3), and the mirror reflection's part of it."""
    width = look.roughness**2
    if not scene.shadows:
        return brdf.shade(hits.normals, hits.to_eye, look.albedo, look.f0, width, shift, net, scene.table)
    total, mirror = np.zeros_like(hits.points), np.zeros_like(hits.points)
    for point in net:
        diffuse, specular, weight = brdf.sample_directions(hits.normals, hits.to_eye, look.f0, width, shift, point)
        lit = _visible(scene, hits, diffuse)[:, None] * brdf.look_up_many(scene.table, diffuse)
        shine = _visible(scene, hits, specular)[:, None] * brdf.look_up_many(scene.table, specular)
        total += look.albedo * lit + weight[:, None] * shine
        mirror += weight[:, None] * shine
    return total / len(net), mirror / len(net)


def _visible(scene: Scene, hits: Hits, direction: F64) -> Bool:
    """Whether the light in `direction` (N, 3) reaches each hit."""
    starts = (hits.points + _SHADOW_START * hits.normals).astype(np.float32)
    blocked = scene.embree.run(starts, direction.astype(np.float32), query="OCCLUDED")
    return np.asarray(np.asarray(blocked) < 0)
