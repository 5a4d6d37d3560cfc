"""The asset renderer against closed forms on a sphere."""

from __future__ import annotations

import numpy as np
import pytest
from support.render_stand_ins import asset, sphere_points
from support.synthetic_asset import RADIUS, smooth_light, texture_arrays, write_inputs

from pipeline.camera import PinholeCamera
from pipeline.map_lookup import bilinear, lookup
from pipeline.transforms import inverse_rigid, project
from stages.usd.render.camera import orbit_camera
from stages.usd.render.render import Renderer, tangents
from stages.usd.write.mesh import UvSurface, read_mesh, uv_fault, with_uvs_from

SIZE = 64


def test_constant_light_gives_the_albedo() -> None:
    """a / pi * pi L = a L."""
    view = orbit_camera(RADIUS, 0.3, SIZE)
    image = Renderer(asset()).render(view, samples=1)
    inside = sphere_points(view, SIZE)[2]
    np.testing.assert_allclose(image[inside][:, :3], 0.4, atol=1e-4)
    assert (image[inside][:, 3] == 1).all()
    assert (image[0, 0] == 0).all()


def test_alpha_is_the_disc() -> None:
    image = Renderer(asset()).render(orbit_camera(RADIUS, 0.0, 128), samples=4)
    radius = np.sqrt(image[..., 3].sum() / np.pi)
    assert radius == pytest.approx(64 / 1.02, rel=2e-3)
    np.testing.assert_allclose(image[..., 0], 0.4 * image[..., 3], atol=1e-4)  # premultiplied


def test_soft_silhouettes_keep_the_disc_and_its_inside() -> None:
    """samples = 0: a triangle filter on the edge moves no area and leaves the inside alone."""
    view = orbit_camera(RADIUS, 0.0, 128)
    sharp, soft = (Renderer(asset()).render(view, samples=n) for n in (8, 0))
    assert soft[..., 3].sum() == pytest.approx(sharp[..., 3].sum(), rel=5e-4)
    within = (sharp[..., 3] > 0.02) & (sharp[..., 3] < 0.98)
    mixed = (soft[..., 3] > 0.02) & (soft[..., 3] < 0.98)
    assert mixed.sum() > 1.4 * within.sum()  # two pixels wide in place of one
    np.testing.assert_allclose(soft[..., 0], 0.4 * soft[..., 3], atol=1e-4)
    assert np.abs(soft - sharp)[40:88, 40:88].max() < 1e-6


def test_first_order_light() -> None:
    """E(n) = pi L_0 + (2 pi / 3) L_1 . n with L(d) = L_0 + L_1 . d."""
    light = np.zeros((121, 3), np.float32)
    slope = np.array([0.3, 0.5, -0.2])
    light[0] = np.sqrt(4 * np.pi)
    light[[3, 1, 2]] = slope[:, None] / np.sqrt(3 / (4 * np.pi))
    view = orbit_camera(RADIUS, 0.7, SIZE, elevation=0.2)
    image = Renderer(asset()).render(view, samples=1, light=light)
    n, _, inside = sphere_points(view, SIZE)
    wanted = 0.4 / np.pi * (np.pi + 2 * np.pi / 3 * (n @ slope))
    np.testing.assert_allclose(image[inside][:, 1], wanted[inside], atol=2e-3)


def test_mirror_shows_the_light_of_the_mirror_direction() -> None:
    """kappa to infinity: the specular term is the basis times L(w_r)."""
    basis = np.linspace(0.2, 1, 32, dtype=np.float32)[:, None]
    made = asset(albedo=np.zeros((8, 8, 3), np.float32), coefficients=np.full((8, 8, 1), 0.5, np.float32), basis=basis)
    light = np.zeros((121, 3), np.float32)
    slope = np.array([0.1, 0.6, 0.3])
    light[0] = np.sqrt(4 * np.pi)
    light[[3, 1, 2]] = slope[:, None] / np.sqrt(3 / (4 * np.pi))
    view = orbit_camera(RADIUS, -0.4, SIZE)
    image = Renderer(made).render(view, samples=1, light=light)
    n, wo, inside = sphere_points(view, SIZE)
    cosine = (n * wo).sum(-1)
    mirror = 2 * cosine[..., None] * n - wo
    column = np.interp(cosine, (np.arange(32) + 0.5) / 32, basis[:, 0])
    np.testing.assert_allclose(image[inside][:, 0], (0.5 * column * (1 + mirror @ slope))[inside], atol=4e-3)


@pytest.mark.parametrize("attenuation, factor", [("exact", 1 / np.tanh(5) - 0.2), ("exponential", np.exp(-0.2))])
def test_rough_lobes_soften_the_light(attenuation: str, factor: float) -> None:
    """Order 1 under kappa = 5: A_1 = coth(kappa) - 1 / kappa, or the paper's exp(-1 / kappa)."""
    made = asset(
        albedo=np.zeros((8, 8, 3), np.float32),
        coefficients=np.ones((8, 8, 1), np.float32),
        inv_kappa=np.full((8, 8, 1), 0.2, np.float32),
        attenuation=attenuation,
    )
    light = np.zeros((121, 3), np.float32)
    light[0], light[1] = np.sqrt(4 * np.pi), 0.8 / np.sqrt(3 / (4 * np.pi))
    view = orbit_camera(RADIUS, 0.0, SIZE)
    image = Renderer(made).render(view, samples=1, light=light)
    n, wo, inside = sphere_points(view, SIZE)
    mirror = 2 * (n * wo).sum(-1)[..., None] * n - wo
    np.testing.assert_allclose(image[inside][:, 0], (1 + 0.8 * factor * mirror[..., 1])[inside], atol=6e-3)


def test_flat_normal_map_changes_nothing_and_a_tilted_one_turns_the_right_way() -> None:
    light = smooth_light()
    view = orbit_camera(RADIUS, 0.5, SIZE)
    flat = np.broadcast_to(np.float32([0, 0, 1]), (8, 8, 3))
    plain, same = (Renderer(asset(light=light, normal=n)).render(view, samples=1) for n in (None, flat))
    np.testing.assert_allclose(plain, same, atol=1e-5)
    tilted = np.broadcast_to(np.float32([np.sin(0.3), 0, np.cos(0.3)]), (8, 8, 3))
    light = np.zeros((121, 3), np.float32)
    light[0] = np.sqrt(4 * np.pi)
    light[3] = 0.9 / np.sqrt(3 / (4 * np.pi))  # grows along +x
    image = Renderer(asset(light=light, normal=tilted)).render(orbit_camera(RADIUS, 0.0, SIZE), samples=1)
    middle = image[SIZE // 2 - 1 : SIZE // 2 + 1, SIZE // 2 - 1 : SIZE // 2 + 1, 0].mean()
    assert middle == pytest.approx(0.4 * (1 + 2 / 3 * 0.9 * np.sin(0.3)), abs=2e-3)  # u grows towards +x there


def test_a_normal_map_tilted_along_v_looks_up() -> None:
    """Green is +y: towards growing v, which is up on this ball."""
    light = np.zeros((121, 3), np.float32)
    light[0], light[1] = np.sqrt(4 * np.pi), 0.9 / np.sqrt(3 / (4 * np.pi))  # grows along +y
    tilted = np.broadcast_to(np.float32([0, np.sin(0.3), np.cos(0.3)]), (8, 8, 3))
    for azimuth in (0.0, 2.0, 4.5):
        image = Renderer(asset(light=light, normal=tilted)).render(orbit_camera(RADIUS, azimuth, SIZE), samples=1)
        middle = image[SIZE // 2 - 1 : SIZE // 2 + 1, SIZE // 2 - 1 : SIZE // 2 + 1, 0].mean()
        assert middle == pytest.approx(0.4 * (1 + 2 / 3 * 0.9 * np.sin(0.3)), abs=2e-3)


def test_silhouette_lies_where_the_distorted_camera_projects_it() -> None:
    """An off-centre ball seen through a strong lens: its outline's mean is that of its projected contour."""
    view = orbit_camera(RADIUS, 0.0, 200, centre=np.array([0.06, 0.04, 0.0]))
    K = view.K.copy()
    K[0, 0] *= 0.6
    K[1, 1] *= 0.5
    bent = PinholeCamera(K, view.world_from_cam, 200, 200, np.array([-0.4, 0.1, 0.02, -0.03, 0.0]))
    alpha = Renderer(asset()).render(bent, samples=2)[..., 3]
    row, column = np.mgrid[:200, :200] + 0.5
    found = np.array([(alpha * column).sum(), (alpha * row).sum()]) / alpha.sum()
    eye = view.world_from_cam[:3, 3]  # the contour: a circle around the axis from the eye to the ball
    distance = np.linalg.norm(eye)
    axis, turn = -eye / distance, np.linspace(0, 2 * np.pi, 4000, endpoint=False)
    side = np.cross(axis, [0, 1, 0]) / np.linalg.norm(np.cross(axis, [0, 1, 0]))
    across = np.cos(turn)[:, None] * side + np.sin(turn)[:, None] * np.cross(axis, side)
    near = RADIUS**2 / distance
    contour = -axis * near + across * np.sqrt(RADIUS**2 - near**2)
    uv = project(K, inverse_rigid(view.world_from_cam), bent.distortion, contour)[0]
    x, y = uv.T
    cross = x * np.roll(y, -1) - np.roll(x, -1) * y
    wanted = [((a + np.roll(a, -1)) * cross).sum() / (3 * cross.sum()) for a in (x, y)]  # a polygon's centroid
    assert np.abs(found - wanted).max() < 0.02


def test_tangent_follows_u() -> None:
    mesh = asset().mesh
    t = tangents(asset())
    p = mesh.vertices[mesh.faces].astype(np.float64)
    east = np.cross([0, 1, 0], p)
    middle = np.abs(p[..., 1]) < 0.1
    cosine = (t[..., :3] * east).sum(-1) / np.linalg.norm(east, axis=-1).clip(1e-9)
    assert cosine[middle].min() > 0.999
    assert (t[..., 3] == 1).all()


def test_distortion_and_factor_keep_the_picture_in_place() -> None:
    """A distorted camera's picture at factor 2 is the mean over 2 x 2 of its picture at factor 1."""
    view = orbit_camera(RADIUS, 0.0, 64)
    bent = PinholeCamera(view.K, view.world_from_cam, 64, 64, np.array([-0.9, 0.0, 0.01, 0.0, 0.0]))
    renderer = Renderer(asset(light=smooth_light()))
    fine, coarse = renderer.render(bent, samples=1), renderer.render(bent, factor=2, samples=2)
    np.testing.assert_allclose(fine.reshape(32, 2, 32, 2, 4).mean((1, 3)), coarse, atol=1e-6)
    assert np.abs(fine - renderer.render(view, samples=1)).max() > 0.1


def test_bilinear_on_texel_centres_borders_and_between() -> None:
    image = np.arange(12, dtype=np.float32).reshape(3, 4, 1)
    centres = np.array([[0.125, 5 / 6], [0.875, 1 / 6], [0.25, 5 / 6], [-3.0, 7.0]])  # row 0 is the top
    np.testing.assert_allclose(bilinear(image, centres)[:, 0], [0, 11, 0.5, 0], atol=1e-6)


def test_lookup_is_linear_and_clamped() -> None:
    table = np.array([[0.0], [1.0]], np.float32)
    np.testing.assert_allclose(lookup(table, np.array([0.0, 0.25, 0.5, 0.75, 1.0]))[:, 0], [0, 0, 0.5, 1, 1])


def test_nothing_in_sight_is_black() -> None:
    view = orbit_camera(RADIUS, 0.0, 16)
    away = view.world_from_cam.copy()
    away[:3, :3] = away[:3, :3] @ np.diag([1.0, -1.0, -1.0])
    assert Renderer(asset()).render(PinholeCamera(view.K, away, 16, 16)).max() == 0


def test_exported_maps_are_read_back(exported) -> None:
    from stages.usd.render.exported import load_exported

    read, wanted = load_exported(exported[0] / "asset/head.usd"), texture_arrays()
    assert read.occlusion is not None
    np.testing.assert_allclose(read.albedo * read.occlusion, wanted["albedo"], rtol=2**-10)  # two half floats
    np.testing.assert_allclose(read.basis, wanted["basis_lut"][0], atol=1e-6)
    np.testing.assert_allclose(read.normal, wanted["normal"], atol=1e-2)
    np.testing.assert_allclose(read.light, smooth_light(), rtol=1e-6)


def test_channels_are_in_the_order_of_their_numbers(tmp_path) -> None:
    """c10 comes after c9, not after c1."""
    from pipeline.images import write_exr
    from stages.usd.render.exported import numbered

    values = np.broadcast_to(np.arange(12, dtype=np.float32), (2, 2, 12))
    write_exr(tmp_path / "textures/x_specular_coefficients.exr", values, tuple(f"c{i}" for i in range(12)))
    np.testing.assert_array_equal(numbered(tmp_path / "textures/x_specular_coefficients.exr")[0, 0], np.arange(12))


def test_a_proxy_that_can_not_be_textured_is_reported(tmp_path) -> None:
    inputs = write_inputs(tmp_path)
    full = read_mesh(inputs.uv.path(inputs.uv.artifact.mesh))
    proxy = read_mesh(inputs.uv.path(inputs.uv.artifact.proxy), with_uvs=False)
    good = with_uvs_from(proxy, full)
    assert uv_fault(good, full) == ""
    mirrored = UvSurface(good.vertices, good.normals, good.faces, good.uvs, good.uv_faces[:, ::-1].copy())
    flipped = UvSurface(full.vertices, full.normals, full.faces, full.uvs * [-1, 1] + [1, 0], full.uv_faces)
    assert uv_fault(with_uvs_from(proxy, flipped), flipped) == ""  # an atlas that mirrors the chart is no fault
    assert "mirrored" in uv_fault(mirrored, full)
    empty = UvSurface(good.vertices, good.normals, good.faces, good.uvs * 0, good.uv_faces)
    assert "no area" in uv_fault(empty, full)
