"""Reads small arrays from an npz file without trusting the sizes that it declares.

An npz is a zip of npy files. Each is read up to a limit, and its header is compared with the actual bytes before an
array is allocated: a file of a kilobyte can declare a terabyte. Sources: APPNOTE.TXT (zip), NEP 1 (npy).
"""

from __future__ import annotations

import io
import re
import zipfile
import zlib
from collections.abc import Iterator
from pathlib import Path
from tokenize import TokenError

import numpy as np

from pipeline.transforms import F64
from stages.capture.readers.described import description
from stages.capture.readers.values import fault, printable

MAX_ARRAY = 16_384  # bytes of one matrix with its header
HEADERS = {(1, 0): np.lib.format.read_array_header_1_0, (2, 0): np.lib.format.read_array_header_2_0}
BROKEN = (zipfile.BadZipFile, zlib.error, ValueError, OSError, EOFError, KeyError, NotImplementedError, RuntimeError,
          OverflowError, TypeError, SyntaxError, TokenError)  # fmt: skip


def arrays_of(path: Path, wanted: re.Pattern[str], remedy: str) -> Iterator[tuple[str, F64]]:
    """(name, array) of the small numeric arrays whose names match. Raises StageError if the file is damaged."""
    try:
        with zipfile.ZipFile(io.BytesIO(description(path))) as archive:
            for entry in archive.infolist():
                name = entry.filename.removesuffix(".npy")
                if wanted.fullmatch(name):
                    with archive.open(entry) as stream:
                        yield name, _array(stream.read(MAX_ARRAY + 1))
    except BROKEN as e:
        raise fault("the cameras' file can't be read", path.name, printable(str(e)), "an npz of arrays", remedy) from e


def _array(data: bytes) -> F64:
    if len(data) > MAX_ARRAY:
        raise ValueError(f"an array of more than {MAX_ARRAY} bytes")
    stream = io.BytesIO(data)
    version = np.lib.format.read_magic(stream)
    if version not in HEADERS:
        raise ValueError(f"an npy of version {version}")
    shape, by_columns, kind = HEADERS[version](stream)
    if kind.kind not in "fiu":
        raise ValueError(f"an array of {kind}, not of numbers")
    flat = np.frombuffer(data[stream.tell() :], kind)
    return np.array(flat.reshape(shape, order="F" if by_columns else "C"), np.float64)
