"""Types of settings with a unit; `neuface settings` and docs/settings.md show the unit."""

from __future__ import annotations

from dataclasses import dataclass
from typing import Annotated


@dataclass(frozen=True, slots=True)
class Unit:
    """The unit of a setting's number, as shown to users."""

    name: str


@dataclass(frozen=True, slots=True)
class FilledIn:
    """Marks a field that the stage fills in itself, so that it enters the key, for example the hash of a file. It is
    not a setting: it is not listed, and --set rejects it."""


Pixels = Annotated[int, Unit("pixels")]
Texels = Annotated[int, Unit("texels")]
Triangles = Annotated[int, Unit("triangles")]
Cells = Annotated[int, Unit("grid cells")]
Rays = Annotated[int, Unit("rays")]
Steps = Annotated[int, Unit("steps")]
Views = Annotated[int, Unit("photos")]
Seconds = Annotated[float, Unit("seconds")]
Metres = Annotated[float, Unit("metres")]
Millimetres = Annotated[float, Unit("millimetres")]
Share = Annotated[float, Unit("share")]
ContentHash = Annotated[str, FilledIn()]
