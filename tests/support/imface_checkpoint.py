"""A checkpoint in ImFace's published layouts with random weights, and what it computes, by plain numpy."""

from __future__ import annotations

import numpy as np
import torch
from scipy.linalg import expm
from torch import Tensor

K, CODE, WIDTH, HYPER, FUSION, LAND = 5, 8, 16, 12, 10, 9
SPARSE = (36, 45, 30, 48, 54)
State = dict[str, Tensor]


def _layer(state: State, name: str, i: int, o: int, g: torch.Generator, scale: float = 1.0) -> None:
    state[f"{name}.weight"] = torch.randn(o, i, generator=g) * scale / np.sqrt(i)
    state[f"{name}.bias"] = torch.randn(o, generator=g) * 0.1 * scale


def ours(screw: bool, seed: int = 0, hidden: int = 3) -> State:
    """Random weights in the project's names. `screw`: SE(3) warps, else translations."""
    g = torch.Generator().manual_seed(seed)
    state: State = {
        "codes_id": 0.3 * torch.randn(4, CODE, generator=g),
        "codes_exp": 0.3 * torch.randn(8, CODE, generator=g),
        "template_landmarks": 0.4 * torch.randn(68, 3, generator=g),
    }
    for name, width in (("landmarks", 2 * CODE), ("id_landmarks", CODE)):
        for i, (a, b) in zip((0, 2, 4), ((width, LAND), (LAND, LAND), (LAND, 3 * K)), strict=True):
            _layer(state, f"{name}.{i}", a, b, g, 0.5)
    motion = 6 if screw else 3
    for net, out in (("deform", motion), ("reference", motion + 1), ("template", 1)):
        sizes = [3 * K] + [WIDTH] * (hidden + 1) + [out * K]
        shapes = []
        for i, (a, b) in enumerate(zip(sizes, sizes[1:], strict=False)):
            _layer(state, f"{net}.net.{i}", a, b, g, 0.1)
            shapes += [a * b, b]
        if net != "template":
            for j, n in enumerate(shapes):
                for i, (a, b) in enumerate(((CODE, HYPER), (HYPER, HYPER), (HYPER, n))):
                    _layer(state, f"{net}.hyper.{j}.{i}", a, b, g, 0.15 if i == 2 else 1.0)
        for i, (a, b) in zip((0, 3, 6), ((3, FUSION), (FUSION, FUSION), (FUSION, K)), strict=True):
            _layer(state, f"{net}.fusion.{i}", a, b, g)
            state[f"{net}.fusion.{i + 1}.weight"] = 1 + 0.1 * torch.randn(b, generator=g)
            state[f"{net}.fusion.{i + 1}.bias"] = 0.1 * torch.randn(b, generator=g)
    return state


def published(state: State, layout: str) -> State:
    """The same under the published names, written out here by hand and not by the code under test."""
    out: State = {}
    fields = {"deform": "exp_field", "reference": "id_field", "template": "template_field"}
    for name, value in state.items():
        first, _, rest = name.partition(".")
        if first in fields:
            kind, _, tail = rest.partition(".")
            parts = tail.split(".")
            net = f"{first}_net" if layout == "2022" else fields[first]
            deep = "net.net." if layout == "2022" else "net."
            if kind == "net":
                out[f"{net}.mini_nets.mini_net.{deep}{parts[0]}.0.{parts[1]}"] = value
            elif kind == "hyper":
                out[f"{net}.mini_nets.mini_hypernet.nets.{parts[0]}.net.{parts[1]}.0.{parts[2]}"] = value
            else:
                out[f"{net}.fusion.weights.{tail}"] = value
        elif layout == "2022":
            out[{"codes_id": "id_embedding.weight", "codes_exp": "exp_embedding.weight"}.get(name, name)] = value
        else:
            plain = {
                "codes_id": "embeddings.id_embeddings.weight",
                "codes_exp": "embeddings.exp_embeddings.weight",
                "template_landmarks": "landmark_nets.template_kpts",
            }
            nets = {"landmarks": "landmark_nets.exp_landmark_net", "id_landmarks": "landmark_nets.id_landmark_net"}
            out[plain[name] if name in plain else f"{nets[first]}.{rest}"] = value
    if layout == "2023":
        out["landmark_nets.sparse_index"] = torch.tensor(SPARSE)
        out["embeddings.valid_id"] = torch.ones(4, dtype=torch.int64)
    return out


# ------------------------------------------------------------------ what it computes, in float64 numpy
def reference_sdf(state: State, x: np.ndarray, screw: bool) -> np.ndarray:
    """I(p) point by point; rigid motions by scipy's matrix exponential."""
    s = {k: v.double().numpy() for k, v in state.items()}
    z_id, z_exp = s["codes_id"].mean(0), s["codes_exp"].mean(0)

    def dense(name: str, h: np.ndarray) -> np.ndarray:
        return s[f"{name}.weight"] @ h + s[f"{name}.bias"]

    def leaky(h: np.ndarray) -> np.ndarray:
        return np.where(h > 0, h, 0.01 * h)

    def norm(name: str, h: np.ndarray) -> np.ndarray:
        return (h - h.mean()) / np.sqrt(h.var() + 1e-5) * s[f"{name}.weight"] + s[f"{name}.bias"]

    def landmarks(name: str, z: np.ndarray) -> np.ndarray:
        h = leaky(dense(f"{name}.0", z))
        return dense(f"{name}.4", leaky(dense(f"{name}.2", h))).reshape(-1, 3)

    def blend(net: str, p: np.ndarray, marks: np.ndarray, z: np.ndarray | None) -> np.ndarray:
        weights = []
        depth = len([k for k in s if k.startswith(f"{net}.net.") and k.endswith("weight")])
        for i in range(depth):
            for j, kind in enumerate(("weight", "bias")):
                own = s[f"{net}.net.{i}.{kind}"]
                if z is None:
                    weights.append(own)
                    continue
                h = np.maximum(dense(f"{net}.hyper.{2 * i + j}.0", z), 0)
                h = np.maximum(dense(f"{net}.hyper.{2 * i + j}.1", h), 0)
                weights.append(dense(f"{net}.hyper.{2 * i + j}.2", h).reshape(own.shape))
        h = (p - marks).ravel()
        for i in range(depth):
            h = weights[2 * i] @ h + weights[2 * i + 1]
            h = np.sin(30 * h) if i < depth - 1 else h
        f = leaky(norm(f"{net}.fusion.1", dense(f"{net}.fusion.0", p)))
        f = leaky(norm(f"{net}.fusion.4", dense(f"{net}.fusion.3", f)))
        f = norm(f"{net}.fusion.7", dense(f"{net}.fusion.6", f))
        share = np.exp(f - f.max())
        return (share / share.sum()) @ h.reshape(K, -1)

    def move(p: np.ndarray, by: np.ndarray) -> np.ndarray:
        if not screw:
            return p + by
        w, v = by[:3], by[3:]
        twist = np.zeros((4, 4))
        twist[:3, :3] = [[0, -w[2], w[1]], [w[2], 0, -w[0]], [-w[1], w[0], 0]]
        twist[:3, 3] = v
        return (expm(twist) @ np.append(p, 1))[:3]

    out = []
    for p in x:
        q = move(p, blend("deform", p, landmarks("landmarks", np.concatenate([z_exp, z_id])), z_exp))
        r = blend("reference", q, landmarks("id_landmarks", z_id), z_id)
        at = move(q, r[:-1])
        out.append(blend("template", at, s["template_landmarks"][list(SPARSE)], None)[0] + r[-1])
    return np.array(out)
