"""FaceScape's published `Rt_scale_dict.json`: from each capture's own world to the millimetres and axes of its models.

    x_mm = R (s x_world) + t,    [s, (R | t)] = dictionary[ID][EXP]

R turns the world upright with the face along +Z. The file belongs to a tree ID/EXP/params.json and lies in its root, or
nearer to the photos. EXP is the number that the folder's name begins with (`1_neutral`).
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
MIN_SCALE = 1e-9  # millimetres in a unit of the capture's world, or the other way round
REMEDY = "copy the file again, or take it out of the tree to have the unit recognised"


def metres_from_world(folder: Path) -> F64 | None:
    """(4, 4) similarity for the capture in `folder`, or None if no dictionary names it.

    Raises StageError if what it says of this capture is no similarity.
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
