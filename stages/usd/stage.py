"""Usd stage: exports mesh, maps, light and cameras as an asset for other programs."""

from __future__ import annotations

from collections.abc import Iterator
from dataclasses import dataclass
from pathlib import Path

import numpy as np
from numpy.typing import NDArray

from pipeline.artifacts import (
    CameraSet,
    FileRef,
    FittedFace,
    HeldOutView,
    Located,
    MaskSet,
    Surface,
    TextureSet,
    UvMesh,
)
from pipeline.asset_artifacts import UsdAsset
from pipeline.capture_artifacts import Capture
from pipeline.contract import Context, Stage
from pipeline.head_artifacts import RegisteredHead
from pipeline.reflectance_artifacts import ReflectanceField
from stages.usd.config import Config as Config


@dataclass(frozen=True, slots=True)
class Inputs:
    """The artifacts that are exported."""

    surface: Located[Surface]
    template: Located[RegisteredHead]
    uv: Located[UvMesh]
    bake: Located[TextureSet]
    inverse_rendering: Located[FittedFace]
    poses: Located[CameraSet]
    capture: Located[Capture]
    reflectance: Located[ReflectanceField]
    masks: Located[MaskSet]  # for its findings: the verdict is written into the asset


def run(inputs: Inputs, config: Config, context: Context) -> UsdAsset:
    """Write asset/, check it, and render the written files."""
    from pipeline.verdict import verdict_of_inputs
    from stages.usd import judge
    from stages.usd.check.validate import checks_run, found_in
    from stages.usd.render.films import render_films
    from stages.usd.render.previews import load_scene, render_held_out, render_previews, render_thumbnail
    from stages.usd.write.export import THUMBNAIL, export
    from stages.usd.write.mark import mark

    name = config.name
    total = 4
    context.progress(0, total, "writing the component")
    made = export(
        inputs.surface,
        inputs.uv,
        inputs.bake,
        inputs.inverse_rendering,
        inputs.poses,
        inputs.capture,
        inputs.template,
        inputs.reflectance,
        config,
        context.workdir / "asset",
        context.check,
    )
    written, warnings = made.written, list(made.notes)
    root = context.workdir / "asset" / f"{name}.usd"
    context.progress(1, total, "rendering previews")
    scene = load_scene(root, context.check)
    written.append(render_thumbnail(scene, root.parent / THUMBNAIL))
    folder = context.workdir / "previews"
    written += render_previews(scene, config.preview_size, folder, context.check)
    written += render_films(scene, config.film_frames, config.preview_size, folder, context.check)
    context.progress(2, total, "checking it")
    found = []
    for file in [f for f in written if f.parent == context.workdir / "asset" and f.name in _roots(name)]:
        context.check()
        found += [(file.name, f) for f in found_in(file)]
    warnings += [f"{file}: {f.check}: {f.message} {f.where}".strip() for file, f in found if f.level != "info"]
    context.progress(3, total, "rendering held-out views from the asset")
    views: tuple[HeldOutView, ...] = ()
    if config.render_views:
        views = render_held_out(
            scene, inputs.poses.artifact, inputs.inverse_rendering.artifact, config.samples, context
        )
    findings = (
        *judge.validity(found),
        *judge.against_model(_pictures(inputs, views, context)),
    )
    mark(root, verdict_of_inputs(inputs, usd=findings))
    context.progress(total, total, "done", checks=checks_run(), warnings=len(warnings))
    files = tuple(_refs(context, sorted(written)))
    return UsdAsset(
        name=name,
        root=f"asset/{name}.usd",
        files=files,
        views=views,
        figures=made.figures,
        stated=made.stated,
        checks=checks_run(),
        warnings=tuple(dict.fromkeys(warnings)),
        findings=findings,
    )


def _roots(name: str) -> tuple[str, ...]:
    return (f"{name}.usd", "lookdev.usda", f"{name}.usdz")


def _pictures(
    inputs: Inputs, views: tuple[HeldOutView, ...], context: Context
) -> Iterator[tuple[str, NDArray[np.float32], NDArray[np.float32]]]:
    """Photo's name, render of the model and render of the asset of each view, inside the photo's region that counts."""
    import cv2

    from pipeline.images import read_alpha, read_exr

    asked = {m.index: inputs.masks.path(m.asked) for m in inputs.masks.artifact.masks if m.asked is not None}
    fitted = inputs.inverse_rendering
    predicted = {v.index: v for v in fitted.artifact.held_out}
    names = {c.index: c.name for c in inputs.poses.artifact.cameras}
    for view in views:
        if view.index in predicted:
            model, _ = read_exr(fitted.path(predicted[view.index].exr))
            asset, _ = read_exr(context.workdir / view.exr.path)
            if view.index in asked:  # the fitted model reaches a little beyond the extent, the mesh does not
                part = cv2.resize(read_alpha(asked[view.index]), model.shape[1::-1], interpolation=cv2.INTER_AREA)
                model, asset = (x * (np.asarray(part) > 0.99)[..., None] for x in (model, asset))
            if model.shape == asset.shape:
                yield names.get(view.index, str(view.index)), model, asset


def _refs(context: Context, files: list[Path]) -> list[FileRef]:
    return [context.file(f) for f in files]


STAGE = Stage(name="usd", version=33, inputs=Inputs, config=Config, output=UsdAsset, run=run)
