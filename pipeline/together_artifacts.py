"""The manifest of two captures of one subject: where the second lies. As in pipeline/artifacts.py."""

from __future__ import annotations

from pipeline.artifacts import Artifact, Matrix
from pipeline.verdict import Finding


class Together(Artifact):
    """The second capture in the first one's asset coordinates.

    first_from_second: 4x4 similarity between their asset coordinates. source: where it comes from, as text. agreement:
    of the silhouettes of both captures' hulls, in [0, 1]. figures: further measurements, by name.
    """

    first_from_second: Matrix
    source: str
    agreement: float
    figures: dict[str, float] = {}
    warnings: tuple[str, ...] = ()
    findings: tuple[Finding, ...] = ()
