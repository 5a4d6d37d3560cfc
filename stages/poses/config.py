"""Settings of the poses stage."""

from __future__ import annotations

from typing import Annotated, Literal

from pydantic import Field, field_validator

from pipeline.contract import StageConfig
from pipeline.units import Millimetres, Pixels, Share, Unit, Views


class Config(StageConfig):
    """How cameras are taken or solved, and where metres are from."""

    method: Literal["auto", "given", "colmap"] = Field(
        "auto",
        description="given: cameras of the capture; colmap: solved from the photos; auto: given if there are any",
    )
    seed: int = Field(0, ge=0, lt=2**31, description="seed of every random choice")
    max_image_size: Pixels = Field(
        1000, ge=200, description="longest edge of the photos in which features are looked for"
    )
    max_features: Annotated[int, Unit("features")] = Field(
        1500, ge=200, le=20000, description="most features per photo"
    )
    neighbours: Views = Field(14, ge=2, description="partners that a photo is matched with; up to 20 photos, all")
    attempts: int = Field(
        3, ge=1, le=3, description="tries while photos lack a place: 1 plain, 2 without noise, 3 also as if seen askew"
    )
    mapper: Literal["auto", "incremental", "global"] = Field(
        "auto", description="place photos one after the other, or all at once; auto: all at once from 200 photos on"
    )
    camera_model: Literal["SIMPLE_RADIAL", "OPENCV"] = Field(
        "SIMPLE_RADIAL", description="lens model: one radial term, or two radial and two tangential ones"
    )
    check: bool = Field(True, description="hold given cameras against the photos; leave out views that contradict")
    given: Literal["keep", "triangulate", "refine"] = Field(
        "keep",
        description="given cameras: keep them; triangulate: find points on the subject too; refine: and move the "
        "cameras to where the photos say, their centres held near the given ones",
    )
    given_deviation: Share = Field(
        0.005, gt=0, le=0.2, description="how far given centres may be off, of their distance from the subject (refine)"
    )
    unit: Literal["auto", "metres", "centimetres", "millimetres", "unknown"] = Field(
        "auto",
        description="unit of the given cameras; auto: FaceScape's from the subject's size, other formats' unknown",
    )
    scale: Literal["auto", "none", "distance", "markers", "pupils", "gps"] = Field(
        "auto", description="where metres are from; auto: the first of these that the settings and photos give"
    )
    distance: str = Field(
        "", description='a known distance: "1.jpg to 5.jpg = 0.42" (metres; cameras, or points as PHOTO@X,Y+PHOTO@X,Y)'
    )
    marker_mm: Millimetres = Field(
        0.0, ge=0, le=10000, description="edge of the black squares of markers; 0: there are none"
    )
    marker_kind: Literal["aruco_4x4", "aruco_5x5", "aruco_6x6", "apriltag_16h5", "apriltag_25h9", "apriltag_36h11"] = (
        Field("aruco_4x4", description="family of the markers")
    )
    pupils_mm: Millimetres = Field(
        0.0, ge=0, le=100, description="distance between the subject's pupils, if you know it; 0: it is not used"
    )

    @field_validator("distance")
    @classmethod
    def _grammar(cls, spec: str) -> str:
        from stages.poses.scale import check_distance

        return check_distance(spec)
