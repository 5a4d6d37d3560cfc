"""UV stage: Surface in, UvMesh out."""

from __future__ import annotations

from dataclasses import dataclass
from typing import TYPE_CHECKING

from pipeline.artifacts import CameraSet, FittedFace, Located, MaskSet, Surface, UvMesh
from pipeline.contract import Context, Stage
from pipeline.head_artifacts import RegisteredHead
from pipeline.verdict import Finding
from stages.uv.config import Config as Config

if TYPE_CHECKING:
    from pipeline.meshes import Mesh
    from stages.uv.build import Built, Step

MESH, PROXY = "uv_mesh.npz", "proxy.npz"


@dataclass(frozen=True, slots=True)
class Inputs:
    """The dense mesh; the fitted photos and their cameras, for the pixel size on the mesh; the face's landmarks; the
    registered template."""

    surface: Located[Surface]
    inverse_rendering: Located[FittedFace]
    poses: Located[CameraSet]
    masks: Located[MaskSet]
    template: Located[RegisteredHead]


def run(inputs: Inputs, config: Config, context: Context) -> UvMesh:
    """Decimate, cut, parameterise, pack, measure. Raises StageError if the mesh can't be unwrapped."""
    from pipeline import meshes

    surface = inputs.surface
    dense = meshes.load(surface.path(surface.artifact.mesh))

    def step(done: int, total: int, message: str) -> None:
        context.check()
        context.progress(done, total, message)

    head, notes, quality = inputs.template, list[str](), tuple[Finding, ...]()
    ref = head.artifact.head if config.mesh != "scan" else None
    if ref is not None:
        from pipeline.registration.head import load_head
        from stages.uv.hair import hair_vertices
        from stages.uv.registered import build_registered

        registered, hair = load_head(head.path(ref)), hair_vertices(head, len(dense.vertices))
        built = build_registered(registered, head.artifact.regions, dense, config, step, hair)
        quality = head.artifact.quality
    else:
        built = _of_scan(dense, inputs, config, step)
        if config.mesh in ("template", "both") or (config.mesh == "auto" and head.artifact.faulty):
            notes.append(f"the mesh is the scan's: {head.artifact.reason}")
    made = _saved(built, "", context).model_copy(
        update={
            "of_template": ref is not None,
            "warnings": (*notes, *built.warnings),
            "findings": (*quality, *built.findings),
        }
    )
    if ref is None or config.mesh != "both":
        return made
    return made.model_copy(update={"scan": _saved(_of_scan(dense, inputs, config, step), "scan_", context)})


def _of_scan(dense: Mesh, inputs: Inputs, config: Config, step: Step) -> Built:
    """The decimated scan with charts of its own."""
    from pipeline import footprint
    from pipeline.faces.landmarks3d import load_landmarks
    from pipeline.fitted_cameras import cameras_of
    from stages.uv.build import build

    texel = None
    if config.tiles == "auto":
        fitted = inputs.inverse_rendering.artifact
        cameras = cameras_of(inputs.poses.artifact, fitted).cameras
        texel = footprint.pixel(dense, (c for c in cameras if c.index in fitted.fitted_views))
    ref = inputs.masks.artifact.landmarks
    landmarks = load_landmarks(inputs.masks.path(ref)) if ref is not None and config.face else None
    return build(dense, config, step, texel=texel, landmarks=landmarks)


def _saved(built: Built, prefix: str, context: Context) -> UvMesh:
    from pipeline import meshes

    meshes.save(context.workdir / f"{prefix}{MESH}", built.mesh, built.charts)
    meshes.save(context.workdir / f"{prefix}{PROXY}", built.proxy)
    return UvMesh(
        mesh=context.file(f"{prefix}{MESH}"),
        proxy=context.file(f"{prefix}{PROXY}"),
        vertices=len(built.mesh.vertices),
        faces=len(built.mesh.faces),
        quads=built.quads,
        hair_faces=built.hair_faces,
        charts=built.quality.charts,
        tiles=len(built.quality.tile_utilisation),
        utilisation=built.quality.utilisation,
        tile_utilisation=built.quality.tile_utilisation if len(built.quality.tile_utilisation) > 1 else (),
        stretch=built.quality.stretch,
        overlap=built.quality.overlap,
        stretch_max=built.quality.stretch_max,
        seam_front_mm=1000 * built.quality.seam_front,
        deviation_mm=1000 * built.deviation.mean,
        deviation_rms_mm=1000 * built.deviation.rms,
        proxy_deviation_rms_mm=1000 * built.proxy_deviation.rms,
        face_share=None if built.quality.face_share is None else round(built.quality.face_share, 5),
        warnings=built.warnings,
        findings=built.findings,
    )


STAGE = Stage(name="uv", version=17, inputs=Inputs, config=Config, output=UvMesh, run=run)
