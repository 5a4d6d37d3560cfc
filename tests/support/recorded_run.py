"""What a real run of the demo (16 photos of 160 px) told, to the end of its fit, on two cores that other work shared.

Of the progress, the first event of each part and one every few seconds are kept.
"""

from __future__ import annotations

from typing import NamedTuple


class Event(NamedTuple):
    """time: s since the run began. what: started, progress or finished. done of total, message: as a stage tells."""

    time: float
    what: str
    stage: str
    done: int = 0
    total: int = 0
    message: str = ""


# Seconds that each stage took.
TAKEN: dict[str, float] = {
    "capture": 15.3,
    "poses": 56.2,
    "masks": 54.8,
    "inverse_rendering": 1745.1,
}

RECORDED: tuple[Event, ...] = (
    Event(0.0, "started", "capture"),
    Event(1.5, "progress", "capture", 0, 16, "checking 0.png"),
    Event(5.8, "progress", "capture", 6, 16, "checking 6.png"),
    Event(10.1, "progress", "capture", 11, 16, "checking 11.png"),
    Event(15.3, "finished", "capture"),
    Event(15.3, "started", "poses"),
    Event(20.0, "progress", "poses", 0, 16, "detecting features"),
    Event(22.8, "progress", "poses", 0, 39, "checking the cameras"),
    Event(26.8, "progress", "poses", 24, 39, "checking the cameras"),
    Event(71.5, "finished", "poses"),
    Event(71.5, "started", "masks"),
    Event(75.3, "progress", "masks", 1, 16, "masking"),
    Event(113.4, "progress", "masks", 1, 16, "checking masks"),
    Event(114.7, "progress", "masks", 1, 16, "detecting faces"),
    Event(126.3, "finished", "masks"),
    Event(126.5, "started", "inverse_rendering"),
    Event(147.7, "progress", "inverse_rendering", 0, 1300, "reading photos"),
    Event(147.9, "progress", "inverse_rendering", 0, 1300, "visual hull"),
    Event(177.7, "progress", "inverse_rendering", 0, 1300, "initial geometry"),
    Event(676.4, "progress", "inverse_rendering", 1, 1300, "fitting"),
    Event(717.0, "progress", "inverse_rendering", 46, 1300, "fitting"),
    Event(757.8, "progress", "inverse_rendering", 115, 1300, "fitting"),
    Event(797.9, "progress", "inverse_rendering", 395, 1300, "fitting"),
    Event(838.0, "progress", "inverse_rendering", 504, 1300, "fitting"),
    Event(878.0, "progress", "inverse_rendering", 613, 1300, "fitting"),
    Event(921.7, "progress", "inverse_rendering", 651, 1300, "fitting"),
    Event(962.0, "progress", "inverse_rendering", 740, 1300, "fitting"),
    Event(1002.1, "progress", "inverse_rendering", 776, 1300, "fitting"),
    Event(1042.7, "progress", "inverse_rendering", 818, 1300, "fitting"),
    Event(1082.7, "progress", "inverse_rendering", 879, 1300, "fitting"),
    Event(1122.7, "progress", "inverse_rendering", 904, 1300, "fitting"),
    Event(1222.7, "progress", "inverse_rendering", 911, 1300, "fitting"),
    Event(1264.1, "progress", "inverse_rendering", 935, 1300, "fitting"),
    Event(1304.2, "progress", "inverse_rendering", 964, 1300, "fitting"),
    Event(1344.6, "progress", "inverse_rendering", 1002, 1300, "fitting"),
    Event(1384.7, "progress", "inverse_rendering", 1027, 1300, "fitting"),
    Event(1427.3, "progress", "inverse_rendering", 1043, 1300, "fitting"),
    Event(1468.6, "progress", "inverse_rendering", 1085, 1300, "fitting"),
    Event(1510.9, "progress", "inverse_rendering", 1105, 1300, "fitting"),
    Event(1553.8, "progress", "inverse_rendering", 1113, 1300, "fitting"),
    Event(1597.9, "progress", "inverse_rendering", 1120, 1300, "fitting"),
    Event(1640.4, "progress", "inverse_rendering", 1131, 1300, "fitting"),
    Event(1680.8, "progress", "inverse_rendering", 1233, 1300, "fitting"),
    Event(1723.8, "progress", "inverse_rendering", 1278, 1300, "fitting"),
    Event(1764.4, "progress", "inverse_rendering", 1287, 1300, "fitting"),
    Event(1804.7, "progress", "inverse_rendering", 1297, 1300, "fitting"),
    Event(1844.7, "progress", "inverse_rendering", 0, 3, "held-out views"),
    Event(1871.6, "finished", "inverse_rendering"),
)
