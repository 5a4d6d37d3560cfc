"""One single wrong change of the product, and the tests that must notice it: an entry of the lists beside this file."""

from __future__ import annotations

from dataclasses import dataclass


@dataclass(frozen=True)
class Mutation:
    """A text that stands once in a file, what stands there instead, and the tests (files, or FILE::TEST) that fail."""

    file: str
    before: str
    after: str
    tests: str

    @property
    def change(self) -> str:
        """In one line."""
        return f"{self.file}: {' '.join(self.before.split())} -> {' '.join(self.after.split()) or 'nothing'}"
