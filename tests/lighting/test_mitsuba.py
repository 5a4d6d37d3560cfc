"""The reference renderer of the standard material against a path tracer of somebody else's (Mitsuba 3)."""

from __future__ import annotations

from pathlib import Path

import numpy as np
import pytest
from support.ball_mesh import ball_mesh
from support.render_stand_ins import sphere_points
from support.synthetic_asset import RADIUS

from pipeline.camera import PinholeCamera
from pipeline.images import write_exr
from pipeline.lighting import standard
from pipeline.lighting.median_cut import lamps
from pipeline.maths.latlong import latlong_directions
from pipeline.transforms import inverse_rigid, project
from stages.usd.render.camera import orbit_camera

pytest.importorskip("mitsuba", reason="Mitsuba is not installed: no other renderer to compare with")
from benchmarks.referee import envmap, traced  # noqa: E402

SIDE, SAMPLES = 40, 64
PART = 6  # noise of 64 samples a pixel is averaged over squares of so many pixels


def sky() -> np.ndarray:
    """A smooth light with colour, from one side and above: a picture that is turned or mirrored is another light."""
    w = latlong_directions(128, 64)
    return np.exp(w @ np.array([0.4, 1.1, 0.7]))[..., None].astype(np.float32) * np.array([1.0, 0.8, 0.6], np.float32)


@pytest.fixture(scope="module")
def dome(tmp_path_factory: pytest.TempPathFactory) -> Path:
    path = tmp_path_factory.mktemp("sky") / "sky.exr"
    write_exr(path, sky())
    return path


def squares(image: np.ndarray, inside: np.ndarray) -> np.ndarray:
    """(N, 3) means over the squares that lie inside."""
    count = image.shape[0] // PART
    cut = slice(0, count * PART)
    whole = inside[cut, cut].reshape(count, PART, count, PART).all((1, 3))
    return np.asarray(image[cut, cut].reshape(count, PART, count, PART, 3).mean((1, 3))[whole])


def ours(view: PinholeCamera, base: float, f0: float, roughness: float) -> tuple[np.ndarray, np.ndarray]:
    """(H, W, 3) diffuse and specular radiance of a ball, on which nothing shades another part."""
    n, wo, inside = sphere_points(view, SIDE)
    lit = lamps(sky(), standard.COUNT)
    lamp = standard.table(lit)
    at = standard.Arrivals(lit.flux[None].astype(np.float32), lamp, np.ones((1, 3), np.float32))
    count = int(inside.sum())
    corner, weights = np.zeros((count, 3), np.int32), np.full((count, 3), 1 / 3, np.float32)
    values = (np.full((count, 3), base), np.full(count, f0), np.full(count, roughness))
    b, f, r = (np.asarray(v, np.float32) for v in values)
    made = standard.radiance(at, corner, weights, n[inside], wo[inside], b, f, r)
    images = []
    for part in made:
        image = np.zeros((SIDE, SIDE, 3))
        image[inside] = part
        images.append(image)
    return images[0], images[1]


def ball(bsdf: dict[str, object]) -> dict[str, object]:
    return {"type": "sphere", "radius": RADIUS, "bsdf": bsdf}


@pytest.mark.parametrize("azimuth", [0.5, -2.0])
def test_a_diffuse_ball_under_a_dome(dome: Path, azimuth: float) -> None:
    """Within 1 %: where the light comes from, its level, and 1 / pi."""
    view = orbit_camera(RADIUS, azimuth, SIDE, elevation=0.2)
    bsdf = {"type": "diffuse", "reflectance": {"type": "rgb", "value": [0.4, 0.4, 0.4]}}
    theirs = traced(view, {"light": envmap(dome), "ball": ball(bsdf)}, SIDE, SAMPLES)
    inside = sphere_points(view, SIDE)[2]
    mine, shown = squares(ours(view, 0.4, 0.0, 0.5)[0], inside), squares(theirs[..., :3], inside)
    assert len(mine) >= 8 and np.ptp(mine[:, 0]) > 0.3 * mine[:, 0].mean()  # lit from one side
    np.testing.assert_allclose(mine, shown, rtol=0.02)
    assert mine.mean() == pytest.approx(shown.mean(), rel=0.01)


@pytest.mark.parametrize("roughness", [0.4, 0.6])
def test_a_glossy_ball_under_a_dome(dome: Path, roughness: float) -> None:
    """F0 = 1 is a conductor without colour: D and masking alone. Mitsuba multiplies the two maskings of Smith, which
    correlate with height here: 5 % at most away from the rim."""
    view = orbit_camera(RADIUS, 0.5, SIDE, elevation=0.2)
    bsdf = {"type": "roughconductor", "material": "none", "distribution": "ggx", "alpha": roughness**2}
    theirs = traced(view, {"light": envmap(dome), "ball": ball(bsdf)}, SIDE, SAMPLES, depth=2)
    n, wo, inside = sphere_points(view, SIDE)
    inside &= (n * wo).sum(-1) > 0.5
    mine, shown = squares(ours(view, 0.0, 1.0, roughness)[1], inside), squares(theirs[..., :3], inside)
    assert len(mine) >= 6 and np.ptp(mine[:, 0]) > 0.3 * mine[:, 0].mean()
    np.testing.assert_allclose(mine, shown, rtol=0.06)
    assert mine.mean() == pytest.approx(shown.mean(), rel=0.03)


def write_obj(path: Path, vertices: np.ndarray, faces: np.ndarray) -> None:
    lines = [f"v {x:.9g} {y:.9g} {z:.9g}" for x, y, z in vertices]
    lines += [f"f {a} {b} {c}" for a, b, c in faces + 1]
    path.write_text("\n".join(lines) + "\n")


def plate(side: int = 25, reach: float = 0.36) -> tuple[np.ndarray, np.ndarray]:
    """A square below the ball that looks up."""
    x, z = np.meshgrid(np.linspace(-reach, reach, side), np.linspace(-reach, reach, side))
    vertices = np.stack([x.ravel(), np.full(side * side, -1.05 * RADIUS), z.ravel()], 1)
    at = np.arange(side * side).reshape(side, side)
    a, b, c, d = at[:-1, :-1].ravel(), at[:-1, 1:].ravel(), at[1:, 1:].ravel(), at[1:, :-1].ravel()
    return vertices, np.concatenate([np.stack([a, c, b], 1), np.stack([a, d, c], 1)]).astype(np.int32)


def test_shadows_and_light_between_parts(dome: Path, tmp_path: Path) -> None:
    """A ball over a plate: what the plate gets at its vertices, beside the ball and in its shadow."""
    albedo, mesh = 0.6, ball_mesh(RADIUS)[0]
    low, below = plate()
    vertices = np.concatenate([mesh.vertices, low]).astype(np.float32)
    up = np.broadcast_to(np.float32([0, 1, 0]), low.shape)
    normals = np.concatenate([mesh.vertices / RADIUS, up]).astype(np.float32)
    faces = np.concatenate([mesh.faces, below + len(mesh.vertices)]).astype(np.int32)
    at = standard.arrivals(vertices, normals, faces, lamps(sky(), 256), np.full(vertices.shape, albedo))
    write_obj(tmp_path / "scene.obj", vertices, faces)
    bsdf = {"type": "twosided", "bsdf": {"type": "diffuse", "reflectance": {"type": "rgb", "value": [albedo] * 3}}}
    shape = {"type": "obj", "filename": str(tmp_path / "scene.obj"), "face_normals": True, "bsdf": bsdf}
    view = orbit_camera(0.3, 0.0, 90, elevation=0.9)
    image = traced(view, {"light": envmap(dome), "scene": shape}, 90, 96, depth=5)
    pixels = project(view.K, inverse_rigid(view.world_from_cam), view.distortion, low)[0]
    rows, theirs = [], []
    for number, (u, v) in enumerate(pixels):
        x, z = low[number, 0], low[number, 2]
        seen = z > 1.02 * RADIUS or (np.hypot(x, z) > 1.8 * RADIUS and z > -0.05)  # the camera sees it past the ball
        if seen and max(abs(x), abs(z)) < 0.34 and 2 <= u < 88 and 2 <= v < 88:
            rows.append(number)
            theirs.append(image[int(v) - 1 : int(v) + 2, int(u) - 1 : int(u) + 2, :3].mean((0, 1)))
    wanted = np.array(theirs)
    mine = at.irradiance[len(mesh.vertices) :][rows] * albedo / np.pi
    lit = lamps(sky(), 256)
    empty = (np.maximum(lit.directions[:, 1], 0) @ lit.flux) * albedo / np.pi  # without the ball
    assert len(mine) >= 20 and wanted[:, 0].min() < 0.93 * empty[0]  # some lie in its shadow
    np.testing.assert_allclose(mine, wanted, rtol=0.05)
    assert mine.mean() == pytest.approx(wanted.mean(), rel=0.02)
