"""masks: photos and cameras in, one soft mask per registered view out, checked against each other in space."""

from __future__ import annotations

from dataclasses import dataclass
from pathlib import Path
from typing import Any, Literal

from pydantic import Field, model_validator

from pipeline.artifacts import CameraSet, Capture, Located, MaskSet, sha256_of
from pipeline.contract import Context, Stage, StageConfig
from pipeline.errors import UsageError


@dataclass(frozen=True, slots=True)
class Inputs:
    """The checked photos and their cameras."""

    capture: Located[Capture]
    poses: Located[CameraSet]


class Config(StageConfig):
    """Settings of the masks stage."""

    method: Literal["auto", "given", "plate", "key", "person", "object", "grabcut"] = Field(
        "auto",
        description="given: the capture's masks; plate: its clean plates; key: uniform background; person: learned "
        "segmentation of people; object: what the sparse points show to stand on a support; grabcut: colour statistics "
        "around the region of interest; auto: the first of these that works",
    )
    model: str = Field("", description="a segmentation network of your own, an ONNX file: used where auto would guess")
    model_sha256: str = Field("", description="of that file; filled in, so that another content is another result")
    model_side: int = Field(320, ge=32, le=2048, description="edge of the network's square input")
    model_imagenet: bool = Field(False, description="normalise its input as ImageNet's networks expect")
    threshold: float = Field(0.5, gt=0, lt=1, description="probability from which a pixel counts as a person")
    working_size: int = Field(640, ge=128, le=2048, description="longest edge at which people and objects are cut out")
    hull_cells: int = Field(64, ge=16, le=256, description="voxels along each edge of the consistency check")
    min_agreement: float = Field(
        0.8, ge=0, le=1, description="least IoU of a mask and the hull of all masks, in the region of interest"
    )
    max_deviation: float = Field(
        0.05, gt=0, le=1, description="IoU below the median from which a mask may be an outlier"
    )
    faces: bool = Field(True, description="label face and eyes in the photos that show them, and hair (hair_model)")
    hair_model: str = Field("", description="a network of your own that knows hair, an ONNX file: hair gets a label")
    hair_model_sha256: str = Field("", description="of that file; filled in, so that another content is another result")
    hair_model_side: int = Field(512, ge=32, le=2048, description="edge of that network's square input")
    hair_model_imagenet: bool = Field(False, description="normalise its input as ImageNet's networks expect")
    hair_model_class: int = Field(
        -1, ge=-1, le=999, description="which of its classes is hair, from 0; -1: it knows nothing else"
    )
    mend: bool = Field(True, description="cut a computed mask out anew where the other views contradict it")
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


def run(inputs: Inputs, config: Config, context: Context) -> MaskSet:
    """Masks of all registered views.

    Raises:
        StageError: a mask that is missing or of the wrong size; no uniform background where one was asked for; too few
            views left that agree.
    """
    from stages.masks.segment import Settings, segment
    from stages.masks.user_model import UserModel

    settings = Settings(
        method=config.method,
        threshold=config.threshold,
        working_size=config.working_size,
        hull_cells=config.hull_cells,
        min_agreement=config.min_agreement,
        max_deviation=config.max_deviation,
        mend=config.mend,
        seed=config.seed,
        faces=config.faces,
        model=UserModel(Path(config.model), config.model_side, config.model_imagenet) if config.model else None,
        hair=UserModel(
            Path(config.hair_model),
            config.hair_model_side,
            config.hair_model_imagenet,
            config.hair_model_class if config.hair_model_class >= 0 else None,
            "masks.hair_model",
        )
        if config.hair_model
        else None,
    )
    return segment(inputs.capture, inputs.poses, settings, context)


STAGE = Stage(name="masks", version=9, inputs=Inputs, config=Config, output=MaskSet, run=run)
