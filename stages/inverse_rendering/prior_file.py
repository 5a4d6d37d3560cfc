"""The checkpoint of a prior, as settings name it. Importing this is light: settings are checked without torch."""

from __future__ import annotations


def prior_digest(path: str) -> str:
    """sha256 of a prior's checkpoint, or "" where there is no such file (the loader then says so)."""
    from pipeline.fields.paper.imface_layout import digest

    return digest(path)
