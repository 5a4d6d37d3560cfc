"""The other side of a head that is turned, scaled and moved."""

from __future__ import annotations

import numpy as np
import pytest
from scipy.spatial.transform import Rotation

from pipeline.registration.identity_fit import PlacedHead
from pipeline.registration.other_side import FAR, other_side
from pipeline.template.load import load_template
from pipeline.transforms import apply, similarity

TEMPLATE = load_template()


def placed(scale: float, vector: tuple[float, float, float], shift: tuple[float, float, float]) -> PlacedHead:
    """The mean head, turned by a rotation vector in radians."""
    world = similarity(scale, Rotation.from_rotvec(vector).as_matrix(), np.array(shift))
    return PlacedHead(world, np.zeros(0), apply(world, TEMPLATE.vertices), np.zeros((1, 3)), 0.0)


@pytest.mark.parametrize("scale", [1.0, 12.0, 1e-3])
@pytest.mark.parametrize("vector", [(0.0, 0.0, 0.0), (0.4, -1.2, 0.7)])
def test_a_place_goes_where_its_mirror_image_is(scale: float, vector: tuple[float, float, float]) -> None:
    """Places up to 15 mm off the template, mirrored in the template's own frame, where x changes its sign."""
    rng = np.random.default_rng(4)
    skin = np.unique(TEMPLATE.quads[TEMPLATE.parts["skin"]])
    own = TEMPLATE.vertices[rng.choice(skin, 400)] + rng.uniform(-0.008, 0.008, (400, 3))
    head = placed(scale, vector, (3.0, -2.0, 5.0))
    found = other_side(apply(head.world_from_template, own), TEMPLATE, head)
    truth = apply(head.world_from_template, own * [-1, 1, 1])
    off = np.linalg.norm(found.where - truth, axis=1) / scale
    assert np.median(off) < 2e-4 and off.max() < 2e-3  # metres: the template's own asymmetry
    back = other_side(found.where, TEMPLATE, head)
    again = np.linalg.norm(back.where - apply(head.world_from_template, own), axis=1) / scale
    assert np.quantile(again, 0.95) < 1e-3


def test_what_is_far_from_the_head_is_not_on_it() -> None:
    head = placed(1.0, (0, 0, 0), (0, 0, 0))
    top = TEMPLATE.vertices[TEMPLATE.vertices[:, 1].argmax()]
    found = other_side(top + np.array([[0, 0.9 * FAR, 0], [0, 1.1 * FAR, 0], [0, 10, 0]]), TEMPLATE, head)
    assert found.on_head.tolist() == [True, False, False]
    assert found.plain.all()


@pytest.mark.parametrize(
    ("region", "plain"),
    [("lips", False), ("lids", False), ("nostrils", False), ("face", True), ("neck", True), ("ears", True)],
)
def test_lips_and_lids_are_not_plain(region: str, plain: bool) -> None:
    """In the middle of the region: at its border a place belongs to either."""
    quads = TEMPLATE.quads[TEMPLATE.regions[region]]
    others = TEMPLATE.quads[[q for n, r in TEMPLATE.regions.items() if n != region for q in r]]
    inner = np.setdiff1d(quads, others)
    head = placed(1.0, (0, 0, 0), (0, 0, 0))
    assert len(inner) > 10
    found = other_side(head.vertices[inner], TEMPLATE, head)
    assert (found.plain == plain).mean() > 0.99
    assert np.array_equal(found.where[:5], head.vertices[TEMPLATE.mirror[inner[:5]]])
