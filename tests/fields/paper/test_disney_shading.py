"""The Disney shading that NeuFace is compared with, by hand."""

from __future__ import annotations

from types import SimpleNamespace

import numpy as np
import pytest
import torch

from pipeline.fields.paper.shading import DisneyShading
from pipeline.fields.parts import Skin
from pipeline.maths import ggx_width, split_sum


@pytest.mark.parametrize("light", ["sh", "cubemap"])
def test_disneys_f0_and_width_by_hand(light: str) -> None:
    """F0 = 0.04 (1 - m) + albedo m goes into the split sum; the cube map is blurred by alpha, the SH by 1/kappa."""
    asked: list[torch.Tensor] = []

    class Even:
        def reflected(self, w_r: torch.Tensor, width: torch.Tensor, attenuation: str) -> torch.Tensor:
            asked.append(width)
            return torch.ones_like(w_r)

    m, s = torch.tensor([0.0, 0.25, 1.0]), torch.tensor([0.05, 0.2, 1.0])
    albedo = torch.tensor([[0.5, 0.4, 0.3]] * 3)
    n = torch.tensor([[0.0, 0, 1]] * 3)
    spec = SimpleNamespace(light=light, attenuation="exact")
    shading = DisneyShading(spec, None, Even())  # type: ignore[arg-type]
    got = shading.specular(Skin(albedo, m, torch.ones(3, 1), s), n, n, n)
    alpha = ggx_width.gauge_alpha(s)
    assert torch.equal(asked[0], alpha if light == "cubemap" else s) and not torch.allclose(alpha, s, rtol=0.05)
    black, white = (split_sum.environment_brdf(torch.full((3, 3), f), torch.ones(3), alpha) for f in (0.0, 1.0))
    f0 = np.array([[0.04] * 3, [0.155, 0.13, 0.105], [0.5, 0.4, 0.3]])
    assert np.allclose(got.numpy(), (black + (white - black) * torch.from_numpy(f0).float()).numpy(), atol=1e-6)
    assert np.allclose(shading.diffuse_albedo(Skin(albedo, m, m, s)).numpy()[:, 0], [0.5, 0.375, 0.0])
