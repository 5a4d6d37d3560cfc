"""Settings of the usd stage."""

from __future__ import annotations

from pathlib import Path
from typing import Any

from pydantic import Field, field_validator, model_validator

from pipeline.artifacts import sha256_of
from pipeline.contract import StageConfig
from pipeline.errors import UsageError
from pipeline.units import ContentHash, Millimetres, Pixels, Triangles
from stages.usd.colour_spaces import SRGB, check_space
from stages.usd.naming import check_name
from stages.usd.texture_names import DEFAULT, check_pattern


class Config(StageConfig):
    """Settings of the usd stage."""

    name: str = Field("head", description="name of the asset: of its prim and file, and prefix of its textures")
    asset_version: str = Field("1.0.0", description="assetInfo:version of the component")
    author: str = Field("", max_length=1000, description="who made the capture; recorded in the asset")
    license: str = Field("", max_length=1000, description="licence of the capture; recorded in the asset")
    subject_consent: str = Field("", max_length=1000, description="what the subject agreed to; recorded in the asset")
    usdz: bool = Field(True, description="also write a preview package NAME.usdz")
    glb: bool = Field(True, description="also write NAME.glb")
    obj: bool = Field(True, description="also write NAME.obj and NAME.mtl")
    expressions: bool = Field(
        True,
        description="write the template's expressions (blend shapes, morph targets) and the joints of jaw and eyes, "
        "where the mesh is the template's",
    )
    measured: str = Field(
        "",
        description="npz file of measured expressions of this head, written beside the template's; neuface batch "
        "--neutral makes it and sets this",
        exclude=True,
    )
    measured_digest: ContentHash = Field("", description="sha256 of the file in measured, set automatically")
    divide_shadows: bool = Field(
        True, description="divide the shadows and interreflections of the captured light out of the albedo"
    )
    acescg: bool = Field(False, description="also write NAME_albedo_acescg.exr, the albedo in ACEScg")
    subsurface: bool = Field(
        False,
        description="also write look=subsurface, OpenPBR skin that scatters light below its surface with a person's "
        "measured free paths; needs a metric scale",
    )
    displacement_bands: Millimetres = Field(
        5.0, ge=0.5, le=100, description="wavelength between the low and the high band of the displacement"
    )
    texture_name: str = Field(
        DEFAULT,
        description="names of the files in textures/, of the words {asset}, {map} and {udim}; with one tile {udim} and "
        "the separator before it are left out",
    )
    colour_space: str = Field(
        SRGB,
        description="base colour that MaterialX networks read: srgb_texture (8-bit PNG), lin_rec709 or acescg (EXR of "
        "16-bit floats); UsdPreviewSurface always reads the PNG",
    )
    proxy: bool = Field(True, description="write the coarse mesh as geo/proxy")
    high: bool = Field(True, description="write the dense mesh as high.usdc, for the variant lod=high")
    high_faces: Triangles = Field(
        2_000_000, ge=50_000, description="most triangles of the dense mesh there; a finer one is decimated"
    )
    environment_width: Pixels = Field(1024, ge=64, le=8192, multiple_of=2, description="width of environment.exr")
    render_views: bool = Field(True, description="render the held-out views from the exported files")
    samples: int = Field(
        0, ge=0, le=8, description="rays along each side of a pixel in these renders; 0: one ray, 64 on silhouettes"
    )
    preview_size: Pixels = Field(512, ge=64, le=4096, description="side of the preview pictures and films")
    film_frames: int = Field(
        16, ge=0, le=240, description="pictures of each film in the report, a turn of 4 s in two lights; 0: no films"
    )

    def made_from(self) -> dict[str, Path]:
        """The artifact of the measured expressions."""
        return {"measured": Path(self.measured).parent} if self.measured else {}

    @model_validator(mode="before")
    @classmethod
    def _fill_digest(cls, given: Any) -> Any:
        if not isinstance(given, dict) or not given.get("measured"):
            return given
        return given | {"measured_digest": _digest(Path(str(given["measured"])))}

    @field_validator("name")
    @classmethod
    def _valid(cls, name: str) -> str:
        return check_name(name)  # a UsageError of its own, before the first stage

    @field_validator("texture_name")
    @classmethod
    def _valid_pattern(cls, pattern: str) -> str:
        return check_pattern(pattern)

    @field_validator("colour_space")
    @classmethod
    def _valid_space(cls, space: str) -> str:
        return check_space(space)


def _digest(path: Path) -> str:
    try:
        return sha256_of(path)
    except OSError as e:
        raise UsageError(
            "there is no such file of measured expressions",
            where="usd.measured",
            value=f"{path}: {e.strerror}",
            limit="a file that neuface batch --neutral wrote",
            remedy="run neuface batch --neutral again, or leave usd.measured out",
        ) from e
