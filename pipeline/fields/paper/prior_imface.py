"""ImFace as a geometry prior: the network [NeuFace section 4.3], [Zheng et al. 2022].

Symbols: p position in the prior's own unit sphere; z_e, z_i codes of expression and identity; l_k K = 5 landmarks.

    q = warp(p, E(p; z_e)),   r, e = R(q; z_i),   I(p) = T(warp(q, r)) + e

E, R and T are blends of K small sinusoidal networks. The input of each is p - l_k for all landmarks, and its weight is
a softmax over the position; the weights of E and R come from hyper-networks of the codes. A warp is a translation or a
screw motion, which the width of E's output determines. Shapes come from the state, which `imface_layout` reads.
"""

from __future__ import annotations

from collections.abc import Mapping

import torch
from torch import Tensor, nn
from torch.nn import functional

State = Mapping[str, Tensor]


def linear(state: State, name: str) -> nn.Linear:
    """A layer with the weights `name`.weight and `name`.bias of a state."""
    weight, bias = state[f"{name}.weight"], state[f"{name}.bias"]
    layer = nn.Linear(weight.shape[1], weight.shape[0])
    with torch.no_grad():
        layer.weight.copy_(weight)
        layer.bias.copy_(bias)
    return layer


def count(state: State, prefix: str) -> int:
    """Number of numbered children `prefix`.0, `prefix`.1, ... in a state."""
    numbers = {k[len(prefix) + 1 :].split(".")[0] for k in state if k.startswith(prefix + ".")}
    return len(numbers)


class Hyper(nn.ModuleList):
    """Code -> the weights of a sinusoidal network: a ReLU network for each weight and bias."""

    def __init__(self, state: State, shapes: list[tuple[int, ...]]) -> None:
        super().__init__(
            nn.ModuleList(linear(state, f"hyper.{j}.{i}") for i in range(count(state, f"hyper.{j}")))
            for j in range(len(shapes))
        )
        self.shapes = shapes

    def weights(self, code: Tensor) -> list[Tensor]:
        """(C,) -> weight, bias, weight, bias, ..."""
        out = []
        for net, shape in zip(self, self.shapes, strict=True):
            assert isinstance(net, nn.ModuleList)
            h = code
            for i, layer in enumerate(net):
                h = layer(functional.relu(h) if i else h)
            out.append(h.reshape(shape))
        return out


class Fusion(nn.ModuleDict):
    """Softmax weights of the K networks at a position: linear, layer norm, leaky ReLU, twice, then linear, norm."""

    def __init__(self, state: State) -> None:
        super().__init__()
        for i in (0, 3, 6):
            self[str(i)] = linear(state, f"fusion.{i}")
            norm = nn.LayerNorm(state[f"fusion.{i + 1}.weight"].shape[0])
            with torch.no_grad():
                norm.weight.copy_(state[f"fusion.{i + 1}.weight"])
                norm.bias.copy_(state[f"fusion.{i + 1}.bias"])
            self[str(i + 1)] = norm

    def forward(self, x: Tensor) -> Tensor:
        """(N, 3) -> (N, K)."""
        h = x
        for i in (0, 3, 6):
            h = self[str(i + 1)](self[str(i)](functional.leaky_relu(h) if i else h))
        return torch.softmax(h, -1)


class BlendField(nn.Module):
    """K sinusoidal networks in one, blended by position. `hyper`: its weights come from a code."""

    def __init__(self, state: State, hyper: bool) -> None:
        super().__init__()
        self.net = nn.ModuleList(linear(state, f"net.{i}") for i in range(count(state, "net")))
        shapes = [tuple(int(n) for n in p.shape) for p in self._own()]
        self.hyper = Hyper(state, shapes) if hyper else None
        self.fusion = Fusion(state)

    def _own(self) -> list[Tensor]:
        out: list[Tensor] = []
        for layer in self.net:
            assert isinstance(layer, nn.Linear)
            out += [layer.weight, layer.bias]
        return out

    def forward(self, x: Tensor, landmarks: Tensor, code: Tensor | None) -> Tensor:
        """(N, 3), (K, 3) -> (N, outputs)."""
        weights = self._own() if self.hyper is None or code is None else self.hyper.weights(code)
        h = (x[:, None] - landmarks).flatten(1)
        last = len(weights) // 2 - 1
        for i in range(last + 1):
            h = functional.linear(h, weights[2 * i], weights[2 * i + 1])
            h = torch.sin(30 * h) if i < last else h
        share = self.fusion(x)
        blended: Tensor = (share[..., None] * h.reshape(len(x), share.shape[1], -1)).sum(1)
        return blended


def warp(x: Tensor, motion: Tensor) -> Tensor:
    """x moved by a translation (N, 3), or by a screw (w, v) (N, 6): exp([w] v) x.

        R = I + a W + b W^2,  t = (I + b W + c W^2) v,   a = sin T / T,  b = (1 - cos T) / T^2,  c = (T - sin T) / T^3

    a, b, c are series below T = 0.1, where the quotients lose precision and their derivatives are 0 / 0.
    """
    if motion.shape[1] == 3:
        return x + motion
    w, v = motion[:, :3], motion[:, 3:]
    t2 = (w * w).sum(-1, keepdim=True)
    small = t2 < 1e-2
    safe = torch.where(small, torch.ones_like(t2), t2)
    t = torch.sqrt(safe)
    a = torch.where(small, 1 - t2 / 6 + t2 * t2 / 120, torch.sin(t) / t)
    b = torch.where(small, 0.5 - t2 / 24 + t2 * t2 / 720, (1 - torch.cos(t)) / safe)
    c = torch.where(small, 1 / 6 - t2 / 120 + t2 * t2 / 5040, (t - torch.sin(t)) / (safe * t))

    def cross(p: Tensor) -> Tensor:
        out: Tensor = torch.linalg.cross(w, p)
        return out

    return x + a * cross(x) + b * cross(cross(x)) + v + b * cross(v) + c * cross(cross(v))


class LandmarkNet(nn.ModuleDict):
    """Codes -> landmarks: linear, leaky ReLU, twice, linear."""

    def __init__(self, state: State, name: str) -> None:
        super().__init__({str(i): linear(state, f"{name}.{i}") for i in (0, 2, 4)})

    def forward(self, code: Tensor) -> Tensor:
        """(C,) -> (P, 3)."""
        h = code
        for i in (0, 2, 4):
            h = self[str(i)](functional.leaky_relu(h) if i else h)
        out: Tensor = h.reshape(-1, 3)
        return out


class ImFacePrior(nn.Module):
    """`pipeline.fields.paper.priors.Prior` over ImFace, built from a state in our names (`imface_layout.our_names`).

    scale: asset units per unit of the prior; centre: its origin in asset coordinates. Its axes are the asset's.
    The codes are initialised to the mean of those in the state, and are learnt at the full rate; the networks at 1 % of
    it.
    """

    share = 0.01
    centre: Tensor
    sparse: Tensor
    template_landmarks: Tensor

    def __init__(self, state: State, centre: Tensor, scale: float) -> None:
        super().__init__()
        self.scale = scale
        self.register_buffer("centre", centre.float().clone())
        self.register_buffer("sparse", state["sparse"].long().clone())
        self.register_buffer("template_landmarks", state["template_landmarks"].float().clone())
        self.z_id = nn.Parameter(state["z_id"].float().clone())
        self.z_exp = nn.Parameter(state["z_exp"].float().clone())
        self.landmarks = LandmarkNet(state, "landmarks")
        self.id_landmarks = LandmarkNet(state, "id_landmarks")
        self.deform = BlendField(under(state, "deform"), hyper=True)
        self.reference = BlendField(under(state, "reference"), hyper=True)
        self.template = BlendField(under(state, "template"), hyper=False)

    def sdf(self, x: Tensor) -> Tensor:
        """I(x) (N,) at x (N, 3), asset units."""
        p = (x - self.centre) / self.scale
        l_exp = self._five(self.landmarks(torch.cat([self.z_exp, self.z_id])))
        q = warp(p, self.deform(p, l_exp, self.z_exp))
        out = self.reference(q, self._five(self.id_landmarks(self.z_id)), self.z_id)
        at = warp(q, out[:, :-1])
        value: Tensor = self.template(at, self._five(self.template_landmarks), None).squeeze(-1) + out[:, -1]
        return value * self.scale

    def _five(self, landmarks: Tensor) -> Tensor:
        """The landmarks by which the networks are blended: all of them, or the sparse ones of a full set."""
        return landmarks if len(landmarks) == len(self.sparse) else landmarks[self.sparse]

    def sphere(self) -> tuple[Tensor, float]:
        """The unit sphere in which ImFace is defined."""
        return self.centre, self.scale

    def embeddings(self) -> Tensor | None:
        """z of [NeuFace eq. 24]: both codes."""
        return torch.cat([self.z_id, self.z_exp])


def under(state: State, prefix: str) -> dict[str, Tensor]:
    """The part of a state below `prefix`, with the prefix removed."""
    return {k[len(prefix) + 1 :]: v for k, v in state.items() if k.startswith(prefix + ".")}
