"""Colour spaces of the base colour in MaterialX networks, by the names of OCIO's ACES configurations that MaterialX
knows too, and the file that has each."""

from __future__ import annotations

from pipeline.errors import UsageError

SRGB, DATA, LINEAR, ACESCG = "srgb_texture", "raw", "lin_rec709", "acescg"
FILES = {SRGB: ("albedo", "png"), LINEAR: ("albedo", "exr"), ACESCG: ("albedo_acescg", "exr")}


def check_space(name: str) -> str:
    """Return the name, or raise UsageError if there is no such colour space."""
    if name in FILES:
        return name
    raise UsageError(
        "there is no colour space of this name",
        where="usd.colour_space",
        value=repr(name),
        limit=", ".join(FILES),
        remedy=f"use {SRGB} (8-bit PNG), {LINEAR} or {ACESCG} (EXR of 16-bit floats)",
    )
