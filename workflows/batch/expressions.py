"""Names of expressions in a tree of captures: which one is the neutral, and what a measured shape is called."""

from __future__ import annotations

import re

from pipeline.registration.shapes import PREFIX

# the folders of the FaceScape data set, as its README lists them
FACESCAPE = (
    "1_neutral", "2_smile", "3_mouth_stretch", "4_anger", "5_jaw_left", "6_jaw_right", "7_jaw_forward", "8_mouth_left",
    "9_mouth_right", "10_dimpler", "11_chin_raiser", "12_lip_puckerer", "13_lip_funneler", "14_sadness", "15_lip_roll",
    "16_grin", "17_cheek_blowing", "18_eye_closed", "19_brow_raiser", "20_brow_lower",
)  # fmt: skip


def expression_name(folder: str) -> str:
    """FaceScape's name without its number, where the folder bears one ("2_smile": smile); else the folder's own."""
    return folder.partition("_")[2] if folder in FACESCAPE else folder


def shape_name(folder: str) -> str:
    """The blend shape of an expression: measured_smile. What USD does not take in a name becomes an underscore."""
    return PREFIX + re.sub(r"[^A-Za-z0-9_]", "_", expression_name(folder))


def is_called(folder: str, wanted: str) -> bool:
    """Whether an expression's folder is the wanted one: by its number ("1"), its whole name, or FaceScape's name."""
    if wanted.isdecimal():
        number = re.match(r"\d+", folder)
        return number is not None and int(number[0]) == int(wanted)
    return wanted in (folder, expression_name(folder))
