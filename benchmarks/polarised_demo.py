"""The demo's head in polarised pairs, as a capture: what they bring to albedo, F0 and roughness.

    python -m benchmarks.polarised_demo FOLDER [VIEWS SIZE]

Head, skin, light and cameras are those of `neuface demo`; FOLDER has the cross-polarised photos, FOLDER/parallel the
others. Then

    neuface run FOLDER --out OUT --holdout every:5:2 --keep-all
    python -m benchmarks.material OUT FOLDER
"""

from __future__ import annotations

import sys
from pathlib import Path

VIEWS, SIZE = 40, 384  # as `neuface demo`


def main() -> None:
    """See the module."""
    from pipeline.demo.capture import write_demo_capture

    views, size = (int(a) for a in sys.argv[2:4]) if len(sys.argv) > 3 else (VIEWS, SIZE)
    write_demo_capture(Path(sys.argv[1]), views=views, size=size, polarised=True)


if __name__ == "__main__":
    main()
