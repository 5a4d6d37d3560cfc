"""Draws a sphere around the subject, from the front and from behind: how many photos see each surface direction."""

from __future__ import annotations

import numpy as np
from markupsafe import Markup

from pipeline.directions import COLUMNS, ROWS, Counts, parts, share_seen

RADIUS, GAP, FOOT = 90, 20, 22  # drawing units
HIDDEN = 0.5  # parts of which a smaller share is seen are listed
# people with red-green colour blindness can distinguish blue and orange; the brightness differs too
LEVELS = ((0, "#d55e00", "seen by no photo"), (1, "#9ecae1", "by 1 or 2 photos"), (3, "#2171b5", "by 3 or more"))


def sphere(counts: Counts) -> Markup:
    """An inline SVG of the grid of pipeline.directions; empty if there is none."""
    if not counts:
        return Markup("")
    width, height = 4 * RADIUS + 3 * GAP, 2 * RADIUS + GAP + FOOT
    cells = "".join(_half(counts, side) for side in (0, 1))
    names = "".join(
        f'<text x="{_middle(side)}" y="{height - 6}" font-size="12" text-anchor="middle" '
        f'fill="currentColor">{name}</text>'
        for side, name in enumerate(("from the front", "from behind"))
    )
    return Markup(  # noqa: S704  numbers and words of our own
        f'<svg viewBox="0 0 {width} {height}" width="{width}" role="img" '
        f'aria-label="directions around the subject that photos see">{cells}{names}</svg>'
    )


def legend() -> list[tuple[str, str]]:
    """(text, colour) of each level."""
    return [(words, colour) for _, colour, words in LEVELS]


def hidden_parts(counts: Counts) -> list[str]:
    """Names of the parts of a head of which less than half is seen, with the share that is seen."""
    if not counts:
        return []
    shares = {name: share_seen(counts, where) for name, where in parts().items()}
    return [f"the {name} ({share:.0%} seen)" for name, share in shares.items() if share < HIDDEN]


def _middle(side: int) -> int:
    return GAP + RADIUS + side * (2 * RADIUS + GAP)


def _half(counts: Counts, side: int) -> str:
    """The bins of one hemisphere, viewed from +Z (side 0) or -Z. From the front, the person's left is on the right."""
    out = []
    for row in range(ROWS):
        for column in range(COLUMNS):
            azimuth = (column + 0.5) * 360 / COLUMNS - 180
            if (abs(azimuth) < 90) == (side == 0):
                out.append(_bin(row, column, side, counts[row][column]))
    return "".join(out)


def _bin(row: int, column: int, side: int, views: int) -> str:
    e = np.radians(90 - np.array([row, row, row + 1, row + 1]) * 180 / ROWS)
    a = np.radians(np.array([column, column + 1, column + 1, column]) * 360 / COLUMNS - 180)
    x = _middle(side) + RADIUS * np.cos(e) * np.sin(a) * (1 if side == 0 else -1)
    y = GAP / 2 + RADIUS * (1 - np.sin(e))
    corners = " ".join(f"{px:.1f},{py:.1f}" for px, py in zip(x, y, strict=True))
    colour = next(c for least, c, _ in reversed(LEVELS) if views >= least)
    return (
        f'<polygon points="{corners}" fill="{colour}" stroke="#fff" stroke-width=".5"><title>{views}</title></polygon>'
    )
