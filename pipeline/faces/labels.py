"""Codes of the labels in photos and maps, and their names by code."""

from __future__ import annotations

LABELS = ("background", "subject", "face", "eyes", "hair")
SUBJECT, FACE, EYES, HAIR = 1, 2, 3, 4
