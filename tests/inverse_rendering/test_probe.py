"""Pixels that are withheld for the trials: which they are, and the error in them."""

from __future__ import annotations

import numpy as np
import pytest
import torch

from stages.inverse_rendering.outputs import predict_view
from stages.inverse_rendering.probe import BLOCKS, LEAST, ONE_IN, RAYS, judged_pixels, psnr_by_view, withheld
from stages.inverse_rendering.ray_sampling import WHOLE, PixelTable
from tests.inverse_rendering.test_resume import BALL
from tests.inverse_rendering.test_resume import trainer as ball

PHOTOS = BALL.photos()


def table(side: int = 96) -> PixelTable:
    return PixelTable(PHOTOS, side, "cpu")


def test_one_in_so_many_blocks_and_each_view_has_some() -> None:
    t = table()
    out = withheld(t, PHOTOS)
    assert float(out.float().mean()) == pytest.approx(1 / ONE_IN, rel=0.2)
    found = torch.bincount(t.view[judged_pixels(t, out, len(PHOTOS))].long(), minlength=len(PHOTOS))
    assert (found >= LEAST).all() and int(found.sum()) <= RAYS + len(PHOTOS) * LEAST


def test_blocks_are_whole_and_the_same_at_every_size() -> None:
    """By the blocks that the pixels lie in, 3 pixels wide at 96; those at the outline are the subject's at one size."""
    size = max(PHOTOS[0].size) / (BLOCKS * PHOTOS[0].K[0, 0])
    places = []
    for t in (table(96), table(32)):
        out = withheld(t, PHOTOS)
        at = np.c_[t.view.numpy(), np.floor(t.xy.numpy() / size)].astype(int)
        subject = (t.alpha > 0.5).numpy()
        chosen, others = ({tuple(x) for x in at[subject & w]} for w in (out.numpy(), ~out.numpy()))
        assert len(chosen) > 100 and not chosen & others
        places.append(chosen)
    assert len(places[0] ^ places[1]) < 0.2 * len(places[0])


def test_they_are_never_drawn_until_they_are_released() -> None:
    t = table()
    out = withheld(t, PHOTOS)
    chosen = {tuple(x) for x in t.at(torch.nonzero(out).squeeze(-1)).rays.d.numpy()}
    t.withhold(out)
    t.exclude((3,))
    drawn = t.draw(20_000, 0.25, 0)
    assert not {tuple(x) for x in drawn.rays.d.numpy()} & chosen and not (drawn.view == 3).any()
    assert len(drawn.view.unique()) == len(PHOTOS) - 1
    t.withhold(None)
    t.exclude(())
    drawn = t.draw(20_000, 0.25, 0)
    assert {tuple(x) for x in drawn.rays.d.numpy()} & chosen and (drawn.view == 3).any()


def test_the_psnr_is_that_of_the_whole_picture_in_these_pixels() -> None:
    """Against a rendering of the whole view, compared in numpy."""
    fit = ball()
    t = table()
    pixels = judged_pixels(t, withheld(t, PHOTOS), len(PHOTOS))
    got = psnr_by_view(fit.model, t, pixels, len(PHOTOS), 6)
    view = PHOTOS[4]
    own = pixels[t.view[pixels] == 4]
    rgba = predict_view(fit.model, view, 1, 6, "cpu")
    at = np.round(t.xy[own].numpy() * view.K[0, 0] + view.K[:2, 2] - 0.5).astype(int)
    shown = np.clip(rgba[at[:, 1], at[:, 0], :3], 0, 1)
    a, b = (
        np.where(x <= 0.0031308, 12.92 * x, 1.055 * x ** (1 / 2.4) - 0.055)
        for x in (shown, view.rgb[at[:, 1], at[:, 0]])
    )
    assert got[4] == pytest.approx(-10 * np.log10(((a - b) ** 2).mean()), abs=0.02)


def test_views_without_pixels_and_models_that_are_not_finite() -> None:
    fit, t = ball(), table()
    pixels = judged_pixels(t, withheld(t, PHOTOS), len(PHOTOS))
    some = pixels[t.view[pixels] != 2]
    found = psnr_by_view(fit.model, t, some, len(PHOTOS), 6)
    assert np.isnan(found[2]) and np.isfinite(np.delete(found, 2)).all()
    assert np.isnan(psnr_by_view(fit.model, t, pixels[:0], len(PHOTOS), 6)).all()
    t.alpha[t.view == 5] = WHOLE / 2
    assert not (t.view[judged_pixels(t, withheld(t, PHOTOS), len(PHOTOS))] == 5).any()
    with torch.no_grad():
        fit.model.light.coefficients.fill_(float("nan"))  # type: ignore[union-attr, operator]
    assert (psnr_by_view(fit.model, t, pixels, len(PHOTOS), 6) == -np.inf).all()
