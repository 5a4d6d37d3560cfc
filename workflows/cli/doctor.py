"""Is this machine ready? Each line is a fact and, where something is missing, how to get it."""

from __future__ import annotations

import importlib
import importlib.metadata
import os
import platform
import shutil
import sys
from collections.abc import Iterator
from dataclasses import dataclass
from pathlib import Path

from workflows.supply.lock import LOCKS, ROOT, differences, installed, locked

# import name -> distribution, and what it is for
NEEDED = {
    "numpy": ("numpy", "arrays"),
    "scipy": ("scipy", "numerics"),
    "torch": ("torch", "the fit"),
    "cv2": ("opencv-contrib-python-headless", "photos, masks"),
    "skimage": ("scikit-image", "metrics"),
    "OpenEXR": ("OpenEXR", "linear pictures"),
    "numba": ("numba", "the demo's renderer, baking"),
    "pycolmap": ("pycolmap", "cameras of photos that have none"),
    "trimesh": ("trimesh", "meshes"),
    "embreex": ("embreex", "rays against meshes"),
    "pymeshlab": ("pymeshlab", "mesh repair"),
    "pyinstantmeshes": ("pyinstantmeshes", "quads"),
    "fast_simplification": ("fast-simplification", "mesh decimation"),
    "xatlas": ("xatlas", "UV charts"),
    "pxr": ("usd-core", "the asset"),
    "prefect": ("prefect", "runs"),
    "fastapi": ("fastapi", "Prefect's server"),
    "jinja2": ("jinja2", "the report"),
}
OPTIONAL = {"flip_evaluator": ("flip-evaluator", "the FLIP metric in the report")}
SERVER_BREAKS = (0, 158)  # fastapi from here on: Prefect 3.8's server does not start
SHOWN = 8  # differences from the lock that are named
MEMORY_GB, DISK_GB = 6.0, 5.0  # a draft of 54 photos peaks at 2.9 GB; its store and the set-up's caches


@dataclass(frozen=True, slots=True)
class Finding:
    """One line. level: "ok", "note" or "fault"."""

    level: str
    what: str
    found: str
    remedy: str = ""

    def __str__(self) -> str:
        mark = {"ok": "ok   ", "note": "note ", "fault": "FAULT"}[self.level]
        return f"{mark} {self.what}: {self.found}" + (f"\n      {self.remedy}" if self.remedy else "")


def examine(folder: Path) -> list[Finding]:
    """Everything that `neuface doctor` looks at; `folder` is where results would go."""
    return [_python(), *_packages(), _lock(), *_hardware(folder), _threads()]


def _python() -> Finding:
    right = sys.version_info[:2] in ((3, 11), (3, 12))
    return Finding(
        "ok" if right else "fault",
        "Python",
        platform.python_version(),
        "" if right else "install Python 3.11, then `make setup`",
    )


def _packages() -> Iterator[Finding]:
    for table, level in ((NEEDED, "fault"), (OPTIONAL, "note")):
        for module, (distribution, purpose) in table.items():
            try:
                importlib.import_module(module)
                version = importlib.metadata.version(distribution)
            except (ImportError, OSError) as e:  # OSError: a shared library that does not load
                yield Finding(level, distribution, f"can't be used ({e})", f"for {purpose}: make setup")
                continue
            if module == "fastapi" and tuple(int(p) for p in version.split(".")[:2]) >= SERVER_BREAKS:
                yield Finding(
                    "fault",
                    distribution,
                    version,
                    "Prefect's server does not start with it: make setup",
                )
                continue
            yield Finding("ok", distribution, version)


def _lock(root: Path = ROOT) -> Finding:
    """What of the installation differs from the lock files: other versions were not tested together."""
    if not all((root / name).is_file() for name in LOCKS):
        return Finding("note", "lock", "not beside the program: installed from a package or an image")
    pins = locked(root)
    odd = differences(pins, installed())
    if not odd:
        return Finding("ok", "lock", f"all {len(pins)} packages as in {' and '.join(LOCKS)}")
    told = ", ".join(odd[:SHOWN]) + (f" and {len(odd) - SHOWN} more" if len(odd) > SHOWN else "")
    return Finding(
        "note", "lock", f"{len(odd)} of {len(pins)} packages differ: {told}", "make setup installs the lock's"
    )


def _hardware(folder: Path) -> Iterator[Finding]:
    yield Finding("ok", "cores", str(len(os.sched_getaffinity(0))))
    memory = os.sysconf("SC_PAGE_SIZE") * os.sysconf("SC_PHYS_PAGES") / 1e9
    yield Finding(
        "ok" if memory >= MEMORY_GB else "note",
        "memory",
        f"{memory:.1f} GB",
        "" if memory >= MEMORY_GB else "use --preset draft",
    )
    near = next(p for p in (folder.resolve(), *folder.resolve().parents) if p.exists())
    free = shutil.disk_usage(near).free / 1e9
    yield Finding(
        "ok" if free >= DISK_GB else "note",
        f"free disk at {near}",
        f"{free:.1f} GB",
        "" if free >= DISK_GB else "choose another disk with --out or --store",
    )
    if not os.access(near, os.W_OK):
        yield Finding("fault", f"folder {near}", "can't be written", "choose another with --out")
    yield _device()


def _device() -> Finding:
    try:
        import torch
    except (ImportError, OSError):
        return Finding("fault", "device", "torch can't be loaded", "make setup")
    if torch.cuda.is_available():
        from pipeline.maths import cuda_kernels

        name = f"cuda, {torch.cuda.get_device_name(0)}"
        if cuda_kernels.available():
            return Finding("ok", "device", name)
        return Finding(
            "note", "device", f"{name}: the fit's kernels can't be compiled", "the fit runs on the processor"
        )
    return Finding("note", "device", "cpu", "where there is a CUDA device, the fit runs on it")


def _threads() -> Finding:
    policy = os.environ.get("OMP_WAIT_POLICY", "")
    passive = policy.upper() == "PASSIVE" or os.environ.get("GOMP_SPINCOUNT") == "0"
    return Finding(
        "ok" if passive else "note",
        "idle threads",
        policy or "spinning",
        "" if passive else "unset OMP_WAIT_POLICY, or everything beside the fit slows down",
    )
