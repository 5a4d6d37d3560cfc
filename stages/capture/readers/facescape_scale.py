"""FaceScape's published `Rt_scale_dict.json`: from each capture's world to the millimetres and axes of its models.

    x_mm = R (s x_world) + t,    [s, (R | t)] = dictionary[ID][EXP]

R rotates the world upright with the face along +Z. The file belongs to a tree ID/EXP/params.json and is in its root, or
in a folder nearer to the photos. EXP is the number at the beginning of the folder's name (`1_neutral`).
"""

from __future__ import annotations

import re
from pathlib import Path

import numpy as np

from pipeline.transforms import F64, rigid, similarity
from stages.capture.readers.cameras import checked_pose
from stages.capture.readers.described import read_json
from stages.capture.readers.values import fault, number, shown, table

NAME = "Rt_scale_dict.json"
MIN_SCALE = 1e-9  # smallest s, millimetres per unit of the world; the largest is 1 / MIN_SCALE
REMEDY = "copy the file again, or remove it from the folders; then the unit is estimated"


def metres_from_world(folder: Path) -> F64 | None:
    """(4, 4) similarity to metres for the capture in `folder`; None without a dictionary that lists it.

    Raises StageError if its entry is no similarity.
    """
    path = next((p / NAME for p in (folder, folder.parent, folder.parent.parent) if (p / NAME).is_file()), None)
    expression = re.match(r"\d+", folder.name)
    if path is None or expression is None:
        return None
    dictionary = read_json(path, "FaceScape's scale dictionary can't be read", REMEDY)
    person = dictionary.get(folder.parent.name, {}) if isinstance(dictionary, dict) else {}
    found = person.get(expression[0]) if isinstance(person, dict) else None
    if found is None:
        return None
    where = f"{NAME}, {folder.parent.name}, {expression[0]}"
    if not isinstance(found, list) or len(found) < 2:
        raise fault("an entry of the scale dictionary is not understood", where, shown(found),
                    "a number, and a 3 x 4 matrix", REMEDY)  # fmt: skip
    scale, pose = number(found[0], where, REMEDY), checked_pose(table(found[1], where, REMEDY), where)
    if not MIN_SCALE <= scale <= 1 / MIN_SCALE:
        raise fault("an entry of the scale dictionary has no scale", where, scale,
                    f"{MIN_SCALE:g} to {1 / MIN_SCALE:g}", REMEDY)  # fmt: skip
    return (
        similarity(1e-3, np.eye(3), np.zeros(3))
        @ rigid(pose[:3, :3], pose[:3, 3])
        @ similarity(scale, np.eye(3), np.zeros(3))
    )
