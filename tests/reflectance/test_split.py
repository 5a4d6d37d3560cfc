"""Albedo, lobes, normals and shadows from samples that were made with known ones."""

from __future__ import annotations

import numpy as np
import pytest

from pipeline.artifacts import Camera
from stages.reflectance.rig import Rig
from stages.reflectance.samples import falling
from stages.reflectance.split import chosen_widths, harmonics, penalties, split
from stages.reflectance.texels import Pairs, Points
from tests.support.light_stage import make_stage

ALPHAS = (0.25, 0.12, 0.03)
TEXELS = 24


def silent(done: int, total: int, message: str) -> None:
    pass


def rig_with(cameras: int = 4, lights: int = 60) -> Rig:
    stage = make_stage(cameras, lights)
    made = tuple(
        Camera(index=i, name=str(i), width=8, height=8, K=((1, 0, 0), (0, 1, 0), (0, 0, 1)),
               world_from_cam=tuple(map(tuple, pose)), distortion=(0, 0, 0, 0, 0))
        for i, pose in enumerate(stage.poses)
    )  # fmt: skip
    axis = -stage.positions / np.linalg.norm(stage.positions, axis=1, keepdims=True)
    still = np.broadcast_to(np.eye(4), (lights, 4, 4)).copy()
    return Rig(tuple(range(lights)), stage.positions, axis, stage.intensities, made, still)


class Made:
    """Texels on a cap that faces the cameras, with known material, and their samples."""

    def __init__(
        self, rig: Rig, *, tilt: float = 0.0, specular: float = 1.0, scale: float = 1.0, seed: int = 0
    ) -> None:
        rng = np.random.default_rng(seed)
        spread = rng.normal(size=(TEXELS, 3)) * [0.25, 0.25, 0] + [0, 0.1, 1]
        self.normal = spread / np.linalg.norm(spread, axis=1, keepdims=True)
        position = 0.1 * self.normal
        self.albedo = scale * np.array([0.5, 0.3, 0.25]) * rng.uniform(0.6, 1.2, (TEXELS, 1))
        self.lobes = specular * np.stack(
            [rng.uniform(0.01, 0.02, TEXELS), rng.uniform(0, 0.03, TEXELS), rng.uniform(0, 0.02, TEXELS)], 1
        )
        off = self.normal + tilt * rng.normal(size=(TEXELS, 3))
        self.start = off / np.linalg.norm(off, axis=1, keepdims=True)
        count = len(rig.cameras)
        self.points = Points(
            64, np.arange(TEXELS), np.zeros(TEXELS, np.int64), np.ones((TEXELS, 3)) / 3, position, self.start
        )
        self.pairs = Pairs(np.arange(0, TEXELS * count + 1, count), np.repeat(np.arange(TEXELS), count),
                           np.tile(np.arange(count, dtype=np.int32), TEXELS), np.ones(TEXELS * count))  # fmt: skip
        self.rig = rig
        self.cosine = np.zeros((TEXELS, len(rig.index)))
        table = np.zeros((TEXELS * count, len(rig.index), 3))
        eyes = rig.eyes()
        for i, lamp in enumerate(rig.position):
            towards = lamp - position
            towards /= np.linalg.norm(towards, axis=1, keepdims=True)
            nl = np.maximum((towards * self.normal).sum(1), 0)
            self.cosine[:, i] = nl
            for c in range(count):
                view = eyes[c, i] - position
                view /= np.linalg.norm(view, axis=1, keepdims=True)
                half = towards + view
                half /= np.linalg.norm(half, axis=1, keepdims=True)
                nv, nh, vh = (self.normal * view).sum(1), (self.normal * half).sum(1), (view * half).sum(1)
                shine = np.zeros(TEXELS)
                for j, alpha in enumerate(ALPHAS):  # GGX with Smith's height-correlated shadowing, written out
                    a2 = alpha**2
                    d = a2 / (np.pi * (nh**2 * (a2 - 1) + 1) ** 2)
                    lam_l, lam_v = (0.5 * (np.sqrt(1 + a2 * (1 / np.maximum(x, 1e-3) ** 2 - 1)) - 1) for x in (nl, nv))
                    g = 1 / (1 + lam_l + lam_v)
                    fresnel = 0.04 + 0.96 * (1 - vh) ** 5
                    shine += self.lobes[:, j] / 0.04 * fresnel * d * g / (4 * np.maximum(nl, 1e-3) * nv) * nl
                table[c::count, i] = np.where(nl[:, None] > 0, self.albedo / np.pi * nl[:, None] + shine[:, None], 0)
        self.table = table

    def fitted(self, arrives: np.ndarray | None = None, table: np.ndarray | None = None, prior: float = 0.001):
        lit = np.where(self.cosine > 0, 255, 0).astype(np.uint8) if arrives is None else arrives
        values = (self.table if table is None else table).astype(np.float16)
        return split(self.points, self.pairs, values, self.rig, lit, ALPHAS, prior, 2, silent)


def angle(a, b):
    return np.degrees(np.arccos(np.clip((a * b).sum(1) / np.linalg.norm(a, axis=1) / np.linalg.norm(b, axis=1), -1, 1)))


def off(found, true) -> float:
    """Median relative error over the texels: single ones may lie at the border of what is known."""
    return float(np.median(np.abs(found / true - 1)))


def test_material_and_normals_are_those_of_the_samples() -> None:
    made = Made(rig_with(), tilt=0.1)
    assert np.median(angle(made.start, made.normal)) > 4
    found = made.fitted()
    assert np.median(angle(found.normal, made.normal)) < 0.7
    np.testing.assert_allclose(found.albedo, made.albedo, rtol=0.06)
    np.testing.assert_allclose(found.lobes[:, :2].sum(1), made.lobes[:, :2].sum(1), atol=0.012)
    assert np.abs(found.rest).max() < 0.05


def test_a_matt_surface_has_no_lobes() -> None:
    made = Made(rig_with(), specular=0)
    found = made.fitted()
    np.testing.assert_allclose(found.albedo, made.albedo, rtol=0.02)
    assert found.lobes.max() < 2e-3


def test_light_that_other_skin_sends_is_found_as_the_smooth_rest() -> None:
    """Oracle: a constant and a gradient over the light's direction, added to every sample of a texel."""
    rig = rig_with()
    made = Made(rig, specular=0)
    extra = 0.02 + 0.01 * rig.towards[:, 1]
    found = made.fitted(table=made.table + extra[None, :, None])
    said = np.einsum("tkc,lk->tlc", found.rest, harmonics(rig.towards, 2))
    unlit = made.cosine == 0
    assert np.median(np.abs(said - extra[None, :, None])[unlit]) < 0.006
    assert off(found.albedo, made.albedo) < 0.04  # with lit samples in the first rest it was .36


def test_shadows_that_the_trace_misses_are_seen_in_the_pictures() -> None:
    made = Made(rig_with(), specular=0)
    dark = (made.cosine > 0.3) & (made.rig.towards[:, 0] > 0.3)[None]
    table = made.table * np.where(np.repeat(dark, 4, 0), 0.0, 1.0)[..., None]
    found = made.fitted(table=table)
    assert np.median(found.shadow[dark]) < -0.9  # traced as lit, seen as dark
    assert np.quantile(np.abs(found.shadow[(made.cosine > 0.3) & ~dark]), 0.9) < 0.05
    assert off(found.albedo, made.albedo) < 0.01


def test_light_that_the_trace_blocks_wrongly_is_seen_in_the_pictures() -> None:
    """A trace without any light: the fit starts from the bright samples."""
    made = Made(rig_with(), specular=0)
    found = made.fitted(arrives=np.zeros_like(made.cosine, np.uint8))
    assert np.median(found.shadow[made.cosine > 0.3]) > 0.9
    np.testing.assert_allclose(np.median(found.albedo / made.albedo), 1, atol=0.05)


def test_clipped_glints_do_not_change_the_albedo() -> None:
    made = Made(rig_with())
    found = made.fitted(table=np.minimum(made.table, 0.35))
    assert off(found.albedo, made.albedo) < 0.01


def test_pictures_that_are_missing_are_left_out() -> None:
    made = Made(rig_with(), specular=0)
    table = made.table.copy()
    table[1::4, 10:20] = np.nan
    found = made.fitted(table=table)
    assert np.isfinite(found.albedo).all() and np.isfinite(found.rest).all() and np.isfinite(found.shadow).all()
    np.testing.assert_allclose(found.albedo, made.albedo, rtol=0.03)


@pytest.mark.parametrize(("lights", "scale"), [(1, 1.0), (60, 0.0)])
def test_at_the_extremes_everything_stays_finite(lights, scale) -> None:
    """One light; all pictures black."""
    rig = rig_with()
    rig = rig.without(list(range(lights, 60)))
    made = Made(rig, specular=scale, scale=scale)
    found = made.fitted(prior=0.02)
    for values in (found.albedo, found.lobes, found.normal, found.rest, found.shadow):
        assert np.isfinite(values).all()
    if scale == 0:
        assert found.albedo.max() < 1e-3 and found.lobes.max() < 1e-3


def test_an_intensity_of_a_million_changes_nothing() -> None:
    lamp, axis = np.array([0, 0, 1.3]), np.array([0, 0, -1.0])
    e = falling(np.zeros((1, 3)), lamp, axis, np.array([4.0, 4, 4]))
    np.testing.assert_allclose(e, 4 / 1.69)
    np.testing.assert_allclose(falling(np.zeros((1, 3)), lamp, axis, np.full(3, 4e6)), e * 1e6)
    assert (falling(np.array([[0, 0, 2.0]]), lamp, axis, np.ones(3)) > 0).all()  # behind the lamp


def test_texels_that_nobody_sees_stay_as_they_are() -> None:
    made = Made(rig_with())
    nobody = Pairs(np.zeros(TEXELS + 1, np.int64), np.zeros(0, np.int64), np.zeros(0, np.int32), np.zeros(0))
    found = split(made.points, nobody, np.zeros((0, 60, 3), np.float16), made.rig,
                  np.zeros((TEXELS, 60), np.uint8), ALPHAS, 0.02, 2, silent)  # fmt: skip
    assert not found.albedo.any()
    np.testing.assert_allclose(found.normal, made.start, atol=1e-6)


@pytest.mark.slow
def test_the_lobes_widths_are_measured() -> None:
    made = Made(rig_with(6, 120))
    lit = np.where(made.cosine > 0, 255, 0).astype(np.uint8)
    found = chosen_widths(made.points, made.pairs, made.table.astype(np.float16), made.rig, lit, 0.01, silent)
    assert found[0] == 0.25 and found[2] in (0.03, 0.02)


def test_the_penalty_is_the_squared_laplacian() -> None:
    """Oracle: the eigenvalues l (l + 1) of the Laplacian on the sphere."""
    values = penalties(3)
    assert len(values) == 16
    np.testing.assert_allclose((values - 1e-3)[[0, 1, 4, 9]], 0.5 / 36 * np.array([0, 4, 36, 144]))


@pytest.mark.parametrize("arrived", [0.0, 0.3, 0.8, 1.0])
def test_the_share_that_arrives_is_that_of_the_model(arrived: float) -> None:
    """A matt texel seen by two cameras, one of which says a little more and one a little less."""
    from stages.reflectance.fit_kernels import observe

    point, normal = np.zeros((1, 3)), np.array([[0.0, 0, 1]])
    light, axis = np.array([[0.3, 0.2, 1.0]]), -np.array([[0.3, 0.2, 1.0]]) / np.sqrt(1.13)
    eyes = np.array([[[0.0, 0.5, 1.0]], [[-0.5, 0.0, 1.0]]])
    albedo, lobes, alphas = np.array([[0.6, 0.4, 0.3]]), np.zeros((1, 3)), np.array([0.3, 0.12, 0.04])
    model = albedo[0] / np.pi / np.sqrt(1.13)
    samples = (arrived * model * np.array([[1.05], [0.95]]))[:, None].astype(np.float32)
    share, trust = np.zeros((1, 1), np.float32), np.zeros((1, 1), np.float32)
    observe(point, normal, np.array([0, 2]), np.array([0, 1]), np.ones(2), samples, light, axis, eyes, alphas, albedo,
            lobes, 0.1, share, trust)  # fmt: skip
    assert float(share[0, 0]) == pytest.approx(arrived, abs=1e-5) and float(trust[0, 0]) == 1


def test_colours_of_texels_that_only_grazing_pixels_show_are_not_kept() -> None:
    """Squared cosines: the best camera decides; a texel that none sees, and one of a single grazing camera."""
    weight = np.array([0.04, 0.5, 0.08, 0.089, 0.091])
    pairs = Pairs(np.array([0, 2, 2, 4, 5]), np.array([0, 0, 2, 2, 3]), np.zeros(5, np.int32), weight)
    assert pairs.seen.tolist() == [True, False, True, True]
    assert pairs.sure.tolist() == [True, False, False, True]
    nobody = Pairs(np.zeros(3, np.int64), np.zeros(0, np.int64), np.zeros(0, np.int32), np.zeros(0))
    assert not nobody.sure.any() and nobody.sure.shape == (2,)
