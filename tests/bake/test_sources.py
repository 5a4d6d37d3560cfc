"""What the map `measured` says, and the figures of delighting."""

from __future__ import annotations

from dataclasses import fields, replace

import numpy as np
import pytest

from stages.bake.delighting import FEW, Shown, figures_of, pearson, shown
from stages.bake.regions import unanimous
from stages.bake.sources import sources
from stages.bake.standard_fit import HALF, Fitted, precision_share, weight_of
from stages.bake.texels import Samples


def fitted(measured: list[list[float]]) -> Fitted:
    count = len(measured)
    one = np.ones(count, np.float32)
    return Fitted(np.ones((count, 3), np.float32), one, one, np.ones((count, 3), np.float32), {},
                  measured=np.array(measured, np.float32))  # fmt: skip


def test_what_no_photo_sees_is_assumed() -> None:
    unseen, replaced = np.float32([0, 0, 1]), np.float32([0, 0.25, 1])
    got = sources(unseen, replaced, fitted([[0.7, 0.4], [0, 0], [0.7, 0.4]]))
    assert np.allclose(got, [[1, 0.7, 0.4], [0.75, 0, 0], [0, 0, 0]])
    lobe = sources(unseen, replaced, None)
    assert np.allclose(lobe, [[1, 1, 1], [0.75, 1, 1], [0, 0, 0]])


def test_the_share_of_the_photos_in_a_roughness() -> None:
    """Closed form: precisions of two normal distributions add up."""
    x = np.linspace(0.3, 0.6, 9)
    for photos, prior in ((0.05, 0.05), (0.01, 0.1), (1e3, 0.05)):
        cost = 0.5 * ((x - 0.42) / photos) ** 2 + 0.5 * ((x - 0.45) / prior) ** 2
        assert precision_share(x, cost, prior) == pytest.approx(photos**-2 / (photos**-2 + prior**-2), abs=1e-6)
    assert precision_share(x, 0.5 * ((x - 2) / 0.05) ** 2, 0.05) == pytest.approx(0, abs=1e-6)  # least at the end


def test_the_weight_of_the_photos_in_f0() -> None:
    assert weight_of(0) == 0 and weight_of(-0.1) == 0 and weight_of(1) == pytest.approx(1, abs=1e-6)
    assert weight_of(HALF / (1 + HALF)) == pytest.approx(0.5)


def test_correlation_is_that_of_numpy_and_none_without_variation() -> None:
    a, b = np.random.default_rng(3).normal(size=(2, 500))
    assert pearson(a, b + a) == pytest.approx(np.corrcoef(a, b + a)[0, 1])
    assert pearson(np.ones(9), np.arange(9.0)) is None and pearson(np.arange(9.0), np.full(9, 0.3)) is None


def test_figures_of_delighting_by_label() -> None:
    """Light of which a known share was left in the albedo of the face, and none in that of hair."""
    rng = np.random.default_rng(0)
    count = 4000
    light, paint, around = rng.normal(0.6, 0.1, (3, count))
    code = np.where(np.arange(count) < count // 2, 2, 4).astype(np.uint8)
    code[: FEW - 1] = 1  # too few to say anything
    luma = np.where(code == 2, paint + light, paint)
    part = Shown(*(x.astype(np.float32) for x in (luma, light, around)), code)
    got = figures_of([part], ("background", "subject", "face", "eyes", "hair"))
    assert set(got) == {f"delight_{n}_{w}" for n in ("face", "hair") for w in ("irradiance", "occlusion")}
    assert got["delight_face_irradiance"] == pytest.approx(2**-0.5, abs=0.03)
    assert abs(got["delight_hair_irradiance"]) < 0.06 and abs(got["delight_face_occlusion"]) < 0.06
    flat = replace(part, lit=np.ones(count, np.float32))
    assert not any(k.endswith("irradiance") for k in figures_of([flat], ("background",)))


def test_only_texels_that_photos_show_count() -> None:
    columns = {f.name: np.zeros(16, np.float32) for f in fields(Samples)}
    columns |= {"base_color": np.tile(np.float32([0.2, 0.2, 0.2]), (16, 1)), "lit": np.arange(16, dtype=np.float32)}
    columns["unseen"] = (np.arange(16) >= 8).astype(np.float32)
    s = Samples(**columns)  # type: ignore[arg-type]
    assert shown(s, np.arange(16), 4, unanimous(2)).lit.tolist() == list(range(8))
    assert shown(s, np.arange(16), 4, unanimous(2)).code.tolist() == [2] * 8
    assert shown(s, np.arange(16), 4, None).code.tolist() == [0] * 8
    assert np.allclose(shown(s, np.arange(16), 4, None).luma, 0.2)
