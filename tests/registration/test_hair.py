"""Hair is told by colour, height and place: on heads made from the template, whose hair is known."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import pytest
from scipy.stats import multivariate_normal
from support import persons
from support.hairy import BOB, DARK, SKIN, hairy_head

from pipeline.meshes import F64, Mask, unit
from pipeline.patches import Patches, patches_of
from pipeline.registration import hair as told
from pipeline.registration.identity_fit import PlacedHead

THICK = 0.015  # metres


def surface(thickness: float) -> tuple[Patches, Mask]:
    """The patches of a head with hair of some thickness, and which of them have it."""
    mesh, share = hairy_head(thickness)
    patches = patches_of(mesh, told.PATCH)
    return patches, patches.mean(share) > 0.5


def placed() -> PlacedHead:
    return PlacedHead(np.eye(4), np.zeros(0), persons.template().vertices, np.zeros(0), 0.0)


def albedo(patches: Patches, hair: Mask, colour: tuple[float, float, float] = DARK) -> F64:
    noise = 1 + 0.1 * np.random.default_rng(0).normal(size=(len(hair), 1)).clip(-2, 2)
    return np.where(hair[:, None], colour, SKIN) * noise


@pytest.fixture(scope="module")
def hairy() -> tuple[Patches, Mask, told.Places]:
    patches, hair = surface(THICK)
    return patches, hair, told.places_of(persons.template(), placed(), patches)


def test_places_are_those_of_the_skin(hairy: tuple[Patches, Mask, told.Places]) -> None:
    patches, hair, places = hairy
    outer = ~places.on("lids", "lips", "nostrils") & (places.at[:, 1] > -0.05)
    full = hair & places.on("scalp") & (places.at[:, 1] > 0.045)
    assert full.sum() > 1000 and np.abs(places.height[full] - THICK).max() < 1e-3
    assert np.median(places.height[hair & places.on("scalp")]) == pytest.approx(THICK, abs=5e-4)
    bare = outer & ~hair & ~patches.beside(hair) & (patches.where[:, 1] < 0.02)
    assert np.median(np.abs(places.height[bare])) < 3e-4
    top = patches.where[:, 1].argmax()
    assert places.names[places.region[top]] == "scalp" and places.at[top, 1] > 0.1


def test_hair_is_found_where_it_is(hairy: tuple[Patches, Mask, told.Places]) -> None:
    patches, hair, places = hairy
    found = told.tell_hair(patches, places, albedo(patches, hair), np.ones(len(hair)))
    outside = ~places.on("lids", "lips", "nostrils", "ears")
    wrong = patches.area[(found.inside != hair) & outside].sum() / patches.area[hair].sum()
    assert not found.reason and wrong < 0.06 and found.share > 0.3


def test_hair_over_the_forehead_is_told_by_its_colour(hairy: tuple[Patches, Mask, told.Places]) -> None:
    """A fringe that lies on the skin, without height."""
    patches, hair, places = hairy
    fringe = places.on("face") & (places.at[:, 1] > 0.045) & (patches.where[:, 2] > 0.03)
    found = told.tell_hair(patches, places, albedo(patches, hair | fringe), np.ones(len(hair)))
    assert patches.area[fringe & found.inside].sum() > 0.9 * patches.area[fringe].sum()
    plain = told.tell_hair(patches, places, albedo(patches, hair), np.ones(len(hair)))
    assert patches.area[fringe & plain.inside].sum() < 0.25 * patches.area[fringe].sum()


def test_a_beard_stays_with_the_skin(hairy: tuple[Patches, Mask, told.Places]) -> None:
    patches, hair, places = hairy
    beard = places.on("face", "neck", "lips") & (places.at[:, 1] < -0.04) & (places.at[:, 2] > 0.03)
    found = told.tell_hair(patches, places, albedo(patches, hair | beard), np.ones(len(hair)))
    assert beard.sum() > 300 and not found.inside[beard].any()


SHIRT = (0.1, 0.2, 0.5)


def hanging_hair(end: float = BOB) -> tuple[Patches, Mask, told.Places]:
    mesh, share = hairy_head(THICK, hanging=0.02, end=end)
    patches = patches_of(mesh, told.PATCH)
    return patches, patches.mean(share) > 0.5, told.places_of(persons.template(), placed(), patches)


@pytest.fixture(scope="module")
def bob() -> tuple[Patches, Mask, told.Places]:
    return hanging_hair()


def dressed(patches: Patches, places: told.Places, hair: Mask, shirt: tuple[float, float, float]) -> F64:
    """Albedo of a person with hair and a shirt."""
    return np.where((places.at[:, 1] <= told.BELOW)[:, None] & ~hair[:, None], shirt, albedo(patches, hair))


def test_hair_that_hangs_below_the_head_is_told_by_its_colour(bob: tuple[Patches, Mask, told.Places]) -> None:
    patches, hair, places = bob
    found = told.tell_hair(patches, places, dressed(patches, places, hair, SHIRT), np.ones(len(hair)))
    hanging = hair & (places.at[:, 1] < told.CHEEK[1]) & (places.height > 2 * told.FLAT)
    assert hanging.sum() > 300
    assert patches.area[hanging & found.inside].sum() > 0.95 * patches.area[hanging].sum()
    shirt = places.at[:, 1] <= told.BELOW
    assert not found.inside[shirt].any()


def test_hair_on_the_shoulders_is_no_seed_of_the_clothes() -> None:
    patches, hair, places = hanging_hair(-0.14)
    found = told.tell_hair(patches, places, dressed(patches, places, hair, SHIRT), np.ones(len(hair)))
    low = hair & (places.at[:, 1] <= told.BELOW) & (places.height > 2 * told.FLAT) & (places.at[:, 2] < 0)
    assert low.sum() > 30 and patches.area[low & found.inside].sum() > 0.9 * patches.area[low].sum()


def test_a_thick_beard_of_the_hairs_colour_stays_with_the_skin(bob: tuple[Patches, Mask, told.Places]) -> None:
    patches, hair, places = bob
    beard = places.on("face", "neck") & (places.at[:, 1] < -0.03) & (places.at[:, 2] > 0.01) & ~hair
    thick = replace(places, height=np.where(beard, 0.012, places.height))
    found = told.tell_hair(patches, thick, dressed(patches, places, hair | beard, SHIRT), np.ones(len(hair)))
    middle = beard & (np.abs(places.at[:, 0]) < told.BEARD - 0.005)
    assert middle.sum() > 200 and found.inside.any() and not found.inside[middle].any()


def test_a_shirt_of_the_hairs_colour_is_no_hair(bob: tuple[Patches, Mask, told.Places]) -> None:
    """Nothing tells where one ends then: what hangs goes with the shirt, and the hair of the head stays."""
    patches, hair, places = bob
    found = told.tell_hair(patches, places, dressed(patches, places, hair, DARK), np.ones(len(hair)))
    assert not found.inside[places.at[:, 1] <= told.BELOW].any() and found.inside.any()


def test_hanging_hair_is_told_without_a_shirt_in_the_photos(bob: tuple[Patches, Mask, told.Places]) -> None:
    patches, hair, places = bob
    seen = np.where(places.at[:, 1] <= told.BELOW, 0.0, 1.0)
    found = told.tell_hair(patches, places, dressed(patches, places, hair, SHIRT), seen)
    hanging = hair & (places.at[:, 1] < told.CHEEK[1]) & (places.height > 2 * told.FLAT)
    assert patches.area[hanging & found.inside].sum() > 0.95 * patches.area[hanging].sum()


def test_what_nobody_saw_of_the_scalp_goes_with_the_hair(hairy: tuple[Patches, Mask, told.Places]) -> None:
    patches, hair, places = hairy
    seen = (patches.where[:, 2] > 0.0).astype(np.float64)
    colour = np.where(seen[:, None] > 0, albedo(patches, hair), SKIN)
    found = told.tell_hair(patches, places, colour, seen)
    behind = hair & (seen == 0)
    assert patches.area[behind & found.inside].sum() > 0.95 * patches.area[behind].sum()


@pytest.mark.parametrize(
    ("thickness", "colour", "why"),
    [(0.0, SKIN, "stands off"), (0.0, DARK, "stands off"), (0.002, DARK, "stands off"), (THICK, SKIN, "at its border")],
)
def test_a_bald_or_shaved_head_has_none(thickness: float, colour: tuple[float, float, float], why: str) -> None:
    """Stubble is dark and lies on the scalp."""
    patches, hair = surface(thickness)
    places = told.places_of(persons.template(), placed(), patches)
    found = told.tell_hair(patches, places, albedo(patches, hair, colour), np.ones(len(hair)))
    assert not found.inside.any() and why in found.reason


def test_a_skull_that_is_wrong_is_no_hair() -> None:
    """Stubble on a scalp that swells over 8 cm to 6 mm: it stands off, but hardly rises at its border."""
    patches, _ = surface(0.0)
    places = told.places_of(persons.template(), placed(), patches)
    swollen = replace(places, height=0.006 * np.clip((patches.where[:, 1] - 0.03) / 0.08, 0, 1) + 0 * places.height)
    stubble = (places.at[:, 1] > 0.04) & places.on("scalp", "face")
    found = told.tell_hair(patches, swollen, albedo(patches, stubble, (0.4, 0.3, 0.25)), np.ones(len(stubble)))
    assert found.share > told.LEAST_SHARE and found.change > told.LEAST_CHANGE
    assert not found.inside.any() and "shaved" in found.reason and 0 < found.rise < told.RISE


def test_without_cheeks_there_is_no_skin_to_compare_with(hairy: tuple[Patches, Mask, told.Places]) -> None:
    patches, hair, places = hairy
    seen = (patches.where[:, 2] < 0.02).astype(np.float64)
    found = told.tell_hair(patches, places, albedo(patches, hair), seen)
    assert not found.inside.any() and "cheeks" in found.reason
    nothing = told.tell_hair(patches, places, albedo(patches, hair), 0 * seen)
    assert not nothing.inside.any() and nothing.share == 0


def test_the_density_is_that_of_scipy() -> None:
    rng = np.random.default_rng(1)
    seeds, at = rng.normal(50, 10, (40, 3)), rng.normal(50, 12, (7, 3))
    wanted = np.mean([multivariate_normal(s, told.KERNEL**2).pdf(at) for s in seeds], 0)
    np.testing.assert_allclose(told.log_density(at, seeds), np.log(wanted + told.FLOOR), rtol=1e-5)
    np.testing.assert_allclose(told.log_density(at, np.zeros((0, 3))), np.log(told.FLOOR))
    far = told.log_density(np.array([[1e4, 0, 0]]), seeds)
    np.testing.assert_allclose(far, np.log(told.FLOOR))


def test_cielab_of_known_colours() -> None:
    """White, black and the sRGB primary red (D65): CIE 15 by the formulas of its tables."""
    found = told.lab(np.array([[1, 1, 1], [0, 0, 0], [1.0, 0, 0], [7.0, 7, 7]]))
    np.testing.assert_allclose(found[0], [100, 0, 0], atol=0.05)
    np.testing.assert_allclose(found[1], 0, atol=1e-4)
    np.testing.assert_allclose(found[2], [53.24, 80.09, 67.20], atol=0.1)
    np.testing.assert_allclose(found[3], found[0])


def test_the_skin_lies_deeper_further_inwards() -> None:
    """Patches in a row: 0.5 mm more with each, 2 mm at most, nothing beside the hair."""
    row = np.arange(12)
    line = np.stack([row, 0 * row, 0 * row], 1).astype(np.float64)
    patches = Patches(row, line, unit(line + 1), np.ones(12), row[:-1], row[1:])
    inside = (row >= 2) & (row < 11)
    wanted = [0, 0, 0.5, 1, 1.5, 2, 2, 2, 1.5, 1, 0.5, 0]
    np.testing.assert_allclose(1000 * told.depth_beneath(patches, inside), wanted, atol=1e-9)
    assert not told.depth_beneath(patches, np.zeros(12, bool)).any()
    np.testing.assert_allclose(told.depth_beneath(patches, np.ones(12, bool)), told.BENEATH)


def test_heights_are_metres_of_the_template_in_any_unit(hairy: tuple[Patches, Mask, told.Places]) -> None:
    """The same head ten times as large, as in a capture whose unit is a decimetre."""
    mesh, _ = hairy_head(THICK)
    large = replace(mesh, vertices=(10 * mesh.vertices).astype(np.float32))
    head = PlacedHead(np.diag([10.0, 10.0, 10.0, 1.0]), np.zeros(0), 10 * persons.template().vertices, np.zeros(0), 0.0)
    found = told.places_of(persons.template(), head, patches_of(large, 10 * told.PATCH))
    assert found.shrink == pytest.approx(0.1)
    for name in ("scalp", "face"):
        wanted = np.quantile(hairy[2].height[hairy[2].on(name)], [0.1, 0.5, 0.9])
        np.testing.assert_allclose(np.quantile(found.height[found.on(name)], [0.1, 0.5, 0.9]), wanted, atol=5e-4)


@pytest.mark.parametrize(
    ("rise", "change", "hair"),
    [
        (0.0025, 20.0, True),  # one and one
        (0.0035, 8.0, True),  # 1.4 and 0.4
        (0.0020, 3.2, True),  # 0.8 and 0.16: white hair on pale skin
        (0.0012, 5.0, False),  # 0.48 and 0.25
        (0.0007, 60.0, False),  # hardly rises
        (0.0200, 2.0, False),  # hardly changes
    ],
)
def test_rise_and_change_together_say_that_it_is_hair(
    hairy: tuple[Patches, Mask, told.Places], monkeypatch: pytest.MonkeyPatch, rise: float, change: float, hair: bool
) -> None:
    patches, true, places = hairy
    monkeypatch.setattr(told, "_at_border", lambda *a: (rise, change))
    found = told.tell_hair(patches, places, albedo(patches, true), np.ones(len(true)))
    assert found.inside.any() == hair and (found.reason == "") == hair


def test_a_colour_of_skin_or_of_clothes_speaks_against_hair() -> None:
    """On the scalp without height, where nothing but the colour differs: seeds of three colours far apart."""
    rng, count = np.random.default_rng(2), 30
    kind = np.repeat([0, 1, 2], count)
    colour = np.array([[20.0, 5, 8], [65.0, 18, 20], [40.0, 0, -40]])[kind] + rng.normal(size=(3 * count, 3))
    none = np.zeros(3 * count)
    places = told.Places(np.zeros(3 * count, np.int64), ("scalp",), none, np.zeros((3 * count, 3)))
    odds = told._log_odds(places, none + 1, colour, kind == 1, kind == 0, kind == 2)
    hair, skin, clothes = (odds[kind == k] for k in range(3))
    np.testing.assert_allclose(hair - skin, 2 * told.COLOUR_MOST)
    np.testing.assert_allclose(hair - clothes, 2 * told.COLOUR_MOST)
    unseen = told._log_odds(places, none, colour, kind == 1, kind == 0, kind == 2)
    np.testing.assert_allclose(unseen, told.PRIOR["scalp"])
