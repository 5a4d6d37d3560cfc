"""The demo's head with another skin tone, as a capture: whether the level of the albedo follows the tone.

    python -m benchmarks.skin_tones FOLDER MELANIN

MELANIN is added to the pigment of the demo's skin (pipeline/demo/skin.py): 2.4 dark brown, 1.2 brown, 0 the demo, -0.35
very light. Everything else, the light above all, is the demo's. Then

    neuface run FOLDER --out OUT --holdout every:5:2 --keep-all
    python -m benchmarks.material OUT FOLDER --melanin MELANIN
"""

from __future__ import annotations

import sys
from collections.abc import Iterator
from contextlib import contextmanager
from pathlib import Path
from types import ModuleType

import numpy as np

from pipeline.demo import skin

VIEWS, SIZE = 40, 384  # as `neuface demo`


@contextmanager
def toned(melanin: float) -> Iterator[ModuleType]:
    """The demo's skin with more pigment."""
    before = skin.BASE
    skin.BASE = before * np.exp(-melanin * skin.MELANIN)
    try:
        yield skin
    finally:
        skin.BASE = before


def main() -> None:
    """See the module."""
    from pipeline.demo.capture import write_demo_capture

    with toned(float(sys.argv[2])):
        write_demo_capture(Path(sys.argv[1]), views=VIEWS, size=SIZE)


if __name__ == "__main__":
    main()
