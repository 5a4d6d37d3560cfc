"""The check of two captures: do they show one subject in one pose?

Source of the limits: see docs/stages/together.md, Limits.
"""

from __future__ import annotations

from pipeline.errors import StageError
from pipeline.verdict import Finding, Limits, judged
from stages.together.place import Placed

AGREEMENT = Limits(0.97, 0.93)
LANDMARKS = Limits(0.02, 0.04, lower=False)  # of the face's length
REMEDY = (
    "name a second capture of the same subject, in the same pose and with the same expression and hair; if it is that, "
    "check the masks and cameras of both captures in their own reports"
)


def refuse(found: Placed, least: float) -> None:
    """Raises StageError where two captures can't be fitted together. least: agreement of their silhouettes."""
    if found.agreement < least:
        raise StageError(
            "the two captures do not show the same subject in the same pose",
            where="--also",
            value=f"their silhouettes agree in {found.agreement:.3f} ({found.source})",
            limit=f"at least {least:g}",
            remedy=f"{REMEDY}; together.least_agreement lowers the limit",
        )
    if found.landmarks is not None and found.landmarks > LANDMARKS.usable:
        raise StageError(
            "the two captures show different faces or expressions",
            where="--also",
            value=f"the landmarks of the faces are {found.landmarks:.3f} of the face's length apart in the median",
            limit=f"at most {LANDMARKS.usable:g}",
            remedy=REMEDY,
        )


def findings(found: Placed) -> tuple[Finding, ...]:
    """The findings of two captures that are fitted together."""
    said = f"the silhouettes of the two captures agree in {found.agreement:.3f} ({found.source})"
    out = [judged("captures_agree", found.agreement, AGREEMENT, said, REMEDY)]
    if found.landmarks is not None:
        said = f"the landmarks of the two captures' faces are {found.landmarks:.3f} of the face's length apart"
        out.append(judged("faces_agree", found.landmarks, LANDMARKS, said, REMEDY))
    return tuple(out)
