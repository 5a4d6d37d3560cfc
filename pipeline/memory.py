"""Gives memory that nothing uses any more back to the system.

The C library keeps what is freed for later requests: 600 MB after a fit of the scanned head. Large arrays of the next
stage are mapped beside them.
"""

from __future__ import annotations

import ctypes
import gc


def give_back() -> None:
    """Collect what is unreachable, and return free pages; where the C library is not glibc, only the former. Takes
    a fifth of a second."""
    gc.collect()
    try:
        trim = ctypes.CDLL(None).malloc_trim
    except (AttributeError, OSError, TypeError):
        return
    trim(0)
