"""Background between loose hair that a mask took for the subject.

Where hair stands off the head, the wall shows through it. Networks take all of it for the person, every photo does, and
so no other mask contradicts it: the asset gets a cap of the wall's colour. Dark hair before a bright, even wall tells
itself:

    alpha = <c - B, F - B> / |F - B|^2,     r^2 = |c - B - alpha (F - B)|^2 / |B|^2

Symbols, in linear light: c a pixel's colour; B the background continued into the mask (refine_contour.continued); F the
mean colour of the hair nearby, which is much darker than B. A pixel of the mask is **mixed** if r is small and F is far
from B. A region of mixed pixels with alpha < 1/2 is a gap if enough hair is around it, and what touches it is mixed,
too: hair or wall, but not skin, whose colour is no mixture of both. Such pixels of a pale face, an ear beside it or a
bald head are connected with skin. Gaps lie above the lips and outside of the face. Hair beside a gap that is left thin
goes with it. Mixed pixels near the outline with alpha < SOLID remain the subject's, but their colours are not used.
Without a face in the photo nothing is done. Accuracy: docs/captures.md, Contours.
"""

from __future__ import annotations

from dataclasses import dataclass

import cv2
import numpy as np
import numpy.typing as npt

from pipeline.colour import LUMA
from pipeline.faces.find import find_face
from stages.masks.face_labels import REACH as SEARCHED
from stages.masks.matting import mean_near
from stages.masks.refine_contour import BLUR, continued
from stages.masks.region import F32, LINEAR, U8, Bool, Disc, dilated, eroded

F64 = npt.NDArray[np.float64]
TOP, CHIN = 10, 152  # landmarks: the middle of the hairline, and the chin
REACH = 0.17  # of the face's height: window that continues the background, and that of the hair's mean
LOW = 0.25  # of the face's height above the chin, about the lips: below are necks, and shoulders of the wall's colour
FOREHEAD = 0.15  # of the face's height above its landmarks that is still face
BESIDE = 0.12  # of the face's height: thin hair this close to a gap goes with it
THIN = 0.035  # of the face's height: half of the width that hair must have to stay there
MARGIN = 2  # pixels outside of the mask where the background begins
DARKER, FAR = np.log(2.0), np.log(2.5)  # of luminances: colours that F is the mean of, and F itself, against B
HAIR = 0.3  # least share of such colours among the mask's pixels around a gap
FLOOR = 0.01  # of the photo's white, added to luminances
OFF_LINE = 0.08  # largest r of a mixed pixel
EVEN = 0.15  # largest deviation of the background about its continuation, of |F - B|
FOREIGN = 0.25  # largest share of a gap's surroundings that is neither mixed nor outside
LEAST, MOST = 0.0005, 0.3  # of the mask and of the face: sizes of a gap
AROUND = 2  # pixels: its surroundings
SOLID = 0.7  # alpha of hair through which no wall is seen
EDGE = 0.1  # of the face's height: how far from the outline a wall can be seen through hair


@dataclass(frozen=True, slots=True)
class Head:
    """Where gaps may be (h, w), never in the face; which pixels are the face's (h, w); and its height in pixels."""

    above: Bool
    face: Bool
    height: float

    @property
    def reach(self) -> float:
        """Pixels of the windows."""
        return max(3.0, REACH * self.height)


@dataclass(frozen=True, slots=True)
class Mixtures:
    """All (h, w). mixed: no other colour than those of hair and wall. alpha: share of the hair. hair: much darker than
    the wall."""

    mixed: Bool
    alpha: F32
    hair: Bool


def with_loose_hair(image: U8, inside: Bool, disc: Disc) -> tuple[Bool, Bool]:
    """The mask (h, w) of a person without the gaps in loose hair, and which of its pixels show hair and wall at once.

    image: (h, w, 3) 8-bit sRGB. disc: the region of interest, in which the face is searched.
    """
    face = find_face(image, disc.x, disc.y, SEARCHED * disc.radius, disc.roll) if inside.any() else None
    if face is None:
        return inside, np.zeros_like(inside)
    head = head_in(inside, face.points)
    seen = mixtures(LINEAR[np.asarray(cv2.GaussianBlur(image, (0, 0), BLUR), np.uint8)], inside, head)
    left = inside & ~gaps(inside, seen, head)
    edge = dilated(~left, max(1, round(EDGE * head.height)))
    return left, left & edge & head.above & seen.mixed & (seen.alpha < SOLID)


def gaps(inside: Bool, seen: Mixtures, head: Head) -> Bool:
    """Pixels (h, w) of a mask (h, w) that are gaps in loose hair."""
    may_be = inside & head.above & seen.mixed & (seen.alpha < 0.5)
    count, label, stats, _ = cv2.connectedComponentsWithStats(may_be.astype(np.uint8), connectivity=4)
    found = np.zeros_like(inside)
    for k in range(1, count):
        if LEAST * inside.sum() <= stats[k, cv2.CC_STAT_AREA] <= MOST * head.face.sum():
            part = np.asarray(label == k)
            if _is_gap(part, inside, seen, head):
                found |= part
    hair = inside & head.above & seen.mixed & ~found
    return found | _thin_beside(found, hair, inside & ~found, head)


def _is_gap(part: Bool, inside: Bool, seen: Mixtures, head: Head) -> bool:
    """Whether a region (h, w) lies between hair: what touches it is no skin, and enough of what is near is hair."""
    ring = dilated(part, AROUND) & ~part
    if (ring & head.face).any() or (ring & inside & ~seen.mixed).sum() > FOREIGN * ring.sum():
        return False
    near = dilated(part, round(head.reach)) & ~part & inside & head.above
    return bool((near & seen.hair).sum() >= HAIR * max(int(near.sum()), 1))


def head_in(inside: Bool, face: F64) -> Head:
    """The place of the face (468, 2) in a mask (h, w)."""
    up = face[TOP] - face[CHIN]
    height = max(float(np.hypot(*up)), 1.0)
    drawn = np.zeros(inside.shape, np.uint8)
    for step in np.linspace(0, FOREHEAD, 4):
        outline = cv2.convexHull((face + step * up).astype(np.float32))
        cv2.fillConvexPoly(drawn, np.round(outline).astype(np.int32), 1)
    row, column = np.mgrid[: inside.shape[0], : inside.shape[1]]
    rise = (column + 0.5 - face[CHIN, 0]) * up[0] + (row + 0.5 - face[CHIN, 1]) * up[1]
    above = rise > LOW * height**2
    return Head(np.asarray(above & (drawn == 0)), drawn > 0, height)


def mixtures(colour: F32, inside: Bool, head: Head) -> Mixtures:
    """What the pixels of a mask (h, w) are mixtures of. colour: (h, w, 3) linear."""
    background, variance, known = continued(colour, ~dilated(inside, MARGIN), head.reach)
    background = np.maximum(background, 0)
    behind = _log_luminance(background)
    hair = inside & head.above & known & (behind - _log_luminance(colour) > DARKER)
    foreground, _, near = mean_near(colour, hair, round(head.reach), round(2 * head.reach))
    difference = foreground - background
    square = np.maximum((difference**2).sum(-1), 1e-9)
    off = colour - background
    alpha = (off * difference).sum(-1) / square
    rest = off - alpha.clip(0, 1)[..., None] * difference
    on_line = (rest**2).sum(-1) < OFF_LINE**2 * (background**2).sum(-1)
    told = (behind - _log_luminance(foreground) > FAR) & (variance[..., 0] < EVEN**2 * square)
    return Mixtures(known & near & on_line & told, np.asarray(alpha, np.float32), hair)


def _log_luminance(colour: F32) -> F32:
    return np.asarray(np.log(colour @ np.asarray(LUMA, np.float32) + FLOOR), np.float32)


def _thin_beside(found: Bool, hair: Bool, left: Bool, head: Head) -> Bool:
    """Hair (h, w) close to a gap that is thin in what is left of the mask (h, w)."""
    if not found.any():
        return found
    close = dilated(found, max(1, round(BESIDE * head.height)))
    thin = max(2, round(THIN * head.height))
    return hair & close & ~dilated(eroded(left, thin), thin)
