"""Settings of the poses stage."""

from __future__ import annotations

from typing import Annotated, Literal

from pydantic import Field, field_validator

from pipeline.contract import StageConfig
from pipeline.units import Millimetres, Pixels, Share, Unit, Views


class Config(StageConfig):
    """Settings of the cameras and of the scale."""

    method: Literal["auto", "given", "colmap"] = Field(
        "auto",
        description="given: use the capture's cameras; colmap: solve them from the photos; auto: given if possible",
    )
    seed: int = Field(0, ge=0, lt=2**31, description="seed of all random numbers")
    max_image_size: Pixels = Field(1000, ge=200, description="longest edge of the photos for feature detection")
    max_features: Annotated[int, Unit("features")] = Field(
        1500, ge=200, le=20000, description="largest number of features per photo"
    )
    neighbours: Views = Field(
        14, ge=2, description="photos that each photo is matched with; all if there are at most 20"
    )
    attempts: int = Field(
        3,
        ge=1,
        le=3,
        description="SfM attempts while photos lack a camera; 1: SIFT; 2: also denoised photos; 3: also ASIFT",
    )
    mapper: Literal["auto", "incremental", "global"] = Field(
        "auto", description="COLMAP's mapper; auto: incremental, from 200 photos on global"
    )
    camera_model: Literal["SIMPLE_RADIAL", "OPENCV"] = Field(
        "SIMPLE_RADIAL", description="lens model: one radial term, or two radial and two tangential ones"
    )
    check: bool = Field(True, description="check given cameras by the epipolar constraint; leave out views that fail")
    given: Literal["keep", "triangulate", "refine"] = Field(
        "keep",
        description="given cameras; keep: unchanged; triangulate: also triangulate sparse points; refine: also refine "
        "the poses by bundle adjustment with a prior on the camera centres",
    )
    given_deviation: Share = Field(
        0.005, gt=0, le=0.2, description="for refine: standard deviation of given centres, as a share of their distance"
    )
    unit: Literal["auto", "metres", "centimetres", "millimetres", "unknown"] = Field(
        "auto",
        description="unit of the given cameras; auto: for FaceScape from the subject's size, for other formats unknown",
    )
    scale: Literal["auto", "none", "distance", "markers", "pupils", "gps"] = Field(
        "auto", description="source of the scale; auto: the first of these that settings and photos allow"
    )
    distance: str = Field(
        "", description='a known distance: "1.jpg to 5.jpg = 0.42" (metres; cameras, or points as PHOTO@X,Y+PHOTO@X,Y)'
    )
    marker_mm: Millimetres = Field(0.0, ge=0, le=10000, description="edge of the markers' black squares; 0: no markers")
    marker_kind: Literal["aruco_4x4", "aruco_5x5", "aruco_6x6", "apriltag_16h5", "apriltag_25h9", "apriltag_36h11"] = (
        Field("aruco_4x4", description="family of the markers")
    )
    pupils_mm: Millimetres = Field(0.0, ge=0, le=100, description="distance between the subject's pupils; 0: unknown")

    @field_validator("distance")
    @classmethod
    def _grammar(cls, spec: str) -> str:
        from stages.poses.scale import check_distance

        return check_distance(spec)
