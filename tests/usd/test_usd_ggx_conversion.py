"""The learned lobe as a table and as GGX: exact where it can be, and honest about the rest."""

from __future__ import annotations

import numpy as np
import pytest

from pipeline.maths import ggx_width, microfacet
from stages.usd.write.ggx_conversion import (
    COSINES,
    INV_KAPPA_SCALE,
    REFERENCE_F0,
    ROWS,
    basis_table,
    fit_figures,
    in_groups,
    lobe_fit,
)


def test_table_times_the_layers_reflectance_is_the_basis() -> None:
    """sum_j c_j T_j(c, s) R(c, alpha(s)) = F(c), for every row, with R sampled anew at other places."""
    basis = np.random.default_rng(1).uniform(0.05, 1, (64, 3)).astype(np.float32)
    coefficients = np.array([0.02, 0.3, 0.1])
    table = basis_table(basis)
    assert table.shape == (ROWS, 64, 3)
    for row in (0, 10, 40, ROWS - 1):
        s = (1 - (row + 0.5) / ROWS) / INV_KAPPA_SCALE
        for column in (3, 20, 63):
            a, b = microfacet.split_albedo((column + 0.5) / 64, ggx_width.best_fit_alpha(1 / s))
            tint = table[row, column] @ coefficients
            assert tint * (REFERENCE_F0 * a + b) == pytest.approx(basis[column] @ coefficients, rel=1e-4)


def test_groups_hold_every_coefficient_and_nothing_else() -> None:
    image = np.arange(2 * 2 * 5, dtype=np.float32).reshape(2, 2, 5)
    groups = in_groups(image)
    assert [g.shape for g in groups] == [(2, 2, 3)] * 2
    np.testing.assert_array_equal(np.concatenate(groups, -1)[..., :5], image)
    assert not groups[1][..., 2].any()


def test_a_ggx_lobe_has_no_residual_and_another_has_its_own() -> None:
    """One basis function that is the reflectance of GGX at kappa = 12 and F0 = 0.03; then twice that."""
    alpha = ggx_width.best_fit_alpha(12.0)
    c = (np.arange(512) + 0.5) / 512
    a, b = microfacet.split_albedo(c, alpha)
    basis = (0.03 * a + b)[:, None].astype(np.float32)
    one, s = np.ones((4, 4, 1), np.float32), np.full((4, 4), 1 / 12, np.float32)
    f0, covered = np.full((4, 4), 0.03, np.float32), np.ones((4, 4), bool)
    assert lobe_fit(one, s, f0, basis, covered).residual.max() < 0.01
    wrong = lobe_fit(one, s, f0, basis * 2, covered)
    np.testing.assert_allclose(wrong.residual, 0.5, atol=0.01)  # |2 R - R| / |2 R|
    for known in ("ggx_residual_mean", "ggx_residual"):
        assert fit_figures([wrong])[known] == pytest.approx(0.5, abs=0.01)
    assert len(COSINES) >= 8


def test_where_there_is_no_lobe_nothing_is_left_over() -> None:
    """A dull surface; beside it a lobe as faint as a ten-thousandth under a layer with a rim, which counts; and without
    a layer, where all of the lobe is lost and no rim is added."""
    strength = np.array([[0.0, 1e-4, 1e-4]], np.float32)
    shape = strength.shape
    s, f0 = np.full(shape, 0.1, np.float32), np.array([[0.0, 1e-9, 0.0]], np.float32)
    fit = lobe_fit(strength[..., None], s, f0, np.ones((8, 1), np.float32), np.ones(shape, bool))
    assert fit.residual[0, 0] == 0 and fit.residual[0, 1] > 10
    assert fit.residual[0, 2] == pytest.approx(1, abs=1e-6)


def test_a_lobe_counts_by_what_it_reflects() -> None:
    """One texel with half of its lobe explained, and a hundred with next to no lobe, whose ratios are huge; each tile
    adds its sums. Against sums of its own, by quadrature in float64."""
    alpha = ggx_width.best_fit_alpha(12.0)
    c = (np.arange(512) + 0.5) / 512
    a, b = microfacet.split_albedo(c, alpha)
    basis = (2 * (0.03 * a + b))[:, None].astype(np.float32)
    strength = np.full((1, 101), 1e-5, np.float32)
    strength[0, 0] = 1
    s, f0 = np.full(strength.shape, 1 / 12, np.float32), np.full(strength.shape, 1e-9, np.float32)
    f0[0, 0] = 0.03
    covered = np.ones(strength.shape, bool)
    fit = lobe_fit(strength[..., None], s, f0, basis, covered)
    f1, r1, r0 = 2 * (0.03 * a + b), 0.03 * a + b, b
    error = (c * (f1 - r1) ** 2).sum() + 100 * (c * (1e-5 * f1 - r0) ** 2).sum()
    power = (c * f1**2).sum() * (1 + 100 * 1e-10)
    figures = fit_figures([fit])
    assert figures["ggx_residual"] == pytest.approx(np.sqrt(error / power), rel=0.01)
    assert figures["ggx_residual_mean"] > 100 * figures["ggx_residual"]
    assert fit_figures([fit, fit])["ggx_residual"] == pytest.approx(figures["ggx_residual"], abs=1e-4)
    dull = lobe_fit(0 * strength[..., None], s, f0, basis, covered)
    assert fit_figures([dull])["ggx_residual"] == 0


def test_texels_whose_kappa_the_light_can_not_tell_are_flagged() -> None:
    s = np.array([[1e-6, 0.01], [0.03, 0.1]], np.float32)
    covered = np.array([[True, False], [True, True]])
    shape = (2, 2)
    fit = lobe_fit(
        np.ones((*shape, 1), np.float32), s, np.full(shape, 0.03, np.float32), np.ones((8, 1), np.float32), covered
    )
    np.testing.assert_array_equal(fit.unresolved, [[True, False], [False, False]])
    assert fit_figures([fit])["kappa_unresolved_share"] == pytest.approx(1 / 3, abs=1e-4)
    assert not fit.residual[0, 1]
