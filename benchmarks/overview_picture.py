"""The README's picture: photos in, asset out.

    make demo
    python -m benchmarks.overview_picture out/demo --out docs/pictures/overview.jpg

Upper row: three photos of the demo capture, a photo that was held out of the fit, and the exported asset seen by the
same camera. Lower row: base colour, specular F0, roughness and normal map, and the asset under a light that no photo
was taken under.
"""

from __future__ import annotations

import argparse
import subprocess
import sys
import tempfile
from pathlib import Path

import cv2
import numpy as np
import numpy.typing as npt

from pipeline.images import write_exr

U8 = npt.NDArray[np.uint8]
SIDE, GAP, LINE = 240, 8, 26  # pixels of a picture, between two, and of a caption
MAPS = (("albedo", "base colour"), ("f0", "specular F0"), ("roughness", "roughness"), ("normal", "normal"))


def main() -> int:
    """Write the picture; see above."""
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("run", type=Path, help="the --out of a demo")
    parser.add_argument("--out", type=Path, required=True)
    given = parser.parse_args()
    held = held_out(given.run)
    used = [i for i in (1, 14, 25) if i not in held]
    photo = {i: read(given.run / "capture" / f"{i}.png") for i in (*used, held[0])}
    upper = [(photo[i], "photo") for i in used]
    upper += [(photo[held[0]], "photo, not used"), (rendered(given.run, held[0]), "asset, same camera")]
    textures = given.run / "asset" / "textures"
    charts = read(next((given.run / "asset" / "internal").glob("*_coverage.png"))) > 60
    lower = [
        (np.where(charts, stretched(read(next(textures.glob(f"*_{name}.png")))), np.uint8(255)), caption)
        for name, caption in MAPS
    ]
    lower.append((relit(given.run, held[0]), "asset, new light"))
    picture = np.concatenate([strip(upper), strip(lower)])
    given.out.parent.mkdir(parents=True, exist_ok=True)
    cv2.imwrite(str(given.out), picture, [cv2.IMWRITE_JPEG_QUALITY, 88])
    return 0


def held_out(run: Path) -> list[int]:
    """Indices of the photos that were kept from the fit."""
    return sorted(int(p.stem) for p in (run / "report" / "asset_views").glob("*.png"))


def rendered(run: Path, view: int) -> U8:
    """The exported asset seen by a photo's camera."""
    return read(run / "report" / "asset_views" / f"{view}.png")


def relit(run: Path, view: int) -> U8:
    """The same under a warm window on one side and a blue one on the other."""
    with tempfile.TemporaryDirectory() as folder:
        light = np.full((64, 128, 3), 0.08, np.float32)
        light[14:40, 84:104], light[10:46, 14:34] = (9.0, 5.4, 2.7), (0.7, 1.5, 3.2)
        write_exr(Path(folder) / "light.exr", light)
        command = [sys.executable, "-m", "workflows.cli", "render", str(run), "--out", folder, "--views", str(view),
                   "--env", str(Path(folder) / "light.exr")]  # fmt: skip
        subprocess.run(command, check=True, stdout=subprocess.DEVNULL)
        return read(next(Path(folder).rglob("*.png")))


def read(path: Path) -> U8:
    """An 8-bit picture, BGR, on black where it is transparent, SIDE pixels square."""
    image = cv2.imread(str(path), cv2.IMREAD_UNCHANGED)
    if image is None:
        raise SystemExit(f"{path} is not there or no picture")
    image = np.asarray(image if image.dtype == np.uint8 else image // 257, np.uint8)
    if image.ndim == 2:
        image = cv2.cvtColor(image, cv2.COLOR_GRAY2BGR)
    if image.shape[2] == 4:
        alpha = image[..., 3:] / 255
        image = np.asarray(image[..., :3] * alpha, np.uint8)
    return np.asarray(cv2.resize(image, (SIDE, SIDE), interpolation=cv2.INTER_AREA), np.uint8)


def stretched(image: U8) -> U8:
    """A map whose values are all dark, brighter by one factor: F0 of skin is .03."""
    top = float(np.percentile(image, 99.5))
    return image if top > 100 else np.asarray((image * (170 / max(top, 1))).clip(0, 255), np.uint8)


def strip(pictures: list[tuple[U8, str]]) -> U8:
    """Pictures side by side with their captions below."""
    columns = []
    for image, caption in pictures:
        label = np.full((LINE, SIDE, 3), 255, np.uint8)
        cv2.putText(label, caption, (4, 17), cv2.FONT_HERSHEY_SIMPLEX, 0.48, (40, 40, 40), 1, cv2.LINE_AA)
        columns += [np.concatenate([image, label]), np.full((SIDE + LINE, GAP, 3), 255, np.uint8)]
    return np.concatenate(columns[:-1], 1)


if __name__ == "__main__":
    raise SystemExit(main())
