"""Artifacts that stand for a finished fit: an analytic field behind a FittedFace, and cameras on a circle around it."""

from __future__ import annotations

import sys
import types
from pathlib import Path

import numpy as np
import pytest

from pipeline.artifacts import Camera, CameraSet, FileRef, FittedFace, Located
from pipeline.fields.protocol import Field
from pipeline.transforms import rows


def fitted(folder: Path, field: Field, monkeypatch: pytest.MonkeyPatch, views: int = 4) -> Located[FittedFace]:
    """A FittedFace whose field file is empty; pipeline.fields.face.load_face hands back `field` instead."""
    for name in ("field.npz", "light.npz"):
        (folder / name).write_bytes(b"")
    stand_in = types.ModuleType("pipeline.fields.face")
    stand_in.load_face = lambda path, device="cpu": field  # type: ignore[attr-defined]
    monkeypatch.setitem(sys.modules, "pipeline.fields.face", stand_in)
    artifact = FittedFace(
        field=FileRef.of(folder, "field.npz"),
        light=FileRef.of(folder, "light.npz"),
        rank=field.rank,
        light_order=10,
        fitted_views=tuple(range(views)),
        held_out=(),
        steps=1,
        loss=0.0,
        psnr=30.0,
        beta=1e-4,
        cell=field.cell,
        model={},
    )
    return Located(artifact, folder)


def camera(index: int, angle: float, distance: float = 0.6, size: int = 64, focal: float = 120.0) -> Camera:
    """A camera in the horizontal plane at `angle` around +y from +z (radians) that looks at the origin."""
    centre = distance * np.array([np.sin(angle), 0.0, np.cos(angle)])
    forward, down = -centre / distance, np.array([0.0, -1.0, 0.0])
    pose = np.eye(4)
    pose[:3, :3] = np.stack([np.cross(down, forward), down, forward], 1)
    pose[:3, 3] = centre
    K = np.array([[focal, 0, size / 2], [0, focal, size / 2], [0, 0, 1]])
    return Camera(
        index=index,
        name=f"{index}.png",
        width=size,
        height=size,
        K=rows(K),
        world_from_cam=rows(pose),
        distortion=(0.0, 0.0, 0.0, 0.0, 0.0),
    )


def poses(folder: Path, views: int = 4) -> Located[CameraSet]:
    """Cameras evenly on a circle."""
    cameras = tuple(camera(i, 2 * np.pi * i / views) for i in range(views))
    artifact = CameraSet(
        source="given", metric=True, capture_from_asset=rows(np.eye(4)), roi_radius=0.12, cameras=cameras
    )
    return Located(artifact, folder)
