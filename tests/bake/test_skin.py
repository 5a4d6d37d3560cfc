"""Where the surface is skin: made-up heads of several tones."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
import pytest

from pipeline.meshes import Mesh
from pipeline.registration.head_regions import FIRST_BAND, HAIR, REGIONS, REST
from stages.bake.skin import MIN_FACE, skin_of

TONES = {"fair": (0.55, 0.34, 0.25), "brown": (0.22, 0.11, 0.07), "dark": (0.06, 0.035, 0.025)}
FACE, EARS, SCALP = (REGIONS.index(n) for n in ("face", "ears", "scalp"))
NECK = FIRST_BAND + 2
SIDE, STEP = 20, 0.002  # vertices along the side of a place, metres between them
N = SIDE * SIDE
Place = tuple[int, tuple[float, float, float] | float]


@dataclass
class Head:
    """A strip of places 4 cm wide, the first labelled face: mesh, face, albedo, region of skin_of."""

    mesh: Mesh
    face: np.ndarray
    albedo: np.ndarray
    region: np.ndarray

    def shares(self) -> list[float]:
        """Of each place, the share that is skin."""
        return self.skin().reshape(-1, N).mean(1).tolist()

    def skin(self) -> np.ndarray:
        return skin_of(self.mesh, self.face, self.albedo, self.region)[0]


def made(tone: str, *others: Place, gap: float | None = None) -> Head:
    """A face of a tone with a little noise, and other places: a region with a colour, or with the face's times a
    factor. gap: metres between the meshes of the last place and of those before; None: one mesh."""
    rng, places = np.random.default_rng(0), [(FACE, 1.0), *others]
    colours = [np.array(c) if isinstance(c, tuple) else c * np.array(TONES[tone]) for _, c in places]
    albedo = np.concatenate([c * np.exp(rng.normal(0, 0.08, (N, 1)) + rng.normal(0, 0.03, (N, 3))) for c in colours])
    rows, row, column = SIDE * len(places), *(i.ravel() for i in np.mgrid[: SIDE * len(places), :SIDE])
    x = STEP * np.stack([row, column, 0 * row], 1).astype(np.float32)
    x[-N:, 0] += 0.0 if gap is None else gap - STEP
    cut = rows - SIDE - 1 if gap is not None else -1
    corner = (np.setdiff1d(np.arange(rows - 1), [cut])[:, None] * SIDE + np.arange(SIDE - 1)).ravel()
    faces = np.concatenate([corner[:, None] + t for t in ([0, SIDE, 1], [1, SIDE, SIDE + 1])]).astype(np.int32)
    mesh = Mesh(vertices=x, normals=np.tile(np.float32([0, 0, 1]), (len(x), 1)), faces=faces)
    return Head(mesh, np.arange(len(x)) < N, albedo, np.repeat([r for r, _ in places], N))


@pytest.mark.parametrize("tone", TONES)
def test_ears_neck_and_a_bald_scalp_in_the_faces_colour_are_skin(tone: str) -> None:
    head = made(tone, (EARS, 0.9), (NECK, 0.8), (SCALP, 1.1))
    assert head.shares() == pytest.approx([1, 1, 1, 1], abs=0.02)


@pytest.mark.parametrize("gap", [None, 0.008])
@pytest.mark.parametrize("tone", TONES)
def test_bare_shoulders_are_skin_also_as_a_mesh_of_their_own(tone: str, gap: float | None) -> None:
    assert made(tone, (NECK, 0.9), (REST, 1.1), gap=gap).shares() == pytest.approx([1, 1, 1], abs=0.02)


def test_what_is_apart_from_the_head_is_none() -> None:
    """A hand that is held up, and a patch of cloth in the face's colour within other cloth."""
    assert made("fair", (NECK, 1.0), (REST, 1.0), gap=0.03).shares() == pytest.approx([1, 1, 0], abs=0.02)
    for where in (REST, NECK):
        assert made("fair", (where, (0.1, 0.1, 0.3)), (where, 1.0)).shares() == pytest.approx([1, 0, 0], abs=0.1)


@pytest.mark.parametrize("tone", TONES)
def test_hair_and_cloth_beside_skin_are_none(tone: str) -> None:
    """Grey cloth at the neck, and hair of a quarter of the tone."""
    head = made(tone, (SCALP, 0.2), (NECK, 1.0), (NECK, (0.5, 0.5, 0.5)), (REST, (0.5, 0.5, 0.5)))
    head.face[2 * N : 3 * N] = True
    assert head.shares() == pytest.approx([1, 0, 1, 0, 0], abs=0.05)


def test_cloth_that_is_like_skin_is_none_far_from_the_head() -> None:
    """Sheer pink cloth beside a bare chest: its hue is less than three spreads off, and counts at the neck alone."""
    pink = tuple(np.array(TONES["fair"]) * (1.0, 1.0, 1.33))
    assert made("fair", (NECK, 1.0), (REST, pink)).shares() == pytest.approx([1, 1, 0], abs=0.05)


def test_the_head_of_a_mesh_of_hair_is_none() -> None:
    head = made("fair", (HAIR, 1.0))
    head.face[: N + N // 2] = True  # also where photos label a fringe as the face
    assert head.shares() == pytest.approx([1, 0])


def test_fair_lines_of_a_shirt_are_none_and_moles_are_skin() -> None:
    """Lines 2 mm wide, 1 cm apart, in the face's colour; spots of a tenth of it."""
    head = made("fair", (NECK, 1.0), (NECK, (0.3, 0.05, 0.05)))
    head.albedo[2 * N :: 5] = TONES["fair"]
    head.albedo[N + 3 * SIDE + 5 : 2 * N : 5 * SIDE] *= 0.1
    assert head.shares() == pytest.approx([1, 1, 0], abs=0.06)


@pytest.mark.parametrize("tone", TONES)
def test_hollows_of_ears_are_skin_and_tell_nothing_about_it(tone: str) -> None:
    """Half as bright and redder; hair over an ear is none."""
    redder = tuple(np.array(TONES[tone]) * (0.7, 0.42, 0.42))
    head = made(tone, (EARS, 1.0), (EARS, redder), (EARS, 0.2))
    skin, telling = (m.reshape(-1, N).mean(1) for m in skin_of(head.mesh, head.face, head.albedo, head.region))
    assert skin == pytest.approx([1, 1, 1, 0], abs=0.02)
    assert telling == pytest.approx([1, 1, 0, 0], abs=0.02)


def test_brows_and_a_fringe_in_the_label_of_the_face_are_none() -> None:
    head = made("fair", (FACE, 0.15), (FACE, (0.5, 0.24, 0.22)))
    head.face[:] = True  # lips, redder than the face, stay skin
    assert head.shares() == pytest.approx([1, 0, 1], abs=0.05)


def test_without_a_head_or_with_few_labels() -> None:
    head = made("brown", (EARS, 1.0))
    np.testing.assert_array_equal(skin_of(head.mesh, head.face, head.albedo, None)[0], head.face)
    head.face = np.arange(len(head.face)) < MIN_FACE - 1
    np.testing.assert_array_equal(head.skin(), head.face)
    head.face[:], head.albedo[:] = False, 0.0
    np.testing.assert_array_equal(head.skin(), head.face)


def test_black_and_white_albedo_stay_finite() -> None:
    head = made("fair", (EARS, 1.0))
    head.albedo[N:] = 0.0
    assert head.skin()[N:].sum() == 0
    head.albedo[:] = 0.0
    assert head.skin().all()
