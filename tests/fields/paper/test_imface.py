"""ImFace: the network against numpy, both published layouts, and what a wrong file is told."""

from __future__ import annotations

from pathlib import Path

import numpy as np
import pytest
import torch

from pipeline.errors import StageError
from pipeline.fields.paper.imface_layout import digest, load_imface_state, our_names
from pipeline.fields.paper.prior_imface import ImFacePrior, warp
from tests.support.imface_checkpoint import ours, published, reference_sdf

CENTRE, SCALE = torch.tensor([0.01, -0.02, 0.03]), 0.1


def prior_of(state: dict[str, torch.Tensor]) -> ImFacePrior:
    return ImFacePrior(our_names(state, "test"), CENTRE, SCALE)


def points(n: int = 20) -> torch.Tensor:
    return torch.randn(n, 3, generator=torch.Generator().manual_seed(1)) * 0.4


@pytest.mark.parametrize("layout", ["2022", "2023"])
@pytest.mark.parametrize("screw", [False, True])
def test_network_and_layout(layout: str, screw: bool, tmp_path: Path) -> None:
    """A checkpoint written under the published names gives the values that numpy finds, in asset units."""
    state = ours(screw)
    key = "decoder" if layout == "2022" else "model"
    torch.save({key: published(state, layout), "epoch": 3}, tmp_path / "envs_last.pth")
    prior = ImFacePrior(load_imface_state(tmp_path / "envs_last.pth"), CENTRE, SCALE).double()
    found = prior.sdf(CENTRE.double() + SCALE * points().double()).detach().numpy()
    expected = SCALE * reference_sdf(state, points().double().numpy(), screw)
    assert np.abs(found - expected).max() < 1e-6 * max(np.abs(expected).max(), 1e-3)
    assert np.ptp(expected) > 1e-3


def test_full_landmark_sets_are_thinned_to_five() -> None:
    """Networks of 2023 give all 68 landmarks; the blends take the five sparse ones."""
    state = ours(False)
    g = torch.Generator().manual_seed(9)
    for name in ("landmarks", "id_landmarks"):
        small_w, small_b = state[f"{name}.4.weight"], state[f"{name}.4.bias"]
        wide = torch.randn(68, 3, small_w.shape[1], generator=g)
        bias = torch.randn(68, 3, generator=g)
        wide[[36, 45, 30, 48, 54]], bias[[36, 45, 30, 48, 54]] = small_w.reshape(5, 3, -1), small_b.reshape(5, 3)
        state[f"{name}.4.weight"], state[f"{name}.4.bias"] = wide.reshape(204, -1), bias.reshape(204)
    full = prior_of(published(state, "2023"))
    assert torch.allclose(full.sdf(0.1 * points()), prior_of(published(ours(False), "2022")).sdf(0.1 * points()))


def test_gradients_reach_codes_networks_and_places() -> None:
    prior = prior_of(published(ours(True), "2022"))
    x = (0.1 * points()).requires_grad_()
    s = prior.sdf(x)
    (g,) = torch.autograd.grad(s.sum(), x, create_graph=True)
    ((g.norm(dim=-1) - 1) ** 2).mean().backward()
    for p in (prior.z_id, prior.z_exp, prior.template.net[0].weight):
        assert p.grad is not None and bool(torch.isfinite(p.grad).all()) and float(p.grad.abs().sum()) > 0
    assert prior.embeddings() is not None and prior.share == 0.01


def test_no_motion_at_all_has_finite_derivatives() -> None:
    """The axis of a rotation by 0 is 0 / 0 where it is written as a unit vector."""
    x = torch.randn(5, 3, dtype=torch.float64, requires_grad=True)
    motion = torch.zeros(5, 6, dtype=torch.float64, requires_grad=True)
    out = warp(x, motion)
    out.sum().backward()
    assert torch.equal(out, x) and motion.grad is not None and bool(torch.isfinite(motion.grad).all())
    size = torch.tensor([1e-9, 0.05, 0.0999, 0.1001, 2.0], dtype=torch.float64)[:, None]
    assert torch.autograd.gradcheck(lambda m: warp(x.detach(), m), (size * torch.ones(5, 6)).requires_grad_())


@pytest.mark.parametrize("layout", ["2022", "2023"])
def test_every_missing_key_is_named(layout: str) -> None:
    whole = published(ours(False), layout)
    our_names(whole, "whole")
    for key in whole:
        if key in ("landmark_nets.sparse_index", "embeddings.valid_id"):
            continue
        less = {k: v for k, v in whole.items() if k != key}
        with pytest.raises(StageError) as e:
            our_names(less, "less")
        # without a number of a list, the last one that is there is what fits no more
        assert key in str(e.value) or "shape" in str(e.value), key


def test_a_missing_key_is_named_as_published(tmp_path: Path) -> None:
    for layout, key in (
        ("2022", "deform_net.fusion.weights.3.bias"),
        ("2023", "landmark_nets.exp_landmark_net.2.weight"),
    ):
        state = published(ours(False), layout)
        del state[key]
        torch.save(state, tmp_path / "bare.pth")
        with pytest.raises(StageError, match=f"missing(.|\n)*no {key}"):
            load_imface_state(tmp_path / "bare.pth")


@pytest.mark.parametrize(
    ("key", "shape"),
    [
        ("id_landmarks.2.weight", (9, 7)),
        ("reference_net.mini_nets.mini_net.net.net.0.0.weight", (16, 93)),  # with positional encoding
        ("deform_net.mini_nets.mini_hypernet.nets.3.net.2.0.weight", (15, 12)),
        ("template_landmarks", (68, 2)),
        ("template_net.fusion.weights.7.weight", (4,)),
    ],
)
def test_a_wrong_shape_is_named(key: str, shape: tuple[int, ...]) -> None:
    state = published(ours(False), "2022")
    state[key] = torch.zeros(shape)
    with pytest.raises(StageError) as e:
        our_names(state, "file.pth")
    text = str(e.value)
    assert key in text and " x ".join(map(str, shape)) in text and "docs/imface.md" in text


def test_files_that_are_no_checkpoint(tmp_path: Path) -> None:
    with pytest.raises(StageError, match="no such file"):
        load_imface_state(tmp_path / "none.pth")
    (tmp_path / "torn.pth").write_bytes(b"torn")
    with pytest.raises(StageError, match="read safely"):
        load_imface_state(tmp_path / "torn.pth")
    torch.save({"model": [1, 2]}, tmp_path / "list.pth")
    with pytest.raises(StageError, match="does not contain the state"):
        load_imface_state(tmp_path / "list.pth")
    assert digest(str(tmp_path / "none.pth")) == "" and len(digest(str(tmp_path / "torn.pth"))) == 64


class Payload:
    def __reduce__(self) -> tuple[object, tuple[str]]:
        return print, ("run",)


def test_code_in_a_file_is_not_run(tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    torch.save({"decoder": Payload()}, tmp_path / "bad.pth")
    with pytest.raises(StageError, match="read safely"):
        load_imface_state(tmp_path / "bad.pth")
    assert "run" not in capsys.readouterr().out
