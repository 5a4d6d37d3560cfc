"""The judge of the maps on made-up texels, sound and ruined."""

from __future__ import annotations

from dataclasses import fields, replace
from typing import Any

import numpy as np
import pytest

from pipeline.verdict import Finding
from stages.bake.judge import MAX_TEXELS, MIN_SKIN, Texels, chosen, judge, together
from stages.bake.regions import Votes
from stages.bake.texels import Samples

N = 4000
FIGURES = {"unseen": 0.25, "albedo_clamped": 0.0}


def head(skin: int = 1000, **changes: Any) -> Texels:
    """As a scanned head's: F0 about .01, the face lighter than the rest."""
    rng = np.random.default_rng(0)
    made = Texels(
        rng.uniform(0.004, 0.02, N).astype(np.float32),
        rng.uniform(0.42, 0.46, N).astype(np.float32),
        rng.uniform(0.2, 0.5, N).astype(np.float32),
        np.arange(N) < skin,
    )
    return replace(made, **{k: np.asarray(v(made), np.float32) for k, v in changes.items()})


def by_name(t: Texels, person: bool = True, **figures: float) -> dict[str, Finding]:
    return {f.check: f for f in judge(t, FIGURES | figures, person=person)}


def test_a_sound_head_is_good() -> None:
    found = by_name(head())
    assert {f.level for f in found.values()} == {"good"}
    assert set(found) == {"unseen", "albedo_clamped", "f0_mean", "f0_top", "f0_none", "roughness", "albedo_skin"}
    assert found["f0_mean"].value == pytest.approx(0.012, rel=0.05) and "skin's F0 is 0.012" in found["f0_mean"].said


@pytest.mark.parametrize(("unseen", "level"), [(0.3, "good"), (0.67, "usable"), (0.85, "unusable")])
def test_surface_that_no_photo_saw(unseen: float, level: str) -> None:
    found = by_name(head(), unseen=unseen)["unseen"]
    assert found.level == level and f"{unseen:.0%}" in found.said


@pytest.mark.parametrize(("share", "level"), [(0.01, "good"), (0.043, "usable"), (0.3, "unusable")])
def test_albedo_that_was_clamped(share: float, level: str) -> None:
    assert by_name(head(), albedo_clamped=share)["albedo_clamped"].level == level


@pytest.mark.parametrize(("gain", "level"), [(1, "good"), (8, "usable"), (30, "unusable")])
def test_f0_of_a_mirror(gain: float, level: str) -> None:
    assert by_name(head(f0=lambda t: gain * t.f0))["f0_mean"].level == level


def test_f0_of_the_skin_counts_and_not_that_of_all() -> None:
    """Wet eyes and metal on the clothes are not skin."""
    studs = head(f0=lambda t: np.where(t.skin, t.f0, 0.9))
    assert by_name(studs)["f0_mean"].level == "good"
    assert by_name(head(skin=MIN_SKIN - 1, f0=lambda t: np.where(t.skin, t.f0, 0.9)))["f0_mean"].level == "unusable"


def test_a_few_texels_beyond_physics() -> None:
    """Half a percent of the surface above 1 does not move the mean."""
    peaks = head(f0=lambda t: np.where(np.arange(N) % 200 == 0, 2.8, t.f0))
    found = by_name(peaks)
    assert found["f0_mean"].level == "good" and found["f0_top"].level == "unusable"
    assert by_name(head(f0=lambda t: np.where(np.arange(N) == 5, 2.8, t.f0)))["f0_top"].level == "good"


def test_nothing_shines() -> None:
    """A loss on people, none on a stone; and where there is no lobe, its roughness says nothing."""
    matt = head(f0=lambda t: 0 * t.f0)
    found = by_name(matt)
    assert (
        found["f0_none"].level == "usable"
        and "it has no highlights" in found["f0_none"].said
        and "roughness" not in found
    )
    assert "f0_none" not in by_name(matt, person=False)


@pytest.mark.parametrize(("share", "level"), [(0.02, "good"), (0.3, "usable"), (0.7, "unusable")])
def test_roughness_out_of_range(share: float, level: str) -> None:
    for wrong in (0.02, 0.99):
        some = head(roughness=lambda t, w=wrong: np.where(np.arange(N) < share * N, w, t.roughness))  # type: ignore[misc]
        assert by_name(some)["roughness"].level == level


@pytest.mark.parametrize(("gain", "level"), [(1.0, "good"), (0.1, "usable"), (0.05, "unusable"), (3.0, "unusable")])
def test_skin_that_is_no_skin(gain: float, level: str) -> None:
    assert by_name(head(luma=lambda t: gain * t.luma))["albedo_skin"].level == level
    assert "albedo_skin" not in by_name(head(skin=10, luma=lambda t: gain * t.luma))


def samples(n: int, unseen: Any) -> Samples:
    columns = {f.name: np.zeros(n, np.float32) for f in fields(Samples)}
    columns |= {"unseen": np.asarray(unseen, np.float32), "f0": np.arange(n, dtype=np.float32)}
    columns |= {
        "base_color": np.tile(np.array([1.0, 0.5, 0.25], np.float32), (n, 1)),
        "roughness": np.full(n, 0.4371, np.float32),
    }
    return Samples(**columns)  # type: ignore[arg-type]


def test_only_what_was_seen_is_chosen() -> None:
    """Texels 0 to 15 of a picture of 4 x 4: the first half was seen, and the picture's upper row is the face."""
    votes = Votes(np.array([1, 2], np.uint8), np.zeros((4, 4, 2), np.float32))
    votes.image[0, :, 1], votes.image[1:, :, 0] = 1, 1
    names = ("background", "subject", "face")
    t = chosen(samples(16, np.arange(16) >= 8), np.arange(16), 4, votes, names)
    assert t.f0.tolist() == list(range(8)) and t.skin.tolist() == [True] * 4 + [False] * 4
    assert t.luma == pytest.approx(0.2126 + 0.5 * 0.7152 + 0.25 * 0.0722)
    np.testing.assert_allclose(t.roughness, 0.4371)
    assert not chosen(samples(16, np.zeros(16)), np.arange(16), 4, None, ()).skin.any()


def test_an_even_choice_of_many() -> None:
    n = 2 * MAX_TEXELS + 1
    t = chosen(samples(n, np.zeros(n)), np.arange(n), 1024, None, ())
    assert MAX_TEXELS / 2 < len(t.f0) <= MAX_TEXELS and np.ptp(t.f0) > 0.99 * n


def test_tiles_together_and_nothing_seen() -> None:
    both = together([head(), head(f0=lambda t: 3 * t.f0)])
    assert len(both.f0) == 2 * N and both.skin.sum() == 2000
    nothing = chosen(samples(4, np.ones(4)), np.arange(4), 2, None, ())
    assert set(by_name(nothing, unseen=1.0)) == {"unseen", "albedo_clamped"}
    assert by_name(nothing, unseen=1.0)["unseen"].level == "unusable"
