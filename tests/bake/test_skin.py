"""Where the surface is skin: made-up heads of several tones."""

from __future__ import annotations

import numpy as np
import pytest

from stages.bake.skin import MIN_FACE, skin_of
from stages.bake.unseen import FIRST_BAND, REGIONS, REST

TONES = {"fair": (0.55, 0.34, 0.25), "brown": (0.22, 0.11, 0.07), "dark": (0.06, 0.035, 0.025)}
FACE, EARS, SCALP = (REGIONS.index(n) for n in ("face", "ears", "scalp"))
N = 200


def made(
    tone: str, *others: tuple[int, tuple[float, float, float] | float]
) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
    """face, albedo, region of N vertices of a face with a little noise, and N of each other place: a region with a
    colour, or with the face's times a factor."""
    rng = np.random.default_rng(0)
    skin = np.array(TONES[tone])
    colours = [skin] + [np.array(c) if isinstance(c, tuple) else c * skin for _, c in others]
    albedo = np.concatenate([c * np.exp(rng.normal(0, 0.08, (N, 1)) + rng.normal(0, 0.03, (N, 3))) for c in colours])
    region = np.repeat([FACE, *(r for r, _ in others)], N)
    return np.arange(len(albedo)) < N, albedo, region


@pytest.mark.parametrize("tone", TONES)
def test_ears_neck_and_a_bald_scalp_in_the_faces_colour_are_skin(tone: str) -> None:
    face, albedo, region = made(tone, (EARS, 0.9), (FIRST_BAND + 2, 0.8), (SCALP, 1.1))
    assert skin_of(face, albedo, region).reshape(-1, N).mean(1) == pytest.approx([1, 1, 1, 1], abs=0.05)


@pytest.mark.parametrize("tone", TONES)
def test_hair_cloth_and_what_is_far_from_the_head_are_none(tone: str) -> None:
    """A hand has the face's colour and is not the head's; grey cloth at the neck; hair of a quarter of the tone."""
    face, albedo, region = made(tone, (SCALP, 0.2), (FIRST_BAND, (0.5, 0.5, 0.5)), (REST, 1.0))
    assert skin_of(face, albedo, region).reshape(-1, N).mean(1) == pytest.approx([1, 0, 0, 0], abs=0.05)


def test_brows_and_a_fringe_in_the_label_of_the_face_are_none() -> None:
    face, albedo, region = made("fair", (FACE, 0.15), (FACE, (0.5, 0.24, 0.22)))
    face[:] = True  # lips, redder than the face, stay skin
    assert skin_of(face, albedo, region).reshape(-1, N).mean(1) == pytest.approx([1, 0, 1], abs=0.05)


def test_without_a_head_or_with_few_labels() -> None:
    face, albedo, region = made("brown", (EARS, 1.0))
    np.testing.assert_array_equal(skin_of(face, albedo, None), face)
    few = np.arange(len(face)) < MIN_FACE - 1
    np.testing.assert_array_equal(skin_of(few, albedo, region), few)
    none = np.zeros(len(face), np.bool_)
    np.testing.assert_array_equal(skin_of(none, np.zeros_like(albedo), region), none)


def test_black_and_white_albedo_stay_finite() -> None:
    face, albedo, region = made("fair", (EARS, 1.0))
    albedo[N:] = 0.0
    assert skin_of(face, albedo, region)[N:].sum() == 0
    albedo[:] = 0.0
    assert skin_of(face, albedo, region).all()
