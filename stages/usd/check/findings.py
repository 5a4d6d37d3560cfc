"""What a check found."""

from __future__ import annotations

from dataclasses import asdict, dataclass
from typing import Literal

Level = Literal["error", "warning", "info"]


@dataclass(frozen=True, slots=True)
class Finding:
    """`check`: the rule's short name. `where`: prim, attribute or file."""

    level: Level
    check: str
    message: str
    where: str = ""

    def json(self) -> dict[str, str]:
        """As plain values for JSON."""
        return asdict(self)

    def __str__(self) -> str:
        return f"{self.level}: {self.check}: {self.message}" + (f" ({self.where})" if self.where else "")
