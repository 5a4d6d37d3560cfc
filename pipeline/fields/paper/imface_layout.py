"""Reads published ImFace checkpoints and renames their keys to ours, with exact error messages.

There are two layouts, which are distinguished by their keys:
    of 2022    envs_last.pth -> 'decoder': id_embedding.weight, landmarks.0.weight, template_landmarks,
               {deform,reference,template}_net.mini_nets.mini_net.net.net.I.0.*, ...mini_hypernet.nets.J.net.I.0.*,
               ...fusion.weights.I.*
    of 2023    envs_last.pth -> 'model': embeddings.id_embeddings.weight, landmark_nets.id_landmark_net.0.weight,
               {exp,id,template}_field.mini_nets.mini_net.net.I.0.*, ...
A file may also contain only the state. Only tensors are read, never code.
"""

from __future__ import annotations

import hashlib
import re
from pathlib import Path
from typing import TYPE_CHECKING

from pipeline.errors import StageError

if TYPE_CHECKING:
    from torch import Tensor

SPARSE = (36, 45, 30, 48, 54)  # outer eye corners, tip of the nose, corners of the mouth, of 68 landmarks
RENAMES = {
    "2022": [
        (r"^id_embedding\.weight$", "codes_id"),
        (r"^exp_embedding\.weight$", "codes_exp"),
        (r"^(landmarks|id_landmarks)\.", r"\1."),
        (r"^template_landmarks$", "template_landmarks"),
        (r"^(deform|reference|template)_net\.mini_nets\.mini_net\.net\.net\.(\d+)\.0\.", r"\1.net.\2."),
        (
            r"^(deform|reference|template)_net\.mini_nets\.mini_hypernet\.nets\.(\d+)\.net\.(\d+)\.0\.",
            r"\1.hyper.\2.\3.",
        ),
        (r"^(deform|reference|template)_net\.fusion\.weights\.", r"\1.fusion."),
    ],
    "2023": [
        (r"^embeddings\.id_embeddings\.weight$", "codes_id"),
        (r"^embeddings\.exp_embeddings\.weight$", "codes_exp"),
        (r"^landmark_nets\.exp_landmark_net\.", "landmarks."),
        (r"^landmark_nets\.id_landmark_net\.", "id_landmarks."),
        (r"^landmark_nets\.template_kpts$", "template_landmarks"),
        (r"^landmark_nets\.sparse_index$", "sparse"),
        (r"^(exp|id|template)_field\.mini_nets\.mini_net\.net\.(\d+)\.0\.", r"\1.net.\2."),
        (r"^(exp|id|template)_field\.mini_nets\.mini_hypernet\.nets\.(\d+)\.net\.(\d+)\.0\.", r"\1.hyper.\2.\3."),
        (r"^(exp|id|template)_field\.fusion\.weights\.", r"\1.fusion."),
    ],
}
FIELDS_2023 = {"exp": "deform", "id": "reference", "template": "template"}
REMEDY = "pass the envs_last.pth of a published ImFace model (docs/imface.md)"


def digest(path: str) -> str:
    """sha256 of a file, or "" if it is missing (the loader reports that)."""
    file = Path(path)
    return hashlib.sha256(file.read_bytes()).hexdigest() if file.is_file() else ""


def load_imface_state(path: Path) -> dict[str, Tensor]:
    """Read and check a published checkpoint, with keys renamed to ours.

    Raises:
        StageError: the file can't be read, a key is missing, or a shape is wrong. The message names it.
    """
    import torch

    try:
        loaded = torch.load(path, map_location="cpu", weights_only=True)
    except FileNotFoundError as e:
        raise StageError(
            "there is no such file", where=path, value="nothing", limit="an ImFace checkpoint", remedy=REMEDY
        ) from e
    except Exception as e:
        raise StageError(
            "the file is not a checkpoint that can be read safely",
            where=path,
            value=str(e).splitlines()[0][:200],
            limit="a file of torch.save with only tensors",
            remedy=REMEDY,
        ) from e
    state = next((loaded[k] for k in ("decoder", "model") if isinstance(loaded, dict) and k in loaded), loaded)
    if not isinstance(state, dict) or not all(isinstance(k, str) for k in state):
        raise StageError(
            "the file does not contain the state of a network",
            where=path,
            value=type(state).__name__,
            limit="a dictionary of tensors, or one under 'decoder' or 'model'",
            remedy=REMEDY,
        )
    tensors = {re.sub(r"^module\.", "", k): v for k, v in state.items() if isinstance(v, torch.Tensor)}
    return our_names(tensors, str(path))


def our_names(state: dict[str, Tensor], where: str) -> dict[str, Tensor]:
    """The state with our names, after checking that all shapes match. Raises StageError."""
    layout = "2023" if any(k.startswith(("exp_field.", "landmark_nets.")) for k in state) else "2022"
    renamed: dict[str, Tensor] = {}
    origin: dict[str, str] = {}
    for key, value in state.items():
        for pattern, ours in RENAMES[layout]:
            name, n = re.subn(pattern, ours, key)
            if n:
                if layout == "2023":
                    name = re.sub(r"^(exp|id)\.", lambda m: FIELDS_2023[m.group(1)] + ".", name)
                renamed[name], origin[name] = value, key
                break
    import torch

    _check(renamed, origin, layout, where)
    out = {k: v for k, v in renamed.items() if not k.startswith("codes_")}
    out["z_id"], out["z_exp"] = (_mean_code(renamed[f"codes_{k}"]) for k in ("id", "exp"))
    out.setdefault("sparse", torch.tensor(SPARSE))
    return out


def _mean_code(codes: Tensor) -> Tensor:
    """The mean of the trained codes, which are those with a length above 0."""
    used = codes[codes.norm(dim=1) > 0]
    return used.mean(0) if len(used) else codes.new_zeros(codes.shape[1])


def _published(name: str, layout: str) -> str:
    """The published key for one of our names, for messages."""
    if layout == "2022":
        fixed = {"codes_id": "id_embedding.weight", "codes_exp": "exp_embedding.weight"}
        name = re.sub(r"^(\w+)\.net\.(\d+)\.", r"\1_net.mini_nets.mini_net.net.net.\2.0.", name)
        name = re.sub(r"^(\w+)\.hyper\.(\d+)\.(\d+)\.", r"\1_net.mini_nets.mini_hypernet.nets.\2.net.\3.0.", name)
        name = re.sub(r"^(\w+)\.fusion\.", r"\1_net.fusion.weights.", name)
        return fixed.get(name, name)
    fixed = {
        "codes_id": "embeddings.id_embeddings.weight",
        "codes_exp": "embeddings.exp_embeddings.weight",
        "template_landmarks": "landmark_nets.template_kpts",
    }
    name = re.sub(r"^deform\.", "exp.", re.sub(r"^reference\.", "id.", name))
    name = re.sub(r"^(exp|id|template)\.net\.(\d+)\.", r"\1_field.mini_nets.mini_net.net.\2.0.", name)
    name = re.sub(
        r"^(exp|id|template)\.hyper\.(\d+)\.(\d+)\.", r"\1_field.mini_nets.mini_hypernet.nets.\2.net.\3.0.", name
    )
    name = re.sub(r"^(exp|id|template)\.fusion\.", r"\1_field.fusion.weights.", name)
    name = re.sub(r"^landmarks\.", "landmark_nets.exp_landmark_net.", name)
    name = re.sub(r"^id_landmarks\.", "landmark_nets.id_landmark_net.", name)
    return fixed.get(name, name)


class _Checker:
    """Checks the tensors of a renamed state; messages use the published keys."""

    def __init__(self, state: dict[str, Tensor], origin: dict[str, str], layout: str, where: str) -> None:
        self.state, self.origin, self.layout, self.where = state, origin, layout, where

    def get(self, name: str, *shape: int | None) -> Tensor:
        """The tensor `name`; None in `shape` means any size."""
        if name not in self.state:
            raise StageError(
                "a key is missing from the ImFace checkpoint",
                where=self.where,
                value=f"no {_published(name, self.layout)}",
                limit=f"the keys of the layout of {self.layout}",
                remedy=REMEDY,
            )
        t = self.state[name]
        if len(t.shape) != len(shape) or any(s is not None and s != n for s, n in zip(shape, t.shape, strict=True)):
            wanted = " x ".join("any" if s is None else str(s) for s in shape)
            self.wrong(name, " x ".join(map(str, t.shape)), wanted)
        return t

    def wrong(self, name: str, found: str, wanted: str) -> None:
        """Raise StageError: this key has a wrong shape."""
        raise StageError(
            "a key of the ImFace checkpoint has the wrong shape",
            where=f"{self.where}: {self.origin.get(name, name)}",
            value=found,
            limit=wanted,
            remedy=REMEDY,
        )

    def linear(self, name: str, width_in: int | None, width_out: int | None) -> int:
        """Check a layer; returns its output width."""
        weight = self.get(f"{name}.weight", width_out, width_in)
        self.get(f"{name}.bias", weight.shape[0])
        return int(weight.shape[0])

    def children(self, prefix: str) -> int:
        """Number of numbered children below a prefix, at least 1."""
        found = {k[len(prefix) + 1 :].split(".")[0] for k in self.state if k.startswith(prefix + ".")}
        return max(len(found), 1)


def _check(state: dict[str, Tensor], origin: dict[str, str], layout: str, where: str) -> None:
    """Check that every tensor that the prior reads exists and has a matching shape."""
    c = _Checker(state, origin, layout, where)
    n_id, n_exp = c.get("codes_id", None, None).shape[1], c.get("codes_exp", None, None).shape[1]
    landmarks = c.get("template_landmarks", None, 3)
    blends = c.get("deform.fusion.6.weight", None, None).shape[0]
    for name, width in (("landmarks", n_id + n_exp), ("id_landmarks", n_id)):
        hidden = c.linear(f"{name}.0", width, None)
        hidden = c.linear(f"{name}.2", hidden, None)
        out = c.linear(f"{name}.4", hidden, None)
        if out not in (3 * blends, 3 * 68):
            c.wrong(f"{name}.4.weight", f"{out} x {hidden}", f"{3 * blends} x {hidden} or 204 x {hidden}")
    if len(landmarks) not in (blends, 68):
        c.wrong("template_landmarks", f"{len(landmarks)} x 3", f"{blends} x 3 or 68 x 3")
    for net, code, per in (("deform", n_exp, (3, 6)), ("reference", n_id, (4, 7)), ("template", None, (1,))):
        _check_blend(c, net, code, [p * blends for p in per], blends)


def _check_blend(c: _Checker, net: str, code: int | None, outputs: list[int], blends: int) -> None:
    depth, width = c.children(f"{net}.net"), 3 * blends
    shapes = []
    for i in range(depth):
        before, width = width, c.linear(f"{net}.net.{i}", width, None)
        shapes += [width * before, width]
    if width not in outputs:
        c.wrong(f"{net}.net.{depth - 1}.weight", f"{width} outputs", " or ".join(map(str, outputs)) + " outputs")
    h = c.linear(f"{net}.fusion.0", 3, None)
    for i, into, out in ((1, h, h), (3, h, None), (4, h, h), (6, h, blends), (7, blends, blends)):
        if i in (1, 4, 7):
            c.get(f"{net}.fusion.{i}.weight", out)
            c.get(f"{net}.fusion.{i}.bias", out)
        else:
            c.linear(f"{net}.fusion.{i}", into, out)
    if code is None:
        return
    for j, numbers in enumerate(shapes):
        layers, before = c.children(f"{net}.hyper.{j}"), code
        for i in range(layers):
            last = i == layers - 1
            before = c.linear(f"{net}.hyper.{j}.{i}", before, numbers if last else None)
