"""The light under which the standard material is fitted is the exported dome, with what photos show."""

from __future__ import annotations

import numpy as np

from pipeline.lighting.captured import captured_environment
from pipeline.lighting.dome import light_from_environment
from pipeline.lighting.surroundings import Surroundings
from pipeline.maths.latlong import latlong_directions, latlong_weights
from stages.bake.standard_observe import DOME_WIDTH, exported_lamps


def test_the_lamps_are_those_of_the_dome() -> None:
    d = latlong_directions(64, 32)
    even = np.ones((32, 64, 3), np.float32)
    light = light_from_environment(even)
    away = np.maximum(np.arccos(-d[..., 2].clip(-1, 1)) - 1, 0).astype(np.float32)
    dark = Surroundings(0.02 * even, away, np.zeros_like(away), np.maximum(d[..., 2], 0).astype(np.float32))
    for known in (None, dark):
        found = exported_lamps(light, known)
        behind = found.directions[:, 2] < -0.7
        dome = captured_environment(light, DOME_WIDTH, known)
        there = latlong_directions(DOME_WIDTH, DOME_WIDTH // 2)[..., 2] < -0.7
        expected = (dome * latlong_weights(DOME_WIDTH, DOME_WIDTH // 2)[..., None])[there].sum(0)
        np.testing.assert_allclose(found.flux[behind].sum(0), expected, rtol=0.1)
    plain, shown = (
        exported_lamps(light, k).flux[exported_lamps(light, k).directions[:, 2] < -0.7].sum() for k in (None, dark)
    )
    assert shown < 0.1 * plain
