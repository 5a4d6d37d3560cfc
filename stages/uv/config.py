"""Settings of the uv stage."""

from __future__ import annotations

from typing import Annotated, Literal

from pydantic import Field

from pipeline.contract import StageConfig
from pipeline.units import Texels, Triangles


class Config(StageConfig):
    """Size of the meshes and how they are cut into charts."""

    target_faces: Triangles = Field(50_000, ge=200, le=2_000_000, description="size of the mesh that is textured")
    remesh: Literal["adaptive", "uniform"] = Field(
        "adaptive",
        description="adaptive: few triangles where it is flat; uniform: one size and shape, for sculpting and quads",
    )
    proxy_faces: Triangles = Field(5_000, ge=100, le=200_000, description="size of the coarse stand-in (proxy)")
    tiles: Annotated[int, Field(ge=1, le=10)] | Literal["auto"] = Field(
        1, description="UDIM tiles to fill; auto: as many as it takes for texels no coarser than the photos' pixels"
    )
    tile_size: Texels = Field(
        1024, ge=256, le=16384, description="side of a tile that tiles=auto counts on; bake.size if not set"
    )
    texture_size: Texels = Field(1024, ge=256, le=8192, description="texture that the padding is measured in")
    padding: Texels = Field(4, ge=1, le=64, description="distance between two charts, in texels of texture_size")
    max_cost: float = Field(
        12.0, gt=0, le=64, description="how bent a chart of xatlas may get; for meshes that our own charts do not suit"
    )
    face: bool = Field(True, description="give the face 40 % of the texels under charts, where its landmarks are known")
