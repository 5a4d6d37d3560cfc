"""A smooth backdrop corrects what a key or a network takes for it, or does not."""

from __future__ import annotations

import numpy as np
import pytest

from pipeline.artifacts import Camera
from stages.masks import sources
from stages.masks.keying import Background, keyed
from stages.masks.region import U8, Bool, Disc
from stages.masks.smooth_backdrop import Shades, corrected, given_back, shades

H, W = 320, 256
Y, X = np.mgrid[:H, :W]
U, V = 2 * X / (W - 1) - 1, 2 * Y / (H - 1) - 1  # as the polynomial's
PERSON: Bool = (np.hypot(X - 128, Y - 110) < 60) | (Y > 160) & (abs(X - 128) < 40) | (Y > 200)
BACKDROP = np.stack([150 + 8 * U + 5 * V - 3 * U * V + 2 * U**3, 152 + 7 * U + 5 * V**2, 149 + 7 * U - 2 * V**3], -1)


def photo(person: Bool = PERSON, colour: tuple[float, float, float] = (70, 45, 35), seed: int = 0) -> U8:
    """(H, W, 3) a person of one colour before the backdrop, with noise."""
    pixels = np.where(person[..., None], np.array(colour), BACKDROP)
    return (pixels + np.random.default_rng(seed).normal(size=pixels.shape)).round().clip(0, 255).astype(np.uint8)


def painted(image: U8, where: Bool, off: float) -> U8:
    """Some pixels in the backdrop's colour and so many levels beside."""
    out = image.copy()
    out[where] = (BACKDROP[where] + off).round().clip(0, 255)
    return out


STRIP: Bool = PERSON & (Y > 250) & (Y < 275)  # from frame to frame


def test_the_shade_is_the_backdrops() -> None:
    found = shades(photo(), PERSON)
    assert found is not None and found.is_backdrop and found.surface.shape == (256, 205, 3)
    rows, columns = (np.arange(256) + 0.5) * H / 256 - 0.5, (np.arange(205) + 0.5) * W / 205 - 0.5
    true = BACKDROP[rows.round().astype(int)[:, None], columns.round().astype(int)]
    open_to_view = ~PERSON[rows.round().astype(int)[:, None], columns.round().astype(int)]
    assert np.abs(found.surface - true)[open_to_view].max() < 0.6
    assert found.deviation < 2 and found.share > 0.99
    assert found.tolerance == max(6.0, 6 * found.deviation)


def test_a_strip_that_a_key_takes_is_given_back() -> None:
    image = painted(photo(), STRIP, -11)
    assert not keyed_by_colour(image)[STRIP].any()  # the key alone
    back = given_back(image, keyed_by_colour(image), 24)
    assert back[STRIP].mean() > 0.97 and not back[~PERSON].any()
    whole = keyed(image, Background((150, 152, 149), 24))
    assert whole[STRIP].mean() > 0.97 and not whole[~PERSON].any()


def keyed_by_colour(image: U8) -> Bool:
    """The mask of a key with a tolerance of 24 levels."""
    return PERSON & (np.abs(image.astype(float) - [150, 152, 149]).max(-1) > 24)


@pytest.mark.parametrize("tolerance", [5.0, 11.9])
def test_a_key_that_is_as_strict_as_the_surface_takes_nothing(tolerance: float) -> None:
    image = painted(photo(), STRIP, -11)
    assert not given_back(image, PERSON & ~STRIP, tolerance).any()


def test_a_shadow_on_the_backdrop_is_not_given_back() -> None:
    shadow = ~PERSON & (X > 180) & (Y > 120) & (Y < 198) & (X < 230)
    image = painted(photo(), shadow, -20)
    assert not given_back(image, PERSON, 24).any()
    assert np.array_equal(corrected(image, PERSON), PERSON)


def test_a_network_gets_what_it_lacks_and_loses_what_is_backdrop() -> None:
    lacks = PERSON & (Y > 295) & (X < 110)
    beyond = ~PERSON & (Y > 150) & (X > 160) & (X < 215)
    fixed = corrected(photo(), PERSON & ~lacks | beyond)
    assert fixed[lacks].mean() > 0.97
    assert fixed[beyond].mean() < 0.02  # corners
    assert (fixed ^ PERSON).sum() < 0.003 * PERSON.sum()


def test_the_shade_does_not_follow_what_a_mask_lacks() -> None:
    """A shoulder that hangs together with the background."""
    found = shades(photo(), PERSON & ~((Y > 190) & (Y < 250) & (X < 85)))
    assert found is not None and 0.8 < found.share < 0.95
    assert (
        np.abs(found.surface[:128] - BACKDROP[: H // 2][np.arange(128) * 5 // 4][:, np.arange(205) * W // 205]).max()
        < 4
    )


def test_a_right_mask_is_left_alone() -> None:
    assert np.array_equal(corrected(photo(), PERSON), PERSON)
    strip = painted(photo(), STRIP, 0)  # cloth of the backdrop's colour lies between the subject and the frame
    assert np.array_equal(corrected(strip, PERSON), PERSON)


def test_a_highlight_of_the_backdrops_colour_is_the_persons() -> None:
    glint = PERSON & (np.hypot(X - 128, Y - 55) < 25)
    image = photo()
    image[glint] = (BACKDROP[glint] + 16 * (np.hypot(X - 128, Y - 55)[glint, None] / 25 - 0.5)).round()
    assert corrected(image, PERSON)[glint].all()


def test_thin_differences_of_contours_stay() -> None:
    wider = np.hypot(X - 128, Y - 110) < 62
    mask = PERSON | wider
    assert np.array_equal(corrected(photo(), mask), mask)


@pytest.mark.parametrize("seed", range(5))
def test_a_room_is_no_backdrop(seed: int) -> None:
    rng = np.random.default_rng(seed)
    room = np.kron(rng.uniform(40, 220, (8, 8, 3)), np.ones((H // 8, W // 8, 1)))
    image = np.where(PERSON[..., None], [70, 45, 35], room).astype(np.uint8)
    lacking = PERSON & ~((Y > 295) & (X < 110))
    assert np.array_equal(corrected(image, lacking), lacking)
    found = shades(image, PERSON)
    assert found is None or not found.is_backdrop


def test_extremes() -> None:
    image = photo()
    for mask in (np.ones((H, W), bool), PERSON | (Y > 12)):  # next to nothing is background
        assert shades(image, mask) is None
        assert np.array_equal(corrected(image, mask), mask)
    empty = np.zeros((H, W), bool)
    black = np.zeros((H, W, 3), np.uint8)
    assert np.array_equal(corrected(black, empty), empty)
    assert np.array_equal(corrected(black, PERSON), PERSON & False)  # all of it is backdrop
    tiny = np.zeros((1, 1), bool)
    assert corrected(np.zeros((1, 1, 3), np.uint8), tiny).shape == (1, 1)


def test_the_size_of_the_photo_hardly_matters() -> None:
    lacks = PERSON & (Y > 295) & (X < 110)
    large = np.kron(photo(), np.ones((4, 4, 1), np.uint8))
    fixed = corrected(large, np.kron(PERSON & ~lacks, np.ones((4, 4), bool)))
    assert (fixed ^ np.kron(PERSON, np.ones((4, 4), bool))).mean() < 0.001


def test_a_backdrop_is_smooth_and_all_there_is() -> None:
    surface = np.zeros((2, 2, 3), np.float32)
    assert Shades(surface, 2.0, 0.9).is_backdrop
    assert not Shades(surface, 2.01, 1.0).is_backdrop and not Shades(surface, 0.0, 0.89).is_backdrop
    assert Shades(surface, 0.0, 1.0).tolerance == 6 and Shades(surface, 3.0, 1.0).tolerance == 18


def test_a_persons_mask_is_corrected_only_before_a_backdrop(monkeypatch: pytest.MonkeyPatch) -> None:
    lacks = PERSON & (Y > 295) & (X < 110)
    monkeypatch.setattr(sources, "person_mask", lambda *args: PERSON & ~lacks)
    camera = Camera(index=0, name="a", K=[[300.0, 0, 128], [0, 300.0, 160], [0, 0, 1]], distortion=[0.0] * 5, width=W,
                    height=H, world_from_cam=np.eye(4).tolist())  # fmt: skip
    view = sources.PhotoToMask(0, "a.jpg", camera, Disc(128, 160, 150, 0.0), False, photo, None)
    plain, whole = (
        sources.mask(view, sources.Plan("person", backdrop=b), 0.5, 640, 0)[0] >= 0.5 for b in (False, True)
    )
    assert plain[lacks].mean() < 0.05 and whole[lacks].mean() > 0.95


def test_a_backdrop_must_be_behind_nearly_all() -> None:
    plain = photo()
    room = np.random.default_rng(0).integers(0, 255, (H, W, 3)).astype(np.uint8)
    assert sources._before_backdrop([plain] * 9 + [room], [PERSON] * 10)
    assert not sources._before_backdrop([plain] * 8 + [room] * 2, [PERSON] * 10)
