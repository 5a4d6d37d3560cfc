"""COLMAP reconstructions from known poses: points by triangulation of the database's matches."""

from __future__ import annotations

from collections.abc import Mapping
from pathlib import Path
from typing import Any

from pipeline.colmap import pycolmap
from pipeline.transforms import F64


def seeded(seed: int) -> Any:
    """Options of COLMAP's incremental pipeline that give the same result each time: one thread, seeded samplers."""
    options = pycolmap.IncrementalPipelineOptions()
    options.num_threads = 1
    options.random_seed = options.mapper.random_seed = options.triangulation.random_seed = seed
    options.extract_colors = False
    return options


def with_poses(database: Path, poses: Mapping[str, F64], cameras: Mapping[int, Any] | None = None) -> Any:
    """A reconstruction without points. poses: cam_from_world (4, 4) or (3, 4) by image name; other images are left out.
    cameras: in place of the database's, by id."""
    found, opened = pycolmap.Reconstruction(), pycolmap.Database.open(database)
    for camera in opened.read_all_cameras():
        found.add_camera_with_trivial_rig((cameras or {}).get(camera.camera_id, camera))
    for image in opened.read_all_images():
        if image.name in poses:
            found.add_image_with_trivial_frame(image, pycolmap.Rigid3d(poses[image.name][:3]))
    opened.close()
    return found


def with_points(reconstruction: Any, database: Path, scratch: Path, limit: float, seed: int) -> Any:
    """The reconstruction with points from all matches of its images; poses and lenses stay.

    limit: largest reprojection error in pixels. scratch: a folder for COLMAP's files.
    """
    options = seeded(seed)
    options.ba_refine_focal_length = options.ba_refine_extra_params = options.ba_refine_principal_point = False
    options.mapper.filter_max_reproj_error = limit
    options.triangulation.complete_max_reproj_error = options.triangulation.merge_max_reproj_error = limit
    return pycolmap.triangulate_points(reconstruction, database, scratch, scratch, options=options)
