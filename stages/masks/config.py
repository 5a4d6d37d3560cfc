"""Settings of the masks stage."""

from __future__ import annotations

from pathlib import Path
from typing import Annotated, Any, Literal

from pydantic import Field, model_validator

from pipeline.artifacts import sha256_of
from pipeline.contract import StageConfig
from pipeline.errors import UsageError
from pipeline.units import ContentHash, Pixels, Share, Unit

Method = Literal["auto", "given", "plate", "key", "person", "object", "grabcut"]


class Config(StageConfig):
    """Settings of the masks stage."""

    method: Method = Field(
        "auto",
        description="given: the capture's masks; plate: its clean plates; key: uniform background; "
        "person: network for people; object: silhouette of the sparse points above a support plane; grabcut: colour "
        "models around the region of interest; auto: the first of these that works",
    )
    model: str = Field(
        "", description="your own segmentation network, an ONNX file; auto prefers it to the methods from key on"
    )
    model_sha256: ContentHash = Field("", description="sha256 of model, set automatically")
    model_side: Pixels = Field(320, ge=32, le=2048, description="edge of the square input of model")
    model_imagenet: bool = Field(
        False, description="normalise the input of model by ImageNet's mean and standard deviation"
    )
    threshold: Share = Field(
        0.5, gt=0, lt=1, description="smallest probability of a subject pixel in a network's output"
    )
    hull_cells: Annotated[int, Unit("voxels")] = Field(
        64,
        ge=16,
        le=256,
        description="voxels along each edge of the visual hull with which the masks are compared",
    )
    faces: bool = Field(True, description="label face and eyes, and with hair_model hair, in the photos that show them")
    hair_model: str = Field("", description="your own network that segments hair, an ONNX file; hair gets a label")
    hair_model_sha256: ContentHash = Field("", description="sha256 of hair_model, set automatically")
    hair_model_side: Pixels = Field(512, ge=32, le=2048, description="edge of the square input of hair_model")
    hair_model_imagenet: bool = Field(
        False, description="normalise the input of hair_model by ImageNet's mean and standard deviation"
    )
    hair_model_class: int = Field(
        -1, ge=-1, le=999, description="class of hair in the output of hair_model, counted from 0; -1: its only class"
    )
    resegment: bool = Field(True, description="segment a view again if its mask contradicts the other views")
    seed: int = Field(0, ge=0, le=2**31 - 1, description="seed of all random numbers")

    @model_validator(mode="before")
    @classmethod
    def _content(cls, given: Any) -> Any:
        if not isinstance(given, dict):
            return given
        return given | _named(given, "model") | _named(given, "hair_model")


def _named(given: dict[str, Any], setting: str) -> dict[str, str]:
    """A network's absolute path and hash; empty if none is given.

    Raises:
        UsageError: the file does not exist.
    """
    if not given.get(setting):
        return {}
    path = Path(str(given[setting])).expanduser()
    if not path.is_file():
        raise UsageError(
            "the network's file does not exist",
            where=f"masks.{setting}",
            value=given[setting],
            limit="an ONNX file",
            remedy="check the path",
        )
    return {setting: str(path.absolute()), f"{setting}_sha256": sha256_of(path)}
