"""Surface stage: FittedFace in, Surface out."""

from __future__ import annotations

from dataclasses import dataclass
from typing import Annotated, Literal

import numpy as np
from pydantic import Field

from pipeline.artifacts import CameraSet, FittedFace, Located, MaskSet, Surface
from pipeline.capture_artifacts import Capture
from pipeline.contract import Context, Stage, StageConfig
from pipeline.units import Cells, Unit

MESH, FAIRING = "surface.npz", "fairing.npz"


@dataclass(frozen=True, slots=True)
class Inputs:
    """The fitted field, and the cameras, masks and photos that it was fitted to."""

    inverse_rendering: Located[FittedFace]
    poses: Located[CameraSet]
    masks: Located[MaskSet]
    capture: Located[Capture]


class Config(StageConfig):
    """Settings of the surface stage."""

    resolution: Cells = Field(
        256,
        ge=16,
        le=1024,
        description="lattice cells along the longest side of the field's box; time and faces grow with its square",
    )
    unseen: Literal["closed", "trimmed"] = Field(
        "closed", description="surface that no fitted photo shows: keep it (closed mesh) or cut it off"
    )
    fair: Annotated[float, Unit("share of the box's longest side")] = Field(
        0.022,
        ge=0,
        le=0.05,
        description="length over which surface is smoothed that no photo shows, as a share of the box's longest "
        "side; 0 keeps it as the fit left it",
    )
    handle: Annotated[float, Unit("share of the box's longest side")] = Field(
        0.1,
        ge=0,
        le=10,
        description="handles with a loop up to this share of the box's longest side are removed; 0 keeps all",
    )


def run(inputs: Inputs, config: Config, context: Context) -> Surface:
    """Mesh the zero set. Raises StageError if the field has none."""
    from pipeline import meshes
    from pipeline.fields.face import load_face
    from pipeline.fields.faired import Faired
    from pipeline.visibility import Occluder, looks_into, seen_by, view_cosines
    from stages.surface.build import build
    from stages.surface.fairing import faired
    from stages.surface.judge import judge
    from stages.surface.judge_face import face_findings
    from stages.surface.pieces import votes

    fitted = inputs.inverse_rendering
    field = load_face(fitted.path(fitted.artifact.field), context.device)

    def step(done: int, total: int) -> None:
        context.check()
        context.progress(done, total, "marching cubes")

    views = seen_by(fitted.artifact, inputs.poses.artifact, inputs.masks, inputs.capture)
    trims, extent = config.unseen == "trimmed", inputs.masks.artifact.extent

    def looked(rough: Occluder, points: meshes.F64) -> tuple[meshes.Mask, meshes.Mask]:
        into, shown = np.zeros((2, len(points)), np.bool_)
        for view in views:
            context.check()
            rest = np.flatnonzero(~shown)
            more, shown[rest] = looks_into(view, points[rest], rough)
            into[rest] |= more
        return into, shown

    fairs = bool(views) and config.fair > 0 and not trims
    solid = faired(field, config.fair, looked, step, extent) if fairs else field

    def vote(mesh: meshes.Mesh, piece: meshes.Indices) -> meshes.F64:
        return votes(mesh, piece, views, context.check)

    def sees(mesh: meshes.Mesh) -> meshes.Mask:
        points, normals = mesh.vertices.astype(np.float64), mesh.normals.astype(np.float64)
        occluder, seen = Occluder(mesh), np.zeros(len(points), np.bool_)
        for i, view in enumerate(views):
            context.check()
            context.progress(i, len(views), "visibility")
            rest = np.flatnonzero(~seen)
            seen[rest] = view_cosines(view, points[rest], normals[rest], occluder)[0] > 0
        return seen

    built = build(solid, config.resolution, step, sees if trims else None, config.handle, vote, extent)
    meshes.save(context.workdir / MESH, built.mesh)
    if isinstance(solid, Faired):
        solid.save(context.workdir / FAIRING)
    context.log.info(
        "surface: %d faces, cell %.4g, %.1f %% cap, largest residual %.2g, %d handles cut",
        len(built.mesh.faces),
        built.cell,
        100 * built.cap,
        built.residual,
        built.handles[0],
    )
    return Surface(
        mesh=context.file(MESH),
        fairing=context.file(FAIRING) if isinstance(solid, Faired) else None,
        vertices=len(built.mesh.vertices),
        faces=len(built.mesh.faces),
        watertight=built.topology.manifold,
        components=built.topology.components,
        removed_components=built.removed,
        cell=built.cell,
        trimmed=round(built.trimmed, 6),
        handles_cut=built.handles[0],
        handles_left=built.handles[1],
        warnings=built.warnings,
        findings=(*judge(built), *face_findings(inputs, built.mesh)),
    )


STAGE = Stage(name="surface", version=10, inputs=Inputs, config=Config, output=Surface, run=run)
