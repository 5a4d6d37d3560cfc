"""The page is one sound HTML file that needs nothing else, and the figures are those of the artifacts."""

from __future__ import annotations

import base64
import json
import re
from dataclasses import replace
from html.parser import HTMLParser
from pathlib import Path

import cv2
import numpy as np
import pytest
from support.synthetic_results import SyntheticResults, write_results

from pipeline.artifacts import FittedPhoto, Located
from pipeline.contract import Context
from pipeline.errors import Cancelled
from stages.report.page import with_timing
from stages.report.pictures import ERROR_RANGE, data_uri, error_map, heat, map_picture
from stages.report.stage import STAGE, Config, Inputs

VOID = {"meta", "img", "br", "hr", "link", "input"}


def run(results: SyntheticResults, folder: Path, **context: object) -> tuple[dict, str]:
    folder.mkdir(parents=True)
    named = {n: getattr(results, n) for n in Inputs.__slots__}
    artifact = STAGE.run(Inputs(**named), Config(), Context(folder, folder / "scratch", **context))
    assert [f.path for f in artifact.files] == ["index.html", "metrics.json"]
    return json.loads((folder / "metrics.json").read_text()), (folder / "index.html").read_text()


@pytest.fixture(scope="module")
def results(tmp_path_factory: pytest.TempPathFactory) -> SyntheticResults:
    return write_results(tmp_path_factory.mktemp("results"))


@pytest.fixture(scope="module")
def made(results: SyntheticResults, tmp_path_factory: pytest.TempPathFactory) -> tuple[dict, str]:
    return run(results, tmp_path_factory.mktemp("report") / "work")


class Page(HTMLParser):
    """Collects what the page refers to and whether its tags close in order."""

    def __init__(self, text: str) -> None:
        super().__init__(convert_charrefs=True)
        self.open: list[str] = []
        self.wrong: list[str] = []
        self.links: list[str] = []
        self.words: list[str] = []
        self.feed(text)

    def handle_starttag(self, tag: str, attrs: list[tuple[str, str | None]]) -> None:
        if tag not in VOID:
            self.open.append(tag)
        found = [v or "" for k, v in attrs if k in ("src", "href", "action", "data", "srcset", "poster")]
        self.links += [v for v in found if (tag, v) != ("link", "data:,")]  # an empty icon: no server is asked for one
        self.wrong += [f"{tag} {k}" for k, _ in attrs if k.startswith("on")]

    def handle_endtag(self, tag: str) -> None:
        if not self.open or self.open.pop() != tag:
            self.wrong.append(tag)

    def handle_data(self, data: str) -> None:
        self.words.append(data)


def test_page_parses_and_refers_to_nothing_outside(made: tuple[dict, str]) -> None:
    page = Page(made[1])
    assert page.wrong == []
    assert page.open == []
    assert page.links
    assert all(x.startswith("data:image/") for x in page.links)
    assert not re.search(r"(https?:)?//[a-z]|@import|url\(", re.sub(r"data:image/[^\"]+", "", made[1]))
    assert "default-src 'none'" in made[1]


def test_every_picture_decodes(made: tuple[dict, str]) -> None:
    """As the kind that its address names; most of them show more than one colour."""
    links, seen = Page(made[1]).links, []
    assert len(links) > 8
    for uri in links:
        head, _, code = uri.partition("base64,")
        content = base64.b64decode(code, validate=True)
        start = {"data:image/png;": b"\x89PNG", "data:image/jpeg;": b"\xff\xd8\xff", "data:image/webp;": b"RIFF"}[head]
        assert content.startswith(start)
        shown = cv2.imdecode(np.frombuffer(content, np.uint8), cv2.IMREAD_UNCHANGED)
        assert shown is not None and min(shown.shape[:2]) > 4
        seen.append(np.ptp(shown) > 0)
    assert sum(seen) > len(seen) / 2


def test_the_page_has_a_film_in_two_lights(made: tuple[dict, str]) -> None:
    films = re.findall(r'src="data:image/webp;base64,([^"]+)" alt="(one turn[^"]*)"', made[1])
    assert [text for _, text in films] == ["one turn, captured light", "one turn, sunset"]
    assert all(b"ANMF" in base64.b64decode(data) for data, _ in films)


def test_metrics_have_the_keys_that_others_read(made: tuple[dict, str]) -> None:
    metrics = made[0]
    assert {"views", "psnr", "ssim", "flip", "per_view", "asset_psnr", "asset_ssim", "asset_flip"} <= metrics[
        "holdout"
    ].keys()
    assert {"vertices", "faces", "watertight", "components"} <= metrics["surface"].keys()
    assert {"charts", "utilisation", "stretch"} <= metrics["uv"].keys()
    assert metrics["holdout"]["views"] == 2
    assert set(metrics["holdout"]["per_view"]) == {"3", "9"}
    assert metrics["model"]["specular"]["modelled"] is True
    assert metrics["warnings"] == ["surface: two floating pieces were removed"]
    assert metrics["timing"] == {}


def test_the_page_says_which_mask_each_score_used(results: SyntheticResults, tmp_path: Path) -> None:
    masks = results.masks.artifact
    sources = {m.index: ("given" if m.index == 3 else "person") for m in masks.masks}
    changed = masks.model_copy(
        update={"masks": tuple(m.model_copy(update={"source": sources[m.index]}) for m in masks.masks)}
    )
    metrics, page = run(replace(results, masks=Located(changed, results.masks.folder)), tmp_path / "work")
    assert metrics["holdout"]["masks"] == {"3": "given", "9": "person"}
    rows = {i: page.split(f"<tr><td>{i}</td>")[1].split("</tr>")[0] for i in ("3", "9")}
    assert rows["3"].endswith("<td>given</td>") and rows["9"].endswith("<td>person</td>")


def test_the_page_and_the_metrics_have_the_weight_of_each_fitted_photo(
    results: SyntheticResults, tmp_path: Path
) -> None:
    face = results.inverse_rendering
    index = face.artifact.fitted_views[0]
    photo = FittedPhoto(index=index, psnr=31.25, weight=0.625, low_share=0.125)
    changed = Located(face.artifact.model_copy(update={"photos": (photo,)}), face.folder)
    metrics, page = run(replace(results, inverse_rendering=changed), tmp_path / "work")
    assert metrics["photos"] == {str(index): {"psnr": 31.25, "weight": 0.625, "low_share": 0.125}}
    assert page.count("<td>31.25</td><td>0.625</td><td>0.125</td></tr>") == 1


def test_scores_are_right(made: tuple[dict, str]) -> None:
    """The photo is 0.6 to 1 of (0.4, 0.25, 0.2) in the disc; the asset shows (0.3, 0.2, 0.15) exactly there."""
    h = made[0]["holdout"]
    assert h["asset_mask_iou"] == 1
    assert 30 < h["asset_psnr"] < 35
    assert h["psnr"] < 15  # the model's stand-in is a grey card
    assert h["asset_psnr"] == pytest.approx(np.mean([v["asset_psnr"] for v in h["per_view"].values()]))


def test_photos_with_colours_of_their_own_are_shown_in_them(results: SyntheticResults, tmp_path: Path) -> None:
    """The asset is 0.75 as bright as the photo: that goes, where the fit found that photos differ."""
    fit = results.inverse_rendering.artifact
    facts = {**fit.model, "calibration": {"modelled": True}}
    changed = replace(
        results, inverse_rendering=Located(fit.model_copy(update={"model": facts}), results.inverse_rendering.folder)
    )
    metrics, page = run(changed, tmp_path / "work")
    plain, plain_page = run(results, tmp_path / "plain")
    assert metrics["holdout"] == plain["holdout"]
    assert metrics["holdout"]["asset_psnr_matched"] > metrics["holdout"]["asset_psnr"]
    assert "PSNR in the photos' colours" in page.replace("&#39;", "'")
    assert "in the photos' colours" not in plain_page.replace("&#39;", "'")
    assert len(set(Page(page).links) - set(Page(plain_page).links)) >= 2  # the asset and its error


def test_warnings_come_before_figures(made: tuple[dict, str]) -> None:
    page = made[1]
    assert page.index("two floating pieces") < page.index("PSNR, model") < page.index("View 3")


def test_same_results_same_bytes(results: SyntheticResults, made: tuple[dict, str], tmp_path: Path) -> None:
    assert run(results, tmp_path / "again")[1] == made[1]


def test_timing_is_filled_in_from_outside(made: tuple[dict, str]) -> None:
    page = with_timing(made[1], {"capture": 1.25, "</script><b>": 2.0})
    again = with_timing(page, {"capture": 7.0, "total": 7.0})
    island = re.search(r'id="timing">(.*?)</script>', again, re.S)
    assert island is not None
    assert json.loads(island[1]) == {"capture": 7.0, "total": 7.0}
    assert "7.0 s" in again
    assert "1.2 s" not in again
    assert Page(page).wrong == []
    assert with_timing(made[1], {}) == made[1]


def test_no_held_out_view_is_said_clearly(tmp_path: Path) -> None:
    metrics, page = run(write_results(tmp_path / "in", held_out=(), asset_views=(0, 6)), tmp_path / "work")
    assert metrics["holdout"]["held_out"] is False
    assert metrics["holdout"]["views"] == 2
    assert metrics["holdout"]["psnr"] is None
    assert metrics["holdout"]["asset_psnr"] > 30
    assert "No photo was held out." in page
    assert "FITTED photos" in page
    assert "Held-out views" not in page


def test_no_view_at_all(tmp_path: Path) -> None:
    metrics, page = run(write_results(tmp_path / "in", held_out=(), asset_views=()), tmp_path / "work")
    assert metrics["holdout"]["views"] == 0
    assert metrics["holdout"]["worst_view"] is None
    assert Page(page).wrong == []


def test_views_rendered_smaller_are_compared_with_the_shrunk_photo(tmp_path: Path) -> None:
    metrics, _ = run(write_results(tmp_path / "in", scale=2), tmp_path / "work")
    assert 30 < metrics["holdout"]["asset_psnr"] < 36


def test_a_held_out_view_without_mask_is_reported(results: SyntheticResults, tmp_path: Path) -> None:
    masks = results.masks.artifact
    fewer = masks.model_copy(update={"masks": tuple(m for m in masks.masks if m.index != 3)})
    changed = replace(results, masks=Located(fewer, results.masks.folder))
    metrics, _ = run(changed, tmp_path / "work")
    assert metrics["holdout"]["views"] == 1
    assert any("view 3 has no mask" in w for w in metrics["warnings"])


def test_what_stages_left_out_becomes_a_warning(results: SyntheticResults, tmp_path: Path) -> None:
    poses = results.poses.artifact.model_copy(update={"metric": False, "unregistered": ("x.jpg",)})
    capture = results.capture.artifact.model_copy(update={"left_out": ("y.jpg: blurred <b>",)})
    changed = replace(
        results, poses=Located(poses, results.poses.folder), capture=Located(capture, results.capture.folder)
    )
    metrics, page = run(changed, tmp_path / "work")
    text = " ".join(metrics["warnings"])
    assert "x.jpg" in text
    assert "scale is unknown" in text
    assert "y.jpg: blurred <b>" in "".join(Page(page).words)  # escaped, not markup


def test_a_cancelled_report_stops(results: SyntheticResults, tmp_path: Path) -> None:
    with pytest.raises(Cancelled):
        run(results, tmp_path / "work", cancelled=lambda: True)


def test_error_map_is_dark_where_equal_and_bright_where_not() -> None:
    photo = np.full((8, 8, 3), 0.2, np.float32)
    mask = np.ones((8, 8), np.float32)
    render = np.concatenate([photo, mask[..., None]], -1)
    render[:, 4:, :3] = 1.0
    found = error_map(render, photo, mask).astype(int).sum(-1)
    assert (found[:, :4] < 20).all()
    assert (found[:, 4:] > 550).all()
    assert (np.diff(heat(np.linspace(0, 1, 64, dtype=np.float32)[None]).astype(int).sum(-1)[0]) >= -2).all()
    assert 0 < ERROR_RANGE < 1


def test_map_pictures() -> None:
    ramp = np.linspace(3, 5, 101, dtype=np.float32)[None, :, None]
    stretched = map_picture(ramp, "raw")[0, :, 0]
    assert stretched[0] == 0
    assert stretched[-1] == 255
    assert (map_picture(np.full((2, 2, 1), 0.2, np.float32), "raw") == 51).all()
    assert (map_picture(np.full((2, 2, 1), 40.0, np.float32), "raw") == 128).all()
    assert (map_picture(np.full((2, 2, 3), [-0.5, 0, 1], np.float32), "raw")[0, 0] == [64, 128, 255]).all()


@pytest.mark.parametrize("shape", [(3, 500, 3), (500, 3, 4), (1, 1, 3)])
def test_pictures_are_never_larger_than_asked(shape: tuple[int, int, int]) -> None:
    uri = data_uri(np.zeros(shape, np.uint8), 100)
    image = cv2.imdecode(np.frombuffer(base64.b64decode(uri.partition(",")[2]), np.uint8), cv2.IMREAD_UNCHANGED)
    assert max(image.shape[:2]) <= 100
    assert image.shape[2] == shape[2]


def test_tiles_stand_next_to_each_other_and_regions_have_their_shares(tmp_path: Path) -> None:
    made = write_results(tmp_path, tiled=True)
    regions = {"unlabelled": 0.25, "face": 0.75}
    bake = made.bake.artifact.model_copy(update={"regions": regions, "figures": {"texel_mm": 0.5}})
    metrics, page = run(replace(made, bake=replace(made.bake, artifact=bake)), tmp_path / "work")
    assert metrics["regions"] == regions and metrics["maps"]["tiles"] == metrics["uv"]["tiles"] == 2
    assert metrics["uv"]["utilisation_1002"] == 0.92 and metrics["maps"]["texel_mm"] == 0.5
    words = " ".join(" ".join(Page(page).words).split())
    assert "2 × 128² texels" in words and "face 75.0 %" in words
    albedo = page[page[: page.index("albedo, mean")].rindex("base64,") + 7 :].partition('"')[0]
    picture = cv2.imdecode(np.frombuffer(base64.b64decode(albedo), np.uint8), cv2.IMREAD_COLOR)
    height, width = picture.shape[:2]
    assert width == 2 * height
    red = picture[..., 2].astype(float).mean(0)  # grows with u over both tiles
    assert red[: width // 2].max() < red[width // 2 :].min() + 6 and red[-1] > red[0] + 40
