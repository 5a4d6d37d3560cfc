"""Settings of the template stage."""

from __future__ import annotations

import hashlib
from pathlib import Path
from typing import Any

from pydantic import Field, model_validator

from pipeline.contract import StageConfig
from pipeline.units import ContentHash


class Config(StageConfig):
    """Settings of the template stage."""

    enabled: bool = Field(False, description="register the head template; default: unless uv.mesh=scan")
    faultless: bool = Field(
        False,
        description="register only where nothing is wrong with the result: every check good, eyes fitted or closed, "
        "no object, no light stage, photos that show the irises; default: with uv.mesh=auto",
    )
    levels: int = Field(2, ge=1, le=3, description="subdivisions of the registered head's quads")
    require: bool = Field(False, description="fail if the template does not fit the head, or the capture shows no face")
    hair: bool = Field(True, description="tell hair apart and keep it as a mesh of its own; off: the skin follows it")
    folder: str = Field(
        "", description="folder of another template (docs/template.md); default: the project's own", exclude=True
    )
    folder_digest: ContentHash = Field("", description="sha256 of the files in folder, set automatically")

    @model_validator(mode="before")
    @classmethod
    def _fill_digest(cls, given: Any) -> Any:
        if not isinstance(given, dict) or not given.get("folder"):
            return given
        return given | {"folder_digest": folder_digest(Path(str(given["folder"])))}


def folder_digest(folder: Path) -> str:
    """sha256 of the names and bytes of a template's files; "" if there is no folder (the loader then says so)."""
    if not folder.is_dir():
        return ""
    total = hashlib.sha256()
    for path in sorted(p for p in folder.iterdir() if p.is_file()):
        total.update(path.name.encode() + b"\0" + hashlib.sha256(path.read_bytes()).digest())
    return total.hexdigest()
