"""Surface stage: FittedFace in, Surface out."""

from __future__ import annotations

from dataclasses import dataclass

from pydantic import Field

from pipeline.artifacts import CameraSet, FittedFace, Located, Surface
from pipeline.contract import Context, Stage, StageConfig

MESH = "surface.npz"


@dataclass(frozen=True, slots=True)
class Inputs:
    """The fitted field, and the cameras for the unit of length."""

    inverse_rendering: Located[FittedFace]
    poses: Located[CameraSet]


class Config(StageConfig):
    """How finely the zero set is sampled."""

    resolution: int = Field(
        256,
        ge=16,
        le=1024,
        description="lattice cells along the longest side of the field's box; time and faces grow with its square",
    )


def run(inputs: Inputs, config: Config, context: Context) -> Surface:
    """Mesh the zero set. Raises StageError when the field has none."""
    from pipeline import meshes
    from pipeline.fields.face import load_face
    from stages.surface.build import build

    fitted = inputs.inverse_rendering
    field = load_face(fitted.path(fitted.artifact.field), context.device)

    def step(done: int, total: int) -> None:
        context.check()
        context.progress(done, total, "marching cubes")

    built = build(field, config.resolution, step)
    meshes.save(context.workdir / MESH, built.mesh)
    context.log.info(
        "surface: %d faces, cell %.4g, %.1f %% cap, largest residual %.2g",
        len(built.mesh.faces),
        built.cell,
        100 * built.cap,
        built.residual,
    )
    return Surface(
        mesh=context.file(MESH),
        vertices=len(built.mesh.vertices),
        faces=len(built.mesh.faces),
        watertight=built.topology.manifold,
        components=built.topology.components,
        removed_components=built.removed,
        cell=built.cell,
        warnings=built.warnings,
    )


STAGE = Stage(name="surface", version=1, inputs=Inputs, config=Config, output=Surface, run=run)
