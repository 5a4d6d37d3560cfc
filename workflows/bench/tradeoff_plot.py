"""A plot of seconds against PSNR as an SVG, written by hand: no plotting library is needed for one."""

from __future__ import annotations

import math
from collections.abc import Callable
from xml.sax.saxutils import escape

Place = Callable[[tuple[float, float]], tuple[float, float]]

WIDTH, HEIGHT = 1020, 560
KEY = 210  # width of the list of names
LEFT, RIGHT, TOP, BOTTOM = 64, 20 + KEY, 24, 52
STYLE = (
    "text{font:12px sans-serif;fill:#333}.number{font-size:10px}.axis{stroke:#888}.grid{stroke:#ddd}"
    ".point{fill:#7a8aa0}.ahead{fill:#c2410c}.front{fill:none;stroke:#c2410c;stroke-width:1.5}"
)


def plot(points: dict[str, tuple[float, float]], ahead: list[str]) -> str:
    """SVG of named points (seconds, dB), seconds on a logarithmic axis. Those in `ahead` are joined by a
    line and named where they are, the others are numbered."""
    shown = {k: p for k, p in points.items() if all(map(math.isfinite, p)) and p[0] > 0}
    if not shown:
        return f'<svg xmlns="http://www.w3.org/2000/svg" width="{WIDTH}" height="{HEIGHT}"/>\n'
    s, q = zip(*shown.values(), strict=True)
    low, high = math.log(min(s)) - 0.25, math.log(max(s)) + 0.25
    floor, top = min(q) - 0.3, max(q) + 0.3

    def at(p: tuple[float, float]) -> tuple[float, float]:
        x = LEFT + (math.log(p[0]) - low) / (high - low) * (WIDTH - LEFT - RIGHT)
        return round(x, 1), round(HEIGHT - BOTTOM - (p[1] - floor) / (top - floor) * (HEIGHT - TOP - BOTTOM), 1)

    body = [*_grid(at, math.exp(low), math.exp(high), floor, top)]
    line = " ".join(f"{x},{y}" for x, y in (at(shown[k]) for k in ahead if k in shown))
    body.append(f'<polyline class="front" points="{line}"/>')
    taken: list[tuple[float, float]] = []
    behind = sorted((k for k in shown if k not in ahead), key=lambda k: -shown[k][1])
    for k in (k for k in ahead if k in shown):
        x, y = at(shown[k])
        body.append(f'<circle class="ahead" cx="{x}" cy="{y}" r="4"/>')
        body.append(f'<text x="{x - 4}" y="{_free(x, y - 10, taken, 60)}" text-anchor="end">{escape(k)}</text>')
    for number, k in enumerate(behind, 1):
        x, y = at(shown[k])
        body.append(f'<circle class="point" cx="{x}" cy="{y}" r="3"/>')
        body.append(f'<text class="number" x="{x + 4}" y="{_free(x, y + 3, taken, 14)}">{number}</text>')
        body.append(f'<text x="{WIDTH - KEY + 12}" y="{TOP + 4 + 16 * number}">{number} {escape(k)}</text>')
    head = f'<svg xmlns="http://www.w3.org/2000/svg" width="{WIDTH}" height="{HEIGHT}" viewBox="0 0 {WIDTH} {HEIGHT}">'
    back = f'<rect width="{WIDTH}" height="{HEIGHT}" fill="#fff"/>'
    return "\n".join([head, f"<style>{STYLE}</style>", back, *body, "</svg>"]) + "\n"


def _free(x: float, y: float, taken: list[tuple[float, float]], width: float) -> float:
    """A height for a label near (x, y) that covers no other, and take it."""
    while any(abs(x - a) < width and abs(y - b) < 10 for a, b in taken):
        y += 10
    taken.append((x, y))
    return y


def _grid(at: Place, first: float, last: float, floor: float, top: float) -> list[str]:
    """Lines and numbers at round values."""
    out = []
    for decade in range(-1, 5):
        for digit in (1, 2, 5):
            v = digit * 10.0**decade
            if first <= v <= last:
                x, _ = at((v, floor))
                out.append(f'<line class="grid" x1="{x}" y1="{TOP}" x2="{x}" y2="{HEIGHT - BOTTOM}"/>')
                out.append(f'<text x="{x}" y="{HEIGHT - BOTTOM + 18}" text-anchor="middle">{v:g}</text>')
    step = next(d for d in (0.1, 0.2, 0.5, 1, 2, 5, 10, 20, 50, 100) if (top - floor) / d <= 10)
    for i in range(math.ceil(floor / step), math.floor(top / step) + 1):
        _, y = at((first, i * step))
        out.append(f'<line class="grid" x1="{LEFT}" y1="{y}" x2="{WIDTH - RIGHT}" y2="{y}"/>')
        out.append(f'<text x="{LEFT - 8}" y="{y + 4}" text-anchor="end">{i * step:g}</text>')
    middle = (TOP + HEIGHT - BOTTOM) / 2
    out.append(f'<text x="{(LEFT + WIDTH) / 2}" y="{HEIGHT - 14}" text-anchor="middle">seconds of the fit</text>')
    out.append(f'<text transform="translate(18 {middle}) rotate(-90)" text-anchor="middle">PSNR, held-out (dB)</text>')
    return out
