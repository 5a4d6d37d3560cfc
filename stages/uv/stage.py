"""UV stage: Surface in, UvMesh out."""

from __future__ import annotations

from dataclasses import dataclass

from pydantic import Field

from pipeline.artifacts import Located, Surface, UvMesh
from pipeline.contract import Context, Stage, StageConfig

MESH, PROXY = "uv_mesh.npz", "proxy.npz"


@dataclass(frozen=True, slots=True)
class Inputs:
    """The dense mesh."""

    surface: Located[Surface]


class Config(StageConfig):
    """Size of the meshes and how they are cut into charts."""

    target_faces: int = Field(50_000, ge=200, le=2_000_000, description="triangles of the mesh that is textured")
    proxy_faces: int = Field(5_000, ge=100, le=200_000, description="triangles of the coarse stand-in")
    texture_size: int = Field(1024, ge=256, le=8192, description="texture that the padding is measured in")
    padding: int = Field(4, ge=1, le=64, description="texels of texture_size between two charts")
    max_cost: float = Field(
        12.0, gt=0, le=64, description="how bent a chart of xatlas may get; for meshes that our own charts do not suit"
    )
    iterations: int = Field(1, ge=1, le=8, description="rounds in which xatlas grows charts from better seeds; slow")


def run(inputs: Inputs, config: Config, context: Context) -> UvMesh:
    """Decimate, cut, flatten, pack, measure. Raises StageError when the mesh can't be unwrapped."""
    from pipeline import meshes
    from stages.uv.build import build
    from stages.uv.unwrap import Options

    surface = inputs.surface
    dense = meshes.load(surface.path(surface.artifact.mesh))

    def step(done: int, total: int, message: str) -> None:
        context.check()
        context.progress(done, total, message)

    options = Options(config.texture_size, config.padding, config.max_cost, config.iterations)
    built = build(dense, config.target_faces, config.proxy_faces, options, step)
    meshes.save(context.workdir / MESH, built.mesh, built.charts)
    meshes.save(context.workdir / PROXY, built.proxy)
    return UvMesh(
        mesh=context.file(MESH),
        proxy=context.file(PROXY),
        vertices=len(built.mesh.vertices),
        faces=len(built.mesh.faces),
        charts=built.quality.charts,
        utilisation=built.quality.utilisation,
        stretch=built.quality.stretch,
        overlap=built.quality.overlap,
        stretch_max=built.quality.stretch_max,
        seam_front_mm=1000 * built.quality.seam_front,
        deviation_mm=1000 * built.deviation.mean,
        deviation_rms_mm=1000 * built.deviation.rms,
        proxy_deviation_rms_mm=1000 * built.proxy_deviation.rms,
        warnings=built.warnings,
    )


STAGE = Stage(name="uv", version=3, inputs=Inputs, config=Config, output=UvMesh, run=run)
