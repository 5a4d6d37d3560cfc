"""A ruined surface goes through uv, bake and usd: every stage hands on what it has and says what it is worth."""

from __future__ import annotations

from pathlib import Path

import numpy as np
import pytest

from pipeline import meshes
from pipeline.artifacts import FileRef, Located, MaskSet, Surface, ViewMask
from pipeline.capture_artifacts import Capture, CaptureView
from pipeline.contract import Context
from pipeline.images import write_png
from pipeline.verdict import worst
from stages.bake import stage as bake
from stages.usd import stage as usd
from stages.uv import stage as uv
from tests.support.analytic_fields import AnalyticField, sphere
from tests.support.ball_head import no_field, no_head
from tests.support.field_artifacts import fitted, poses
from tests.support.shreds import shredded, with_worthless_faces
from tests.support.synthetic_asset import smooth_light


@pytest.mark.slow
@pytest.mark.parametrize("noise", [0.4, 2.0])
def test_a_shredded_surface_becomes_an_asset(noise: float, tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    folders = {n: tmp_path / n for n in ("in", "uv", "bake", "usd")}
    for folder in folders.values():
        (folder / "scratch").mkdir(parents=True)
    given = folders["in"]
    mesh = with_worthless_faces(shredded(3, noise))
    meshes.save(given / "surface.npz", mesh)
    artifact = Surface(
        mesh=FileRef.of(given, "surface.npz"), vertices=len(mesh.vertices), faces=len(mesh.faces), watertight=True,
        components=1, removed_components=0, cell=0.005,
    )  # fmt: skip
    surface = Located(artifact, given)
    face, rig = fitted(given, AnalyticField(sphere(0.1)), monkeypatch, views=3), poses(given)
    np.savez(given / "light.npz", light=smooth_light())
    write_png(given / "mask.png", np.ones((64, 64)))
    views = []
    for i in range(4):
        write_png(given / f"{i}.png", np.full((64, 64, 3), 0.5))
        image = FileRef.of(given, f"{i}.png")
        views.append(CaptureView(index=i, name=f"{i}.png", image=image, width=64, height=64))
    capture = Located(Capture(kind="facescape", views=tuple(views)), given)
    mask = ViewMask(index=1, mask=FileRef.of(given, "mask.png"), source="given", coverage=1.0)
    masks = Located(MaskSet(masks=(mask,)), given)

    def context(name: str) -> Context:
        return Context(folders[name], folders[name] / "scratch")

    textured = uv.run(
        uv.Inputs(surface, face, rig, masks, no_head(surface.folder)),
        uv.Config(target_faces=5000, proxy_faces=300, texture_size=512),
        context("uv"),
    )
    at_uv = Located(textured, folders["uv"])
    maps = bake.run(
        bake.Inputs(surface, at_uv, face, rig, masks, capture, no_head(surface.folder), no_field(surface.folder)),
        bake.Config(size=256),
        context("bake"),
    )
    asset = usd.run(
        usd.Inputs(
            surface,
            no_head(surface.folder),
            at_uv,
            Located(maps, folders["bake"]),
            face,
            rig,
            capture,
            no_field(surface.folder),
            masks,
        ),  # fmt: skip
        usd.Config(preview_size=64, environment_width=64, samples=1),
        context("usd"),
    )
    assert (folders["usd"] / asset.root).is_file()
    for preview in ("previews/front.png", f"asset/{asset.name}.glb", f"asset/{asset.name}.usdz"):
        assert (folders["usd"] / preview).is_file()
    (faults,) = (f for f in asset.findings if f.check == "usd_faults")
    assert " st" not in faults.said, faults.said  # every face has texels of its own
    found = {f.check: f.level for f in textured.findings}
    assert worst(textured.findings) == found["crumpled"] == "unusable"  # and the stage that made it says what is wrong
    assert {found[c] for c in ("overlap", "texels_missing", "mirrored")} == {"good"}
