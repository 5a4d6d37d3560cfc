"""Growing arrays in memory-mapped files: large maps are limited by the disk, not by the memory."""

from __future__ import annotations

import tempfile
from collections.abc import Mapping
from pathlib import Path
from typing import Any

import numpy as np
import numpy.typing as npt

Array = npt.NDArray[Any]


class MemmapBuffer:
    """Named arrays to which rows are appended. Their files have no names and are removed when the process ends."""

    def __init__(self, folder: Path | None) -> None:
        self._folder = folder
        self._files: dict[str, Any] = {}
        self._kinds: dict[str, tuple[np.dtype[Any], tuple[int, ...]]] = {}
        self._rows: dict[str, int] = {}

    def append(self, rows: Mapping[str, Array]) -> None:
        """Append rows; each array keeps its name, type and width."""
        for name, values in rows.items():
            if name not in self._files:
                self._files[name] = tempfile.TemporaryFile(dir=self._folder)  # noqa: SIM115  (closed with the process)
                self._kinds[name], self._rows[name] = (values.dtype, values.shape[1:]), 0
            self._files[name].write(np.ascontiguousarray(values).data)
            self._rows[name] += len(values)

    def arrays(self) -> dict[str, Array]:
        """The arrays, mapped into memory."""
        out: dict[str, Array] = {}
        for name, file in self._files.items():
            kind, width = self._kinds[name]
            shape = (self._rows[name], *width)
            file.flush()
            out[name] = np.memmap(file, kind, "r", shape=shape) if np.prod(shape) else np.zeros(shape, kind)
        return out


def blank(folder: Path | None, shape: tuple[int, ...], kind: type[np.generic]) -> Array:
    """A writable array of zeros in a file without a name."""
    file = tempfile.TemporaryFile(dir=folder)  # noqa: SIM115
    file.truncate(int(np.prod(shape)) * np.dtype(kind).itemsize)
    return np.memmap(file, np.dtype(kind), "r+", shape=shape)
