"""Whether a capture's subject is a person."""

from __future__ import annotations

from pipeline.artifacts import MaskSet

FACES = 3  # number of photos with a face from which the subject is a person: a single one may be a false detection


def shows_person(masks: MaskSet) -> bool:
    """Whether a face was found in several photos."""
    return sum("face" in m.labelled for m in masks.masks) >= FACES
