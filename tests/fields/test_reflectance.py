"""The material's integral against quadrature of known lobes over the hemisphere, in float64. [NeuFace eq. 6, 7, 8]"""

from __future__ import annotations

import numpy as np
import numpy.typing as npt
import pytest
import torch
from numpy.polynomial.legendre import leggauss

from pipeline.fields.appearance import IntegratedBasis, SpatialField
from pipeline.fields.encodings import HashEncoding
from pipeline.fields.paper.material import DirectIntegral
from pipeline.maths import brdf
from tests.fields.test_face import ball_model, sphere_points

F64 = npt.NDArray[np.float64]
POWERS = (2.0, 9.0, 40.0)


def lobe(power: float, cosine: F64) -> F64:
    """The integral of b(wi, wo) (wi . n)+ over the hemisphere of n, for b = (p + 1) / 2 pi (wi . w_r)+^p and each
    n . wo: a product rule in the frame of n, with wo in the plane y = 0, at 101 cosines and linear between them."""
    z, w = leggauss(60)
    z, w = (z + 1) / 2, w / 2
    phi = 2 * np.pi * (np.arange(120) + 0.5) / 120
    s = np.sqrt(1 - z**2)
    wi = np.stack([np.outer(s, np.cos(phi)), np.outer(s, np.sin(phi)), np.outer(z, np.ones(120))], -1)
    at = np.linspace(0, 1, 101)
    mirror = np.stack([-np.sqrt(1 - at**2), np.zeros_like(at), at], -1)
    b = (power + 1) / (2 * np.pi) * np.maximum(wi @ mirror.T, 0) ** power
    return np.interp(cosine, at, np.einsum("z,zpk->k", w * z * 2 * np.pi / 120, b))


def spread(n: int, seed: int) -> tuple[torch.Tensor, torch.Tensor]:
    """Unit n and wo, (N, 3) each: wo on the visible side, along n in the first row and grazing in the second."""
    g = torch.Generator().manual_seed(seed)
    n_, wo = (torch.nn.functional.normalize(torch.randn(n, 3, generator=g), dim=-1) for _ in range(2))
    wo = torch.where(((wo * n_).sum(-1) < 0)[:, None], -wo, wo)
    wo[0] = n_[0]
    wo[1] = torch.nn.functional.normalize(torch.linalg.cross(n_[1], wo[1]), dim=0)
    return n_, wo


def cosines(n: torch.Tensor, wo: torch.Tensor) -> F64:
    return (n * wo).sum(-1).clamp(0, 1).double().numpy()


def relu_network(net: torch.nn.Sequential, x: F64) -> F64:
    layers = [m for m in net if isinstance(m, torch.nn.Linear)]
    for i, m in enumerate(layers):
        x = x @ m.weight.detach().double().numpy().T + m.bias.detach().double().numpy()
        x = np.maximum(x, 0) if i < len(layers) - 1 else x
    return x


def taught(net: torch.nn.Module, loss: object, steps: int = 400) -> None:
    optimiser = torch.optim.Adam(net.parameters(), lr=1e-2)
    for _ in range(steps):
        optimiser.zero_grad()
        value = loss()  # type: ignore[operator]
        value.backward()
        optimiser.step()


# ------------------------------------------------------------------ equation 6
@pytest.mark.slow
def test_the_direct_integral_learns_a_lobe_that_differs_from_place_to_place() -> None:
    """[NeuFace eq. 6]: F(x, wo, n) fitted to quadratures of f_s (wi . n)+, f_s = g(x) times a lobe, g from 0.3 to 1.7.
    At places and directions that it never saw, grazing ones among them, it is within a tenth."""
    torch.manual_seed(0)
    centre, radius = torch.tensor([0.3, -0.2, 0.1]), 0.1
    f = DirectIntegral(centre, radius, 48, 2)

    def draw(count: int, seed: int) -> tuple[torch.Tensor, torch.Tensor, torch.Tensor, torch.Tensor]:
        n, wo = spread(count, seed)
        x = centre + radius * (2 * torch.rand(count, 3, generator=torch.Generator().manual_seed(seed)) - 1) * 0.5
        g = 1 + 0.7 * np.sin(8 * ((x - centre) / radius)[:, 0].double().numpy())
        return x, wo, n, torch.from_numpy(g * lobe(9.0, cosines(n, wo))).float()

    x, wo, n, wanted = draw(4000, 1)
    none = torch.zeros(0)
    taught(f, lambda: ((f.integral(x, none, wo, n) - wanted) ** 2).mean(), 300)
    x, wo, n, wanted = draw(500, 2)
    with torch.no_grad():
        found = f.integral(x, none, wo, n)
    assert float((found - wanted).square().mean().sqrt()) < 0.1 * float(wanted.square().mean().sqrt())
    assert float((found[:2] / wanted[:2] - 1).abs().max()) < 0.3, "along the normal and at a grazing angle"


def test_the_direct_integral_by_hand() -> None:
    """[NeuFace eq. 6] in float64: its nine variables, sines of six octaves of x, and the cosine, which is 0 below the
    horizon. As part of the model it stands where c . B stands, and never reads c."""
    model = ball_model(integral="direct")
    f = model.basis
    assert isinstance(f, DirectIntegral)
    n, wo = spread(60, 3)
    wo[2] = -n[2]  # seen from below: an extreme that a bump of the surface can give
    x = 0.15 * sphere_points(60) + 0.01
    u = ((x - f.centre) / f.radius).double().numpy()
    waves = [w(2.0**k * np.pi * u) for k in range(6) for w in (np.sin, np.cos)]
    cosine = np.maximum((wo.double() * n.double()).sum(-1).numpy(), 0)[:, None]
    raw = relu_network(f.net, np.concatenate([u, *waves, wo.double().numpy(), n.double().numpy(), cosine], 1))
    by_hand = np.log1p(np.exp(raw[:, 0]))
    with torch.no_grad():
        shaded = model.shade(x, n, wo)
        _, rho, c, s = model.spatial(x)
        assert np.allclose(f.integral(x, c, wo, n).numpy(), by_hand, rtol=1e-4)
        assert torch.equal(f.integral(x, c, wo, n), f.integral(x, 7 * c + 1, wo, n))
        incident = brdf.light_integral(brdf.reflect(wo, n), s, model.light(), model.spec.attenuation)
    assert np.allclose(shaded.specular.numpy(), (rho.numpy() * by_hand)[:, None] * incident.numpy(), rtol=1e-4)


# ------------------------------------------------------------------ equations 7 and 8
def test_the_integral_of_a_sum_of_lobes_is_c_times_b() -> None:
    """[NeuFace eq. 7, 8]: three bases taught one lobe each; for any c the integral is the quadrature of the one
    reflectance f_s = c_1 b_1 + c_2 b_2 + c_3 b_3, from along the normal to grazing. With one c alone it is that lobe,
    and without any it is 0."""
    torch.manual_seed(0)
    basis = IntegratedBasis(3, 24, 2, True)
    n, wo = spread(300, 4)
    each = torch.from_numpy(np.stack([lobe(p, cosines(n, wo)) for p in POWERS], 1)).float()
    taught(basis, lambda: ((basis(wo, n) - each) ** 2).mean())
    n, wo = spread(200, 5)
    at = cosines(n, wo)
    c = 2 * torch.rand(200, 3, generator=torch.Generator().manual_seed(6))
    c[:4] = torch.tensor([[1.0, 0, 0], [0, 1, 0], [0, 0, 1], [0, 0, 0]])
    wanted = np.sum([c[:, j].double().numpy() * lobe(p, at) for j, p in enumerate(POWERS)], 0)
    with torch.no_grad():
        found = basis.integral(torch.zeros(200, 3), c, wo, n).numpy()
    assert np.allclose(found, wanted, atol=0.03 * wanted.max()) and found[3] == 0


@pytest.mark.parametrize("positive", [True, False])
def test_the_coefficients_of_a_place_by_hand(positive: bool) -> None:
    """[NeuFace eq. 7]: c_j(x) is the softplus of the last k outputs (the output itself where signs are allowed), and
    reads no other: at outputs of -200 and 200 too."""
    torch.manual_seed(0)
    encoding = HashEncoding(torch.full((3,), -0.2), torch.full((3,), 0.2), 0.1, 0.01, 4, 10)
    field = SpatialField(encoding, 4, 16, 1, (0.5, 0.4, 0.3), positive)
    last = field.net[-1]
    assert isinstance(last, torch.nn.Linear)
    with torch.no_grad():
        encoding.table.normal_()
        last.bias[5:] = torch.tensor([-200.0, 200.0, 0.5, -1.0])
        x = 0.1 * sphere_points(40)
        a, rho, c, s = field(x)
        raw = relu_network(field.net, encoding(x).double().numpy())
    sigmoid, softplus = 1 / (1 + np.exp(-raw)), np.logaddexp(0, raw)
    assert np.allclose(c.numpy(), softplus[:, 5:] if positive else raw[:, 5:], rtol=1e-4, atol=1e-5)
    assert np.allclose(a.numpy(), sigmoid[:, :3], rtol=1e-4) and np.allclose(rho.numpy(), sigmoid[:, 3], rtol=1e-4)
    assert np.allclose(s.numpy(), softplus[:, 4], rtol=1e-4)
