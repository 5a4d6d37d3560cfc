"""`neuface` with the toy stages instead of the real ones, as a program that a test starts."""

from __future__ import annotations

import sys

import pipeline.threads  # noqa: F401
import stages.capture.scan
from stages import registry
from tests.support.toy_stages import TOYS, source

registry.REGISTRY, registry.FIT = TOYS, "third"
stages.capture.scan.scan_capture = source  # type: ignore[assignment]

if __name__ == "__main__":
    from workflows.cli.main import main

    sys.exit(main())
