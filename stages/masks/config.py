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
        description="given: the capture's masks; plate: its clean plates; key: uniform background; person: learned "
        "segmentation of people; object: what the sparse points show to stand on a support; grabcut: colour statistics "
        "around the region of interest; auto: the first of these that works",
    )
    model: str = Field("", description="a segmentation network of your own, an ONNX file: used where auto would guess")
    model_sha256: ContentHash = Field("", description="sha256 of model: another content is another result")
    model_side: Pixels = Field(320, ge=32, le=2048, description="edge of the square input of model")
    model_imagenet: bool = Field(
        False, description="normalise the input of model as networks trained on ImageNet expect"
    )
    threshold: Share = Field(0.5, gt=0, lt=1, description="probability from which a pixel counts as a person")
    hull_cells: Annotated[int, Unit("voxels")] = Field(
        64,
        ge=16,
        le=256,
        description="voxels along each edge of the grid in which the masks are held against each other",
    )
    faces: bool = Field(True, description="label face and eyes in the photos that show them, and hair (hair_model)")
    hair_model: str = Field("", description="a network of your own that knows hair, an ONNX file: hair gets a label")
    hair_model_sha256: ContentHash = Field("", description="sha256 of hair_model: another content is another result")
    hair_model_side: Pixels = Field(512, ge=32, le=2048, description="edge of the square input of hair_model")
    hair_model_imagenet: bool = Field(
        False, description="normalise the input of hair_model as networks trained on ImageNet expect"
    )
    hair_model_class: int = Field(
        -1, ge=-1, le=999, description="which class of hair_model is hair, counted from 0; -1: it knows nothing else"
    )
    resegment: bool = Field(True, description="segment again where the other views contradict it")
    seed: int = Field(0, ge=0, le=2**31 - 1, description="seed of every random choice")

    @model_validator(mode="before")
    @classmethod
    def _content(cls, given: Any) -> Any:
        if not isinstance(given, dict):
            return given
        return given | _named(given, "model") | _named(given, "hair_model")


def _named(given: dict[str, Any], setting: str) -> dict[str, str]:
    """A network's file with its absolute path and content; nothing where none is given.

    Raises:
        UsageError: it is not there.
    """
    if not given.get(setting):
        return {}
    path = Path(str(given[setting])).expanduser()
    if not path.is_file():
        raise UsageError(
            "the network's file is not there",
            where=f"masks.{setting}",
            value=given[setting],
            limit="an ONNX file",
            remedy="check the path",
        )
    return {setting: str(path.absolute()), f"{setting}_sha256": sha256_of(path)}
