"""Choice of the source of scale: a known distance, markers, pupils or GPS positions. Also the detection of faces."""

from __future__ import annotations

from collections.abc import Callable

import numpy as np

from pipeline.artifacts import Camera, Located
from pipeline.capture_artifacts import Capture, CaptureView
from pipeline.errors import StageError
from pipeline.faces.find import Face, find_face
from pipeline.faces.landmarks3d import triangulate
from pipeline.images import read_encoded
from pipeline.transforms import F64
from stages.poses.config import Config
from stages.poses.features import U8, grey8
from stages.poses.scale import Eyes, Scale, by_distance, by_markers, by_positions, by_pupils, find_markers

# Metres of real heads per metre of the head template placed on their landmarks: 1.06, 1.18, 1.21 on three heads of
# known size. A face's proportions say little about its size, and adults differ by 5 %.
HEAD_SIZE, HEAD_DEVIATION = 1.13, 0.07
LOOKED_AT = 48  # photos in which a face is detected if cameras are given
NEEDS = {
    "markers": "visible markers of poses.marker_kind and poses.marker_mm",
    "pupils": "poses.pupils_mm, and a face in at least three photos",
    "gps": "GPS positions in EXIF with a spread much larger than their error",
}


def known_scale(
    capture: Located[Capture], cameras: list[Camera], config: Config, eyes: Eyes | None, warnings: list[str]
) -> Scale | None:  # fmt: skip
    """Metres per unit of the cameras' world from settings or photos, or None. Held-out photos are not asked.

    Raises:
        UsageError: a setting of poses.distance is wrong. StageError: the source of poses.scale gives no scale.
    """
    wanted, fitted = config.scale, fitted_of(capture, cameras)
    if wanted == "distance" or (wanted == "auto" and config.distance):
        return by_distance(config.distance, cameras)
    why = ""
    if wanted == "markers" or (wanted == "auto" and config.marker_mm):
        photos = {v.index: v for v in capture.artifact.views}
        seen = [(c, find_markers(_grey(capture, photos[c.index]), config.marker_kind)) for c in fitted]
        found = by_markers(seen, config.marker_mm / 1e3) if config.marker_mm else None
        if found is not None:
            return found
        count = len({n for _, corners in seen for n in corners})
        why = f"{count} markers of {config.marker_kind} are detected, none of them complete and square in two photos"
    if wanted == "pupils" or (wanted == "auto" and not why and config.pupils_mm):
        if config.pupils_mm and eyes is not None:
            return by_pupils(eyes, config.pupils_mm / 1e3)
        why = "no three photos agree on a face" if config.pupils_mm else "poses.pupils_mm is not set"
    places = {v.index: v.place_m for v in capture.artifact.views if v.place_m is not None}
    if wanted == "gps" or (wanted == "auto" and not why and places):
        found, why = by_positions(fitted, places)
        if found is not None:
            return found
    if wanted in NEEDS:
        raise StageError("the scale can't be determined", where=f"poses.scale={wanted}", value=why,
                         limit=NEEDS[wanted],
                         remedy="check these settings, or give poses.distance")  # fmt: skip
    if why:
        warnings.append(f"the photos do not determine the scale: {why}")
    return None


def find_faces(
    capture: Located[Capture], cameras: list[Camera], check: Callable[[], None]
) -> list[tuple[Camera, Face]]:  # fmt: skip
    """The cameras whose photos show a face, and the face. check: raises if the run was cancelled."""
    photos = {v.index: v for v in capture.artifact.views}
    out = []
    for c in cameras:
        check()
        image = read_encoded(capture.path(photos[c.index].image))
        grey = grey8(image, max(c.width, c.height))
        face = find_face(np.repeat(grey[..., None], 3, 2), c.width / 2, c.height / 2, max(c.width, c.height) / 2)
        if face is not None:
            out.append((c, face))
    return out


def landmarks_of(faces: list[tuple[Camera, Face]]) -> F64 | None:
    """(468, 3) the face's landmarks in the cameras' world, or None if no three photos agree on a face."""
    found = triangulate([c for c, _ in faces], np.stack([f.points for _, f in faces])) if faces else None
    return None if found is None else found.xyz


def size_of_head(landmarks: F64 | None) -> Scale | None:
    """A guess of the scale from the head template placed on landmarks (468, 3); None if it does not fit them."""
    if landmarks is None:
        return None
    from pipeline.registration.identity_fit import placed_on_face
    from pipeline.template.load import load_template

    head = placed_on_face(load_template(), landmarks)
    if head is None:
        return None
    return Scale(HEAD_SIZE / head.scale, f"guessed from the shape of the face, within about {HEAD_DEVIATION:.0%}")


def fitted_of(capture: Located[Capture], cameras: list[Camera]) -> list[Camera]:
    """The cameras of fitted photos."""
    held = {v.index for v in capture.artifact.views if v.holdout}
    return [c for c in cameras if c.index not in held]


def some_of(capture: Located[Capture], cameras: list[Camera]) -> list[Camera]:
    """At most LOOKED_AT of the cameras of fitted photos, evenly spaced."""
    fitted = fitted_of(capture, cameras)
    return fitted[:: -(-len(fitted) // LOOKED_AT)]


def _grey(capture: Located[Capture], view: CaptureView) -> U8:
    return grey8(read_encoded(capture.path(view.image)), max(view.width, view.height))
