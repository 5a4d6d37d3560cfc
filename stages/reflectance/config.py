"""Settings of the reflectance stage."""

from __future__ import annotations

import hashlib
from pathlib import Path
from typing import Annotated, Any

from pydantic import Field, model_validator

from pipeline.contract import StageConfig
from pipeline.units import ContentHash, Texels, Unit


class Config(StageConfig):
    """Settings of the reflectance stage; they matter for captures of a light stage only."""

    size: Texels = Field(512, ge=64, le=4096, description="width and height of the field's maps in texels")
    every: Annotated[int, Unit("lights")] = Field(
        7, ge=0, le=100, description="every how many lights one is left out of the fit and predicted instead; 0: none"
    )
    camera: int = Field(-1, ge=-1, description="number of a camera that is left out of the fit; -1: none")
    normal_prior: float = Field(
        0.02, ge=0, le=100, description="weight of the surface's normal against the one that the pictures say"
    )
    order: int = Field(3, ge=0, le=5, description="order of the harmonics for light by way of other skin; 3: 16 terms")
    paint: str = Field(
        "",
        description="folder of PNG files, white where the functions are replaced by those of the tissue around, in the "
        "field's texture coordinates",
        exclude=True,
    )
    paint_digest: ContentHash = Field(default="", description="sha256 of the masks in paint, set automatically")
    reshape: bool = Field(
        True,
        description="move the surface to where all cameras see the same answer to the lights, and to their normals",
    )
    motion: bool = Field(True, description="measure how the head moved, from the tracking pictures")

    @model_validator(mode="before")
    @classmethod
    def _fill_digest(cls, given: Any) -> Any:
        if not isinstance(given, dict) or not given.get("paint"):
            return given
        return given | {"paint_digest": digest(Path(str(given["paint"])))}


def digest(folder: Path) -> str:
    """sha256 of the names and bytes of a folder's painted masks; "" if there are none (paint.py then says so)."""
    total, found = hashlib.sha256(), mask_files(folder)
    for path in found:
        total.update(path.name.encode() + b"\0" + hashlib.sha256(path.read_bytes()).digest())
    return total.hexdigest() if found else ""


def mask_files(folder: Path) -> list[Path]:
    """The PNG files of a folder by name; none if there is no such folder."""
    if not folder.is_dir():
        return []
    return sorted(p for p in folder.iterdir() if p.suffix.lower() == ".png" and p.name[0] != ".")
