"""Which piece is kept, what is handed on where the mesh can't be closed, and the findings of each ruin."""

from __future__ import annotations

import sys
from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest

from pipeline import meshes
from pipeline.artifacts import Located, MaskSet, ViewMask
from pipeline.capture_artifacts import Capture
from pipeline.contract import Context
from pipeline.meshes import Mesh
from stages.surface import build as building
from stages.surface.build import Built, build
from stages.surface.judge import judge
from stages.surface.pieces import votes
from stages.surface.stage import Config, Inputs, run
from stages.surface.thin import thin_share
from tests.support.analytic_fields import AnalyticField, Distance, bumpy_head, sphere, union
from tests.support.field_artifacts import fitted, poses

HEAD = sphere(0.05)
TORSO = sphere(0.09, (0.0, -0.29, 0.0))  # larger, and below the frame of every camera
HALF = (0.12, 0.4, 0.12)


def quiet(done: int, total: int) -> None:
    """No progress shown."""


@pytest.fixture(scope="module")
def good() -> Built:
    return build(AnalyticField(bumpy_head()), 64, quiet)


def levels(built: Built) -> dict[str, str]:
    return {f.check: f.level for f in judge(built)}


def test_a_clean_head_is_good_in_everything(good: Built) -> None:
    assert set(levels(good).values()) == {"good"} and len(levels(good)) == 7


@pytest.mark.parametrize(
    "check, ruin, level",
    [
        ("pieces_dropped", {"unshown": 0.06, "removed": 3}, "usable"),
        ("pieces_dropped", {"unshown": 0.45, "removed": 1}, "unusable"),
        ("cap", {"cap": 0.4}, "usable"),
        ("cap", {"cap": 0.8}, "unusable"),
        ("handles_cut", {"handles": (44, 0)}, "usable"),
        ("handles_cut", {"handles": (400, 0)}, "unusable"),
        ("handles_left", {"handles": (1, 1)}, "usable"),
        ("handles_left", {"handles": (0, 30)}, "unusable"),
        ("trimmed", {"trimmed": 0.95}, "unusable"),
        ("thin", {"thin": 0.05}, "usable"),
        ("thin", {"thin": 0.3}, "unusable"),
    ],
)
def test_each_ruin_has_its_level_and_a_remedy(good: Built, check: str, ruin: dict[str, float], level: str) -> None:
    found = {f.check: f for f in judge(replace(good, **ruin))}  # type: ignore[arg-type]
    assert found[check].level == level and found[check].remedy
    assert {f.level for f in found.values() if f.check != check} <= {"good"}


def kept(distance: Distance, folder: Path, monkeypatch: pytest.MonkeyPatch, masks: MaskSet | None = None):
    """The surface artifact and its mesh, as four cameras around the head decide."""
    face = fitted(folder, AnalyticField(distance, HALF), monkeypatch)
    photos = Located(Capture(kind="facescape", views=()), folder)
    inputs = Inputs(face, poses(folder), Located(masks or MaskSet(masks=()), folder), photos)
    surface = run(inputs, Config(resolution=64), Context(folder, folder))
    return surface, meshes.load(folder / surface.mesh.path)


def test_the_head_that_all_photos_show_is_kept_and_not_the_larger_torso(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    surface, mesh = kept(union(HEAD, TORSO), tmp_path, monkeypatch)
    assert np.abs(np.linalg.norm(mesh.vertices, axis=1) - 0.05).max() < 1e-3
    assert surface.removed_components == 1
    (dropped,) = (f for f in surface.findings if f.check == "pieces_dropped")
    assert dropped.level == "good"  # no photo shows the torso
    largest = build(AnalyticField(union(HEAD, TORSO), HALF), 64, quiet).mesh
    assert largest.vertices[:, 1].max() < -0.1  # without cameras


def test_a_dropped_piece_that_photos_show_is_told(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    surface, mesh = kept(union(HEAD, sphere(0.035, (0.0, 0.1, 0.0))), tmp_path, monkeypatch)
    assert np.abs(np.linalg.norm(mesh.vertices, axis=1) - 0.05).max() < 1e-3
    (dropped,) = (f for f in surface.findings if f.check == "pieces_dropped")
    assert dropped.level == "unusable" and 0.25 < dropped.value < 0.4 and "masks" in dropped.remedy


def test_masks_decide_what_the_photos_show(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    """Two balls one above the other; the masks hold the smaller one alone."""
    from pipeline.images import write_png

    upper = np.zeros((64, 64))
    upper[:20] = 1
    write_png(tmp_path / "mask.png", upper)
    from pipeline.artifacts import FileRef

    masks = MaskSet(
        masks=tuple(
            ViewMask(index=i, mask=FileRef.of(tmp_path, "mask.png"), source="given", coverage=0.3) for i in range(4)
        )
    )
    _, mesh = kept(union(HEAD, sphere(0.035, (0.0, 0.1, 0.0))), tmp_path, monkeypatch, masks)
    assert mesh.vertices[:, 1].min() > 0.06


def test_votes_are_shares_of_the_pictures(tmp_path: Path) -> None:
    """Two balls of radii 2 and 1 at one distance: four fifths and a fifth of each picture."""
    from pipeline.visibility import FittedPhoto

    big, small = (build(AnalyticField(sphere(r), (0.12, 0.12, 0.12)), 48, quiet).mesh for r in (0.05, 0.025))
    shift = np.float32([0, 0.1, 0])
    mesh = Mesh(
        np.concatenate([big.vertices - 0.3 * shift, small.vertices + 0.7 * shift]),
        np.concatenate([big.normals, small.normals]),
        np.concatenate([big.faces, small.faces + len(big.vertices)]),
    )
    piece = np.repeat([0, 1], [len(big.faces), len(small.faces)])
    views = [FittedPhoto(c, None) for c in poses(tmp_path).artifact.cameras]
    share = votes(mesh, piece, views, lambda: None)
    assert share.sum() == pytest.approx(1) and share[1] == pytest.approx(0.2, abs=0.02)
    assert not votes(mesh, piece, [], lambda: None).any()
    near = mesh.vertices.copy()
    near[len(big.vertices) :] += np.float32([0, -0.03, 0.3])  # half as far from the first camera: as large as the other
    half = votes(Mesh(near, mesh.normals, mesh.faces), piece, views[:1], lambda: None)
    assert half[1] == pytest.approx(0.5, abs=0.06)


def test_a_mesh_that_cannot_be_closed_is_handed_on_and_unusable(monkeypatch: pytest.MonkeyPatch) -> None:
    """A hole, and pymeshlab not there to close it."""
    monkeypatch.setitem(sys.modules, "pymeshlab", None)
    marched = building.extract.extract

    def holed(*given: object):
        vertices, faces = marched(*given)  # type: ignore[arg-type]
        return vertices, np.delete(faces, [10, 11, 500], axis=0)

    monkeypatch.setattr(building.extract, "extract", holed)
    got = build(AnalyticField(sphere()), 24, quiet)
    assert got.topology.sound and not got.topology.manifold and len(got.mesh.faces) > 1000
    (closed,) = (f for f in judge(got) if f.check == "closed")
    assert closed.level == "unusable" and closed.value > 0 and "pymeshlab" in closed.remedy


def test_flakes_are_measured_against_the_cell() -> None:
    """A plate of 4 mm: thin for a lattice of 3 mm, not for one of 1 mm."""

    def plate(p: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
        q = np.abs(p) - [0.08, 0.08, 0.002]
        axis = q.argmax(1)
        return q.max(1), np.sign(p)[np.arange(len(p)), axis][:, None] * np.eye(3)[axis]

    mesh = build(AnalyticField(plate, (0.1, 0.1, 0.1)), 200, quiet).mesh
    assert thin_share(mesh, 0.003) > 0.9 and thin_share(mesh, 0.001) < 0.05
