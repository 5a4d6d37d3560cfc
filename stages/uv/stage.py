"""UV stage: Surface in, UvMesh out."""

from __future__ import annotations

from dataclasses import dataclass
from typing import Annotated, Literal

from pydantic import Field

from pipeline.artifacts import CameraSet, FittedFace, Located, MaskSet, Surface, UvMesh
from pipeline.contract import Context, Stage, StageConfig

MESH, PROXY = "uv_mesh.npz", "proxy.npz"


@dataclass(frozen=True, slots=True)
class Inputs:
    """The dense mesh; and for how fine the photos are on it, which of them were fitted and their cameras;
    and the face's landmarks."""

    surface: Located[Surface]
    inverse_rendering: Located[FittedFace]
    poses: Located[CameraSet]
    masks: Located[MaskSet]


class Config(StageConfig):
    """Size of the meshes and how they are cut into charts."""

    target_faces: int = Field(50_000, ge=200, le=2_000_000, description="triangles of the mesh that is textured")
    remesh: Literal["adaptive", "even"] = Field(
        "adaptive",
        description="adaptive: few triangles where it is flat; even: one size and shape, for sculpting and quads",
    )
    proxy_faces: int = Field(5_000, ge=100, le=200_000, description="triangles of the coarse stand-in")
    tiles: Annotated[int, Field(ge=1, le=10)] | Literal["auto"] = Field(
        1, description="UDIM tiles to fill; auto: as many as it takes for texels no coarser than the photos' pixels"
    )
    tile_size: int = Field(
        1024, ge=256, le=16384, description="texels along a tile's side that tiles=auto counts on; bake.size if not set"
    )
    texture_size: int = Field(1024, ge=256, le=8192, description="texture that the padding is measured in")
    padding: int = Field(4, ge=1, le=64, description="texels of texture_size between two charts")
    max_cost: float = Field(
        12.0, gt=0, le=64, description="how bent a chart of xatlas may get; for meshes that our own charts do not suit"
    )
    face: bool = Field(True, description="give the face 40 % of the texels under charts, where its landmarks are known")
    iterations: int = Field(1, ge=1, le=8, description="rounds in which xatlas grows charts from better seeds; slow")


def run(inputs: Inputs, config: Config, context: Context) -> UvMesh:
    """Decimate, cut, flatten, pack, measure. Raises StageError when the mesh can't be unwrapped."""
    from pipeline import footprint, meshes, tiles
    from pipeline.faces.landmarks3d import load_landmarks
    from stages.uv.build import build
    from stages.uv.unwrap import Options

    surface = inputs.surface
    dense = meshes.load(surface.path(surface.artifact.mesh))

    def step(done: int, total: int, message: str) -> None:
        context.check()
        context.progress(done, total, message)

    most, texel = config.tiles, None
    if most == "auto":
        fitted = set(inputs.inverse_rendering.artifact.fitted_views)
        texel = footprint.pixel(dense, (c for c in inputs.poses.artifact.cameras if c.index in fitted))
        most = 1 if texel is None else tiles.MOST
    options = Options(
        config.texture_size, config.padding, config.max_cost, config.iterations, most, texel, config.tile_size
    )
    ref = inputs.masks.artifact.landmarks
    landmarks = load_landmarks(inputs.masks.path(ref)) if ref is not None and config.face else None
    built = build(
        dense, config.target_faces, config.proxy_faces, options, step, even=config.remesh == "even", landmarks=landmarks
    )
    meshes.save(context.workdir / MESH, built.mesh, built.charts)
    meshes.save(context.workdir / PROXY, built.proxy)
    return UvMesh(
        mesh=context.file(MESH),
        proxy=context.file(PROXY),
        vertices=len(built.mesh.vertices),
        faces=len(built.mesh.faces),
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


STAGE = Stage(name="uv", version=7, inputs=Inputs, config=Config, output=UvMesh, run=run)
