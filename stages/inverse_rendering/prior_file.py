"""Hash of a prior's checkpoint. This module does not import torch, so that settings are checked quickly."""

from __future__ import annotations


def prior_digest(path: str) -> str:
    """sha256 of a prior's checkpoint; "" if the file does not exist (the loader then raises an error)."""
    from pipeline.fields.paper.imface_layout import digest

    return digest(path)
