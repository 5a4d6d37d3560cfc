"""Settings of the uv stage."""

from __future__ import annotations

from typing import Annotated, Literal

from pydantic import Field

from pipeline.contract import StageConfig
from pipeline.units import Texels, Triangles


class Config(StageConfig):
    """Settings of the uv stage."""

    mesh: Literal["auto", "scan", "template", "both"] = Field(
        "auto",
        description="what the asset is made of: the decimated scan, or the registered template (its topology and "
        "texture layout; the scan where the template does not hold); auto: the template on people whose registration "
        "has no fault, else the scan; both: the template, and the scan as a variant with maps of its own",
    )
    rest: bool = Field(
        True,
        description="made from the template: add hair, and what the scan shows beside it (clothes, shoulders), as "
        "meshes on tiles of their own",
    )
    target_faces: Triangles = Field(50_000, ge=200, le=2_000_000, description="triangles of the textured mesh")
    remesh: Literal["adaptive", "uniform", "quads"] = Field(
        "adaptive",
        description="adaptive: fewer triangles where it is flat; uniform: equal triangles, for sculpting; quads: equal "
        "quads, half as many as uv.target_faces, for subdivision and animation",
    )
    proxy_faces: Triangles = Field(
        5_000, ge=100, le=200_000, description="triangles of the proxy, a coarse mesh for display"
    )
    tiles: Annotated[int, Field(ge=1, le=10)] | Literal["auto"] = Field(
        1, description="number of UDIM tiles; auto: enough for texels as fine as the photos' pixels"
    )
    tile_size: Texels = Field(
        1024, ge=256, le=16384, description="side of a tile that tiles=auto assumes; default: bake.size"
    )
    texture_size: Texels = Field(1024, ge=256, le=8192, description="texture size to which uv.padding refers")
    padding: Texels = Field(4, ge=1, le=64, description="distance between two charts, in texels of texture_size")
    max_cost: float = Field(
        12.0,
        gt=0,
        le=64,
        description="largest cost of a chart in xatlas, the fallback for meshes that need many charts",
    )
    face: bool = Field(True, description="give the face 40 % of the used texels, if its landmarks are known")
