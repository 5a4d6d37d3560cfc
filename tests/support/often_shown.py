"""`neuface` with its real stages, which shows pictures of the fit several times a second: a test does not wait for ten.

python -m tests.support.often_shown run CAPTURE --out DIR
"""

from __future__ import annotations

import sys

import pipeline.threads  # noqa: F401
from workflows.live import publisher

publisher.PREVIEW_EVERY, publisher.PREVIEW_SHARE, publisher.EVERY = 0.1, 1.0, 0.1

if __name__ == "__main__":
    from workflows.cli.main import main

    sys.exit(main())
