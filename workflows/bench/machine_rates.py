"""What a machine can do: rates of the few kinds of work of which all stages consist.

Each rate is the median of REPEATS measurements, in a few seconds together. What is the processor's work is measured in
processor time and told for all cores, so that other programs hardly matter; memory and disk are measured by the clock,
and other programs take their share of them.
"""

from __future__ import annotations

import hashlib
import os
import statistics
import tempfile
import time
from collections.abc import Callable
from concurrent.futures import ThreadPoolExecutor
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np
import numpy.typing as npt

from pipeline.errors import stage_error_from_os_error

F32 = npt.NDArray[np.float32]
REPEATS = 5
MATRIX = 1536  # side of the square matrices
COPIED = 1 << 28  # bytes of a copy: several times the largest cache
FILE = 1 << 27  # bytes written to disk
PICTURE = 1024  # side of the pictures
TASKS, SAMPLES = 64, 150_000  # of the loop of look-ups
ROW, ROUNDS = 2048, 100  # of the one that vectorises
RAYS = 200_000
BALL = 200  # rows of the mesh of the ball: 2 BALL^2 triangles


@dataclass(frozen=True, slots=True)
class Rates:
    """All cores together, a second. matrix: float32 operations of matrix products; scalar: those of a compiled loop of
    bilinear samples, of which only the arithmetic is counted; memory: bytes of a copy, those read and those written;
    read, write: bytes of the disk; hashed: bytes by SHA-256; jpeg, png, exr: pixels of three channels decoded;
    png_written, exr_written: those compressed and written; rays: of Embree against 80,000 triangles."""

    matrix: float
    scalar: float
    vector: float
    memory: float
    read: float
    write: float
    hashed: float
    jpeg: float
    png: float
    exr: float
    png_written: float
    exr_written: float
    rays: float


def measured(folder: Path) -> Rates:
    """The rates of this machine; read and write: of the disk of `folder`.

    Raises:
        DiskError: the folder's disk is full or can't be written.
    """
    import pipeline.threads  # noqa: F401  (before torch, as in the command line)

    try:
        with tempfile.TemporaryDirectory(dir=folder, prefix=".machine-") as name:
            read, write = _disk(Path(name) / "disk")
            return Rates(
                _matrix(), _scalar(), _vector(), _memory(), read, write, _hashed(), *_pictures(Path(name)), _rays()
            )
    except OSError as e:
        raise stage_error_from_os_error(e, folder) or e from e


def rate(amount: float, work: Callable[[], object]) -> float:
    """Amount that all cores do in a second: by the processor time of the work, whatever else the machine does. The
    median of REPEATS calls, after one that compiles and warms up."""
    return _cores() * _rate(amount, work, time.process_time)


def wall_rate(amount: float, work: Callable[[], object]) -> float:
    """Amount a second by the clock, for what is not the processor's work. The median as before."""
    return _rate(amount, work, time.perf_counter)


def _rate(amount: float, work: Callable[[], object], clock: Callable[[], float]) -> float:
    work()
    taken = []
    for _ in range(REPEATS):
        begun = clock()
        work()
        taken.append(clock() - begun)
    return amount / max(statistics.median(taken), 1e-9)


def _cores() -> int:
    return len(os.sched_getaffinity(0))


def _matrix() -> float:
    import torch

    a = torch.rand(MATRIX, MATRIX, generator=torch.Generator().manual_seed(0))
    return rate(2.0 * MATRIX**3, lambda: a @ a)


def _scalar() -> float:
    from workflows.bench import machine_kernels

    picture = np.random.default_rng(0).random((256, 256), np.float32)  # fits into every core's cache
    out = np.zeros(TASKS, np.float32)
    return rate(float(machine_kernels.OPERATIONS * TASKS * SAMPLES),
                lambda: machine_kernels.samples(picture, SAMPLES, out))  # fmt: skip


def _vector() -> float:
    from workflows.bench import machine_kernels

    x = np.random.default_rng(0).random((TASKS, ROW), np.float32)
    out = np.empty_like(x)
    return rate(float(2 * machine_kernels.DEGREE * x.size * ROUNDS),
                lambda: machine_kernels.polynomials(x, out, ROUNDS))  # fmt: skip


def _memory() -> float:
    parts = [np.ones(COPIED // 4 // _cores(), np.float32) for _ in range(_cores())]
    copies = [np.empty_like(p) for p in parts]

    def copy() -> None:
        with ThreadPoolExecutor(len(parts)) as pool:
            list(pool.map(np.copyto, copies, parts))

    return wall_rate(2.0 * sum(p.nbytes for p in parts), copy)


def _disk(path: Path) -> tuple[float, float]:
    """Bytes read and written a second, one file after the other, past the system's cache."""
    data = np.random.default_rng(0).bytes(FILE)

    def write() -> None:
        with path.open("wb") as f:
            f.write(data)
            f.flush()
            os.fsync(f.fileno())

    def read() -> None:
        with path.open("rb", buffering=0) as f:
            os.posix_fadvise(f.fileno(), 0, 0, os.POSIX_FADV_DONTNEED)
            while f.read(1 << 22):
                pass

    written = wall_rate(FILE, write)
    return wall_rate(FILE, read), written


def _hashed() -> float:
    data = bytes(1 << 25)
    return rate(float(len(data)), lambda: hashlib.sha256(data).digest())


def _pictures(folder: Path) -> tuple[float, float, float, float, float]:
    """Pixels decoded a second of JPEG, PNG and EXR, and compressed and written of PNG and EXR."""
    import cv2

    from pipeline.images import read_encoded, read_exr, write_exr, write_png

    picture = example(PICTURE)
    smooth = example(PICTURE, 0.1)
    jpeg, png, exr = (folder / f"example.{kind}" for kind in ("jpg", "png", "exr"))
    cv2.imwrite(str(jpeg), np.asarray(255 * picture, np.uint8))
    write_png(png, picture)
    write_exr(exr, picture, half=True)
    each = float(PICTURE * PICTURE)
    work: list[Callable[[], Any]] = [
        lambda: read_encoded(jpeg),
        lambda: read_encoded(png),
        lambda: read_exr(exr),
        lambda: write_png(png, smooth),
        lambda: write_exr(exr, smooth, half=True),
    ]
    found = [rate(each, one) for one in work]
    return found[0], found[1], found[2], found[3], found[4]


def example(side: int, noise: float = 1.0) -> F32:
    """(side, side, 3) values in [0, 1]: waves, and noise in levels of 8 bits. With 1 it compresses about as a photo
    does, with 0.1 as a map."""
    y, x = np.mgrid[:side, :side].astype(np.float32) / np.float32(side)
    waves = [0.5 + 0.4 * np.sin((3 + 2 * k) * x + 5 * y) * np.cos(7 * y - k * x) for k in range(3)]
    grain = np.random.default_rng(0).normal(0, noise / 255, (side, side, 3))
    return np.asarray((np.stack(waves, -1) + grain).clip(0, 1), np.float32)


def _rays() -> float:
    from pipeline.ray_casting import RayCaster

    caster = RayCaster(*ball(BALL))
    y, x = np.divmod(np.arange(RAYS), 500)
    aim = np.stack([x / 250.0 - 1, y / 200.0 - 1, np.zeros(RAYS)], -1)
    start = np.array([0.0, 0.0, 4.0])
    way = aim - start
    way /= np.linalg.norm(way, axis=1, keepdims=True)
    starts = np.broadcast_to(start, way.shape)
    return rate(float(RAYS), lambda: caster.hits(starts, way))


def ball(rows: int) -> tuple[npt.NDArray[np.float64], npt.NDArray[np.int64]]:
    """Vertices (V, 3) and faces (2 rows^2, 3) of the unit ball, from pole to pole."""
    up, around = np.meshgrid(np.linspace(0, np.pi, rows + 1), np.linspace(0, 2 * np.pi, rows + 1), indexing="ij")
    vertices = np.stack([np.sin(up) * np.sin(around), np.cos(up), np.sin(up) * np.cos(around)], -1).reshape(-1, 3)
    first = (np.arange(rows)[:, None] * (rows + 1) + np.arange(rows)).ravel()
    corners = np.stack([first, first + rows + 1, first + 1, first + 1, first + rows + 1, first + rows + 2], -1)
    return vertices, corners.reshape(-1, 3)
