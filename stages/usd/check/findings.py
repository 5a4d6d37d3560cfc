"""The result of a check."""

from __future__ import annotations

from dataclasses import asdict, dataclass
from typing import Literal

Level = Literal["error", "warning", "info"]


@dataclass(frozen=True, slots=True)
class Finding:
    """One result. `check`: short name of the rule. `where`: prim, attribute or file."""

    level: Level
    check: str
    message: str
    where: str = ""

    def json(self) -> dict[str, str]:
        """The finding as plain values for JSON."""
        return asdict(self)

    def __str__(self) -> str:
        return f"{self.level}: {self.check}: {self.message}" + (f" ({self.where})" if self.where else "")
