"""The light of a capture where it is known: from a lat-long picture, or from a light stage's lamps.

    e_i = g I_i (axis_i . -l_i) / (s d_i^2)

Symbols
    I_i, axis_i      radiant intensity of lamp i along the axis along which it shines
    l_i, d_i         direction and distance from the asset's origin, which is the head's centre, to it
    g                gain of the views against the files
    s                share of the light in the views that the calibrated lamps account for; the missing ones are taken
                     to be spread as the others
Differs: not in the paper, which learns the light. Lamps are at infinity for the fit: at a distance of 1.3 m the near
side of a head gets up to a fifth more light than its centre.
"""

from __future__ import annotations

from dataclasses import dataclass
from pathlib import Path

import numpy as np

from pipeline.artifacts import CameraSet
from pipeline.capture_artifacts import Capture, LightStage
from pipeline.errors import UsageError
from pipeline.lighting.given import read_latlong, sh_of_lamps, sh_of_latlong
from pipeline.transforms import F64, matrix, scale_of
from stages.inverse_rendering.config import AUTO, Config

STAGE = "the light stage's lamps"
LEAST_SHARE = 0.7  # of the light that calibrated lamps account for: the rest is taken to be spread as they are


@dataclass(frozen=True, slots=True)
class GivenLight:
    """coefficients: ((L + 1)^2, 3) SH in asset coordinates. source: for the report. scaled: whether they are in the
    photos' unit, else one factor is unknown."""

    coefficients: F64
    source: str
    scaled: bool


def given_light(capture: Capture, poses: CameraSet, config: Config) -> GivenLight | None:
    """The known light of a capture, up to the settings' SH order; None if it has to be estimated.

    Raises:
        StageError: the file can't be read. UsageError: the stage's lamps are asked for, but it is no light stage.
    """
    capture_from_asset = matrix(poses.capture_from_asset).reshape(4, 4)
    if config.light_file:
        # solved cameras have no frame that a light could be measured in: the picture stands as the asset does
        turn = capture_from_asset[:3, :3] / scale_of(capture_from_asset) if poses.source == "given" else np.eye(3)
        path = Path(config.light_file)
        found = sh_of_latlong(read_latlong(path), config.first_order, turn)
        if config.light_scale == AUTO:
            return GivenLight(found, path.name, scaled=False)
        return GivenLight(found * float(config.light_scale), path.name, scaled=True)
    if config.light_from == "stage" and capture.stage is None:
        raise UsageError(
            "the capture has no lamps",
            where="inverse_rendering.light_from",
            value="stage",
            limit="the capture of a light stage",
            remedy="use inverse_rendering.light_from=auto, or --light with a file",
        )
    if capture.stage is None or not takes_lamps(capture.stage, config):
        return None
    return GivenLight(of_stage(capture.stage, capture_from_asset, config.first_order), STAGE, scaled=True)


def takes_lamps(stage: LightStage, config: Config) -> bool:
    """Whether the lamps of a stage are the light of its pictures: where the setting says so, or leaves it open and the
    lamps account for most of the light. The maps of its single lights have the level of the lamps, so that an
    environment with a level of its own would show them too bright or too dark."""
    if config.light_from != AUTO:
        return config.light_from == "stage"
    return stage.share >= LEAST_SHARE and config.light_frame in (AUTO, "world")


def of_stage(stage: LightStage, capture_from_asset: F64, order: int) -> F64:
    """((order + 1)^2, 3) SH of a stage's lamps together, in asset coordinates and the views' unit.
    [NeuFace eq. 2]"""
    centre = capture_from_asset[:3, 3]
    away = np.array([light.position for light in stage.lights], np.float64) - centre
    axis = np.array([light.axis for light in stage.lights], np.float64)
    squared = (away**2).sum(1)
    towards = away / np.sqrt(squared)[:, None]
    forward = np.maximum(-(axis * towards).sum(1), 0)
    strength = np.array([light.intensity for light in stage.lights], np.float64)
    irradiance = stage.gain / stage.share * strength * (forward / squared)[:, None]
    turn = capture_from_asset[:3, :3] / scale_of(capture_from_asset)
    return sh_of_lamps(towards @ turn, irradiance, order)
