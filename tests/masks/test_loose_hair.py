"""Gaps in loose hair: made-up heads before a wall, whose truth is known."""

from __future__ import annotations

import cv2
import numpy as np
import numpy.typing as npt
import pytest

from pipeline.colour import srgb_from_linear
from pipeline.faces.find import Face
from stages.inverse_rendering.ray_sampling import WHOLE
from stages.masks import loose_hair, sources
from stages.masks.loose_hair import CHIN, HAIR, LEAST, TOP, gaps, head_in, mixtures, with_loose_hair
from stages.masks.region import LINEAR, U8, Bool, Disc, eroded

F64 = npt.NDArray[np.float64]
SIZE = 320
Y, X = np.mgrid[:SIZE, :SIZE].astype(np.float64) + 0.5
FACE: Bool = ((X - 160) / 45) ** 2 + ((Y - 190) / 60) ** 2 < 1
HAIR_CAP: Bool = (((X - 160) / 75) ** 2 + ((Y - 180) / 100) ** 2 < 1) & ~FACE & (Y < 250)
LOOP: Bool = ((X - 130) / 39) ** 2 + ((Y - 75) / 31) ** 2 < 1
BODY: Bool = (Y > 270) & (np.abs(X - 160) < 110) | ((np.abs(X - 160) < 25) & (Y > 240))
SUBJECT: Bool = FACE | HAIR_CAP | LOOP | BODY
GAP: Bool = LOOP & (((X - 130) / 30) ** 2 + ((Y - 75) / 22) ** 2 < 1) & ~HAIR_CAP
WALL, SKIN, DARK, SHIRT = (0.55, 0.54, 0.5), (0.5, 0.36, 0.28), (0.03, 0.025, 0.025), (0.3, 0.1, 0.12)


def landmarks() -> F64:
    """(468, 2): all on the outline of the face, TOP and CHIN at its ends."""
    turn = np.linspace(0, 2 * np.pi, 468)
    out = np.stack([160 + 44 * np.sin(turn), 190 + 59 * np.cos(turn)], -1)
    out[TOP], out[CHIN] = (160, 131), (160, 249)
    return out


def picture(
    *, strands: float = 0.25, hair: tuple[float, ...] = DARK, wall: tuple[float, ...] = WALL, rough: float = 0.0
) -> U8:
    """The head before a wall. strands: share of the hair in the gap. rough: deviation of the wall's radiance."""
    rng = np.random.default_rng(5)
    linear = np.ones((SIZE, SIZE, 3)) * wall * (1 + rough * rng.standard_normal((SIZE, SIZE, 1)))
    behind = linear.copy()
    for where, colour in ((BODY, SHIRT), (HAIR_CAP | LOOP, hair), (FACE, SKIN)):
        linear[where] = colour
    linear[GAP] = strands * np.array(hair) + (1 - strands) * behind[GAP]
    linear *= 1 + 0.01 * rng.standard_normal(linear.shape)
    return np.asarray(np.round(srgb_from_linear(linear.clip(0, 1)) * 255), np.uint8)


def encoded(linear: tuple[float, ...]) -> npt.NDArray[np.uint8]:
    return np.asarray(np.round(srgb_from_linear(np.array(linear)) * 255), np.uint8)


def found(image: U8, inside: Bool = SUBJECT) -> Bool:
    head = head_in(inside, landmarks())
    return gaps(inside, mixtures(LINEAR[image], inside, head), head)


@pytest.mark.parametrize("strands", [0.0, 0.25, 0.4])
def test_a_wall_seen_through_a_loop_of_hair_is_a_gap(strands: float) -> None:
    cut = found(picture(strands=strands))
    assert cut[eroded(GAP, 1)].mean() > 0.98
    assert not cut[FACE | BODY | HAIR_CAP].any()


@pytest.mark.parametrize("strands", [0.0, 0.25, 0.4])
def test_alpha_is_the_share_of_hair(strands: float) -> None:
    colour = LINEAR[picture(strands=strands)]
    seen = mixtures(colour, SUBJECT, head_in(SUBJECT, landmarks()))
    inner = eroded(GAP, 2)
    assert seen.mixed[inner].mean() > 0.99
    assert np.median(seen.alpha[inner]) == pytest.approx(strands, abs=0.02)
    assert not seen.mixed[FACE].any()


def test_what_is_mostly_hair_stays() -> None:
    assert not found(picture(strands=0.7)).any()


def test_thin_hair_around_a_gap_goes_with_it_and_thick_hair_stays() -> None:
    thin = LOOP & ~(((X - 130) / 35.5) ** 2 + ((Y - 75) / 27.5) ** 2 < 1)
    image = picture()
    ring = LOOP & ~GAP & ~HAIR_CAP
    assert found(image)[ring].mean() < 0.1  # nine pixels wide
    wall = image[5, 5]
    image[LOOP & ~thin & ~HAIR_CAP] = wall
    cut = found(image)
    assert cut[thin & ~HAIR_CAP & (Y < 70)].mean() > 0.75


def test_pale_skin_of_a_bald_head_and_an_ear_is_no_gap() -> None:
    """Skin of the wall's own colour is connected with the face."""
    image = picture()
    bald = HAIR_CAP | LOOP
    ear = ((X - 228) / 14) ** 2 + ((Y - 190) / 22) ** 2 < 1
    image[bald | ear | FACE] = encoded(WALL)
    assert not found(image, SUBJECT | ear).any()


def test_a_bare_forehead_of_the_walls_colour_is_the_faces() -> None:
    """Between the landmarks and the hair, with a strip of darker skin beneath."""
    image = picture(strands=1.0)
    image[HAIR_CAP & (np.abs(X - 160) < 10) & (Y > 90)] = encoded(SKIN)
    image[HAIR_CAP & (np.abs(X - 160) < 10) & (Y > 90) & (Y < 122)] = encoded(WALL)
    assert not found(image).any()


def test_what_skin_surrounds_is_no_gap() -> None:
    """A highlight on an ear in dark hair."""
    image = picture(strands=1.0)
    ear, lit = (HAIR_CAP & (((X - 220) / a) ** 2 + ((Y - 190) / b) ** 2 < 1) for a, b in ((11, 17), (7, 13)))
    image[ear] = encoded(SKIN)
    assert not found(image).any()
    image[lit] = encoded(WALL)
    assert not found(image).any()


def test_pale_cloth_beside_hair_is_no_gap() -> None:
    """A white collar before a white wall lies below the lips."""
    image = picture(strands=1.0)
    collar = (Y > 225) & (Y < 250) & (np.abs(X - 160) > 50) & (np.abs(X - 160) < 80)
    image[collar] = encoded(WALL)
    assert not found(image, SUBJECT | collar).any()


@pytest.mark.parametrize("grey", [0.4, 0.24])
def test_light_hair_tells_nothing(grey: float) -> None:
    assert not found(picture(hair=(grey, grey, grey))).any()


def test_white_hair_of_the_walls_colour_beside_a_shadow_is_no_gap() -> None:
    """Few dark pixels nearby are no hair that a wall shines through."""
    grey = tuple(0.95 * w for w in WALL)
    image = picture(hair=grey, strands=1.0)
    shadow = HAIR_CAP & (np.abs(X - 222) < 2)
    assert shadow.sum() < HAIR * HAIR_CAP.sum()
    image[shadow] = 10
    assert not found(image).any()


def test_before_an_uneven_wall_nothing_is_cut() -> None:
    assert not found(picture(rough=0.6)).any()


def test_a_gap_is_no_smaller_than_a_share_of_the_mask(monkeypatch: pytest.MonkeyPatch) -> None:
    image = picture(strands=1.0)
    side = int(np.sqrt(LEAST * SUBJECT.sum()))
    image[60 : 60 + side, 130 : 130 + side] = image[5, 5]
    assert not found(image).any()
    monkeypatch.setattr(loose_hair, "LEAST", 0.0)
    assert found(image).any()


def test_a_gap_is_no_larger_than_a_share_of_the_face(monkeypatch: pytest.MonkeyPatch) -> None:
    """A hat of the wall's colour with a dark rim."""
    hat = (np.abs(X - 160) < 70) & (Y > 15) & (Y < 130)
    image = picture(strands=1.0)
    image[hat & ~FACE] = encoded(DARK)
    image[(np.abs(X - 160) < 50) & (Y > 30) & (Y < 65)] = image[5, 5]
    assert not found(image, SUBJECT | hat).any()
    monkeypatch.setattr(loose_hair, "MOST", 1.0)
    assert found(image, SUBJECT | hat).any()


def test_thin_hair_far_from_a_gap_stays() -> None:
    lock = (np.abs(Y - 150) < 1.5) & (X > 228) & (X < 255)
    image = picture()
    image[lock] = encoded(DARK)
    cut = found(image, SUBJECT | lock)
    assert cut[eroded(GAP, 1)].all() and not cut[lock].any()


def test_without_a_face_the_mask_stays(monkeypatch: pytest.MonkeyPatch) -> None:
    image, disc = picture(), Disc(160, 190, 150, 0)
    monkeypatch.setattr(loose_hair, "find_face", lambda *_: None)
    left, mixed = with_loose_hair(image, SUBJECT, disc)
    assert (left == SUBJECT).all() and not mixed.any()
    monkeypatch.setattr(loose_hair, "find_face", lambda *_: Face(landmarks(), 1.0))
    left, mixed = with_loose_hair(image, SUBJECT, disc)
    assert left[eroded(GAP, 1)].mean() < 0.02 and not ((left | mixed) & ~SUBJECT).any()


def test_hair_that_the_wall_shines_through_is_told_near_the_outline_only(monkeypatch: pytest.MonkeyPatch) -> None:
    image, disc = picture(strands=1.0), Disc(160, 190, 150, 0)
    edge = HAIR_CAP & ~eroded(SUBJECT, 3) & eroded(SUBJECT, 1) & (Y < 180)
    sheen = HAIR_CAP & (((X - 160) / 12) ** 2 + ((Y - 105) / 8) ** 2 < 1)
    image[edge | sheen] = encoded(tuple(0.5 * d + 0.5 * w for d, w in zip(DARK, WALL, strict=True)))
    monkeypatch.setattr(loose_hair, "find_face", lambda *_: Face(landmarks(), 1.0))
    left, mixed = with_loose_hair(image, SUBJECT, disc)
    assert (left == SUBJECT).all()
    assert mixed[edge].mean() > 0.5 and not mixed[sheen].any() and not mixed[FACE | BODY].any()


def test_colours_of_such_hair_are_not_used(monkeypatch: pytest.MonkeyPatch) -> None:
    """Its alpha stays the subject's, and below what the fit takes colours from."""
    image = picture(strands=1.0)
    mixed = HAIR_CAP & (X < 110)
    monkeypatch.setattr(sources, "with_loose_hair", lambda _, inside, __: (inside, mixed))
    alpha = sources.person_alpha(image, SUBJECT, Disc(160, 190, 150, 0))
    assert (alpha[mixed & eroded(SUBJECT, 4)] == np.float32(sources.COLOURLESS)).all()
    assert sources.COLOURLESS < WHOLE and round(sources.COLOURLESS * 255) / 255 < WHOLE
    assert (alpha[eroded(SUBJECT, 4) & ~mixed] == 1).all()


@pytest.mark.parametrize("level", [0, 255])
def test_pictures_without_contrast_keep_their_masks(level: int) -> None:
    flat = np.full((SIZE, SIZE, 3), level, np.uint8)
    assert not found(flat).any()
    everywhere = np.ones((SIZE, SIZE), np.bool_)
    assert not found(picture(), everywhere).any()  # no background
    assert not found(picture(), np.zeros_like(everywhere)).any()


def test_a_tilted_head_is_measured_along_its_own_axis() -> None:
    turn = cv2.getRotationMatrix2D((SIZE / 2, SIZE / 2), 90, 1.0)
    image = np.asarray(cv2.warpAffine(picture(), turn, (SIZE, SIZE), borderMode=cv2.BORDER_REPLICATE), np.uint8)
    inside, gap = (cv2.warpAffine(m.astype(np.uint8), turn, (SIZE, SIZE)) > 0 for m in (SUBJECT, GAP))
    points = np.c_[landmarks(), np.ones(468)] @ turn.T
    head = head_in(np.asarray(inside), points)
    cut = gaps(np.asarray(inside), mixtures(LINEAR[image], np.asarray(inside), head), head)
    assert (cut & gap).sum() > 0.9 * gap.sum()
