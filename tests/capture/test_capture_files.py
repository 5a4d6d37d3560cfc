"""Complete files pass, files that are truncated do not, metadata is read, photos are rotated upright."""

from __future__ import annotations

import struct
from pathlib import Path

import cv2
import numpy as np
import pytest

from stages.capture.exif import Exif, metres_from, read_exif
from stages.capture.import_photo import turn_upright
from stages.capture.integrity import fault_of

TEXTURE = np.random.default_rng(0).integers(0, 255, (600, 640, 3), np.uint8)


def encoded(kind: str, image: np.ndarray = TEXTURE, *options: int) -> bytes:
    ok, data = cv2.imencode(kind, image, list(options))
    assert ok
    return data.tobytes()


PROGRESSIVE = (cv2.IMWRITE_JPEG_PROGRESSIVE, 1)
RESTARTS = (cv2.IMWRITE_JPEG_RST_INTERVAL, 4)


@pytest.mark.parametrize(("kind", "options"), [
    (".jpg", ()), (".jpg", PROGRESSIVE), (".jpg", RESTARTS), (".png", ()), (".tiff", ()),
])  # fmt: skip
def test_whole_files_pass_and_every_cut_is_found(kind: str, options: tuple[int, ...]) -> None:
    data = encoded(kind, TEXTURE, *options)
    assert fault_of(data) is None
    for share in (0.01, 0.3, 0.7, 0.98):
        cut = data[: int(len(data) * share)]
        decoded = cv2.imdecode(np.frombuffer(cut, np.uint8), cv2.IMREAD_UNCHANGED)
        assert fault_of(cut) is not None or decoded is None, share
    if kind != ".tiff":  # its directory at the end closes the file
        assert fault_of(data[:-1]) is not None


def test_bytes_behind_the_end_are_no_fault() -> None:
    assert fault_of(encoded(".jpg") + b"\0" * 100) is None


def test_a_cut_jpeg_with_an_end_marker_put_on_is_found() -> None:
    data = encoded(".jpg")
    patched = data[: len(data) // 2] + b"\xff\xd9"
    decoded = cv2.imdecode(np.frombuffer(patched, np.uint8), cv2.IMREAD_UNCHANGED)
    assert decoded is not None and (decoded[-8:] == 128).all()  # the decoder filled in, and said nothing
    assert "last rows" in (fault_of(patched) or "")


@pytest.mark.parametrize("options", [(), PROGRESSIVE, (cv2.IMWRITE_JPEG_OPTIMIZE, 1)])
def test_a_photo_that_really_ends_in_mid_grey_passes(options: tuple[int, ...]) -> None:
    image = TEXTURE.copy()
    image[-64:] = 128
    assert (cv2.imdecode(np.frombuffer(encoded(".jpg", image, *options), np.uint8), -1)[-8:] == 128).all()
    assert fault_of(encoded(".jpg", image, *options)) is None
    grey = encoded(".jpg", np.full((600, 640), 128, np.uint8), *options)
    assert fault_of(grey) is None


def test_a_png_with_a_flipped_bit_is_found() -> None:
    data = bytearray(encoded(".png"))
    data[len(data) // 2] ^= 1
    assert "checksum" in (fault_of(bytes(data)) or "")


def test_a_tiff_whose_strips_lie_outside_is_found() -> None:
    # directory first, pixels behind it: cutting the end leaves a readable directory
    entries = [(256, 3, 1, 8), (257, 3, 1, 8), (273, 4, 1, 200), (279, 4, 1, 64)]
    ifd = struct.pack("<H", len(entries)) + b"".join(struct.pack("<HHII", *e) for e in entries) + b"\0" * 4
    data = (b"II*\0" + struct.pack("<I", 8) + ifd).ljust(264, b"\1")
    assert fault_of(data) is None
    assert "beyond the end" in (fault_of(data[:-1]) or "")


# ------------------------------------------------------------------ EXIF
def tiff_block(order: str, ifd0: list[tuple], sub: list[tuple], gps: list[tuple] = []) -> bytes:  # noqa: B006
    """A TIFF block with its directories; values: (tag, type, count, payload bytes)."""

    def directory(entries: list[tuple], at: int) -> bytes:
        head, extra = struct.pack(order + "H", len(entries)), b""
        data_at = at + 2 + 12 * len(entries) + 4
        for tag, kind, count, payload in entries:
            head += struct.pack(order + "HHI", tag, kind, count)
            if len(payload) <= 4:
                head += payload.ljust(4, b"\0")
            else:
                head += struct.pack(order + "I", data_at + len(extra))
                extra += payload
        return head + b"\0" * 4 + extra

    def first(sub_at: int, gps_at: int) -> bytes:
        links = [(0x8769, 4, 1, struct.pack(order + "I", sub_at))]
        links += [(0x8825, 4, 1, struct.pack(order + "I", gps_at))] if gps else []
        return directory([*ifd0, *links], 8)

    sub_at = 8 + len(first(0, 0))
    gps_at = sub_at + len(directory(sub, sub_at))
    mark = b"II*\0" if order == "<" else b"MM\0*"
    block = mark + struct.pack(order + "I", 8) + first(sub_at, gps_at) + directory(sub, sub_at)
    return block + (directory(gps, gps_at) if gps else b"")


def exif_jpeg(block: bytes, image: np.ndarray = TEXTURE) -> bytes:
    body = b"Exif\0\0" + block
    data = encoded(".jpg", image)
    return data[:2] + b"\xff\xe1" + struct.pack(">H", len(body) + 2) + body + data[2:]


def camera_block(order: str, orientation: int = 6) -> bytes:
    def rational(n: int, d: int) -> bytes:
        return struct.pack(order + "II", n, d)

    short = struct.Struct(order + "H").pack
    return tiff_block(
        order,
        [(0x10F, 2, 6, b"Maker\0"), (0x110, 2, 4, b"M 7\0"), (0x112, 3, 1, short(orientation))],
        [(0x920A, 5, 1, rational(850, 10)), (0xA405, 3, 1, short(127)), (0xA434, 2, 5, b"85mm\0"),
         (0xA002, 4, 1, struct.pack(order + "I", 4000)), (0xA20E, 5, 1, rational(4000, 3)), (0xA210, 3, 1, short(3))],
    )  # fmt: skip


@pytest.mark.parametrize("order", ["<", ">"])
def test_exif_of_a_jpeg_in_both_byte_orders(order: str) -> None:
    data = exif_jpeg(camera_block(order))
    exif = read_exif(data)
    assert (exif.orientation, exif.body) == (6, "Maker M 7 85mm")
    assert exif.focal_mm == 85 and exif.focal_35mm == 127
    # equivalent focal length: 127 mm on a frame with a diagonal of 43.267 mm
    assert exif.focal_px(640, 600) == pytest.approx(127 / 43.2666 * np.hypot(640, 600), rel=1e-5)
    assert fault_of(data) is None


def test_focal_length_from_the_sensor_s_resolution() -> None:
    # 85 mm, 4000 / 3 pixels per cm = 133.33 per mm, recorded 4000 wide, and the copy is 1000 wide
    exif = Exif(focal_mm=85, pixels_per_mm=4000 / 30, recorded_edge=4000)
    assert exif.focal_px(1000, 750) == pytest.approx(85 * 4000 / 30 / 4)
    assert Exif(focal_mm=85).focal_px(1000, 750) is None


@pytest.mark.parametrize(("x", "y"), [(4000, 6000), (6000, 4000), (6000, None), (None, 6000)])
def test_focal_length_of_a_portrait_photo_that_is_stored_upright(x: int | None, y: int | None) -> None:
    """A 36 x 24 mm sensor with 6000 pixels along its longer edge: 50 mm are 8333 pixels whichever way it was held."""
    rational = struct.Struct("<II").pack
    edges = [(tag, 4, 1, struct.pack("<I", n)) for tag, n in ((0xA002, x), (0xA003, y)) if n is not None]
    sensor = [(0xA20E, 5, 1, rational(60000, 36)), (0xA210, 3, 1, struct.pack("<H", 3))]
    block = tiff_block("<", [], [(0x920A, 5, 1, rational(50, 1)), *edges, *sensor])
    exif = read_exif(exif_jpeg(block))
    for size in ((4000, 6000), (6000, 4000)):
        assert exif.focal_px(*size) == pytest.approx(50 * 6000 / 36, rel=1e-5)
    assert exif.focal_px(1000, 1500) == pytest.approx(50 * 1500 / 36, rel=1e-5)


def test_exif_of_png_and_tiff() -> None:
    block = camera_block("<", 3)
    png = encoded(".png")
    chunk = struct.pack(">I", len(block)) + b"eXIf" + block + b"\0" * 4
    assert read_exif(png[:33] + chunk + png[33:]).orientation == 3
    assert read_exif(block).body == "Maker M 7 85mm"


def place_block(order: str, lat: tuple[int, int, int] = (33, 51, 2460), south: bool = True, iso: int = 400) -> bytes:
    """Exposure, automatic white balance and a place; the third of lat is in hundredths of a second of arc."""

    def rationals(*values: tuple[int, int]) -> bytes:
        return b"".join(struct.pack(order + "II", *v) for v in values)

    short = struct.Struct(order + "H").pack
    gps = [(1, 2, 2, b"S\0" if south else b"N\0"), (2, 5, 3, rationals((lat[0], 1), (lat[1], 1), (lat[2], 100))),
           (3, 2, 2, b"E\0"), (4, 5, 3, rationals((151, 1), (12, 1), (4000, 100))), (5, 1, 1, b"\0"),
           (6, 5, 1, rationals((585, 10)))]  # fmt: skip
    sub = [(0x829A, 5, 1, rationals((1, 50))), (0x829D, 5, 1, rationals((28, 10))), (0x8827, 3, 1, short(iso)),
           (0xA403, 3, 1, short(0))]  # fmt: skip
    return tiff_block(order, [], sub, gps)


@pytest.mark.parametrize("order", ["<", ">"])
def test_exposure_white_balance_and_place(order: str) -> None:
    exif = read_exif(exif_jpeg(place_block(order)))
    assert exif.exposure == pytest.approx(1 / 50 * 400 / 2.8**2) and exif.white_balance == "auto"
    assert exif.place == pytest.approx((-(33 + 51 / 60 + 24.6 / 3600), 151 + 12 / 60 + 40 / 3600, 58.5))
    assert read_exif(exif_jpeg(place_block(order, (95, 0, 0)))).place is None  # no such place
    assert read_exif(exif_jpeg(camera_block(order))).place is None
    assert read_exif(exif_jpeg(place_block(order, iso=0))).exposure is None


@pytest.mark.parametrize("order", ["<", ">"])
@pytest.mark.parametrize("value, fired", [(0x00, False), (0x01, True), (0x10, False), (0x19, True), (0xFFFF, None)])
def test_a_flash_that_fired_is_bit_0(order: str, value: int, fired: bool | None) -> None:
    block = tiff_block(order, [], [(0x9209, 3, 1, struct.pack(order + "H", value))], [])
    assert read_exif(exif_jpeg(block)).flash is fired
    assert read_exif(exif_jpeg(camera_block(order))).flash is None


def test_metres_from_a_place_agree_with_the_ellipsoid() -> None:
    """Oracle: both places in the earth's own axes, turned to east, north and up at the first."""

    def earth(lat: float, lon: float, up: float) -> np.ndarray:
        a, e2 = 6_378_137.0, 0.00669437999014
        lat, lon = np.radians([lat, lon])
        n = a / np.sqrt(1 - e2 * np.sin(lat) ** 2)
        return np.array([(n + up) * np.cos(lat) * np.cos(lon), (n + up) * np.cos(lat) * np.sin(lon),
                         (n * (1 - e2) + up) * np.sin(lat)])  # fmt: skip

    for lat, lon in ((-33.85, 151.2), (70.0, 179.9999), (0.0, 0.0)):
        p, q = (lat, lon, 10.0), (lat + 3e-4, (lon + 4e-4 + 180) % 360 - 180, 13.0)
        phi, theta = np.radians([lat, lon])
        up = np.array([np.cos(phi) * np.cos(theta), np.cos(phi) * np.sin(theta), np.sin(phi)])
        east = np.array([-np.sin(theta), np.cos(theta), 0])
        axes = np.stack([east, np.cross(up, east), up])
        np.testing.assert_allclose(metres_from(q, p), axes @ (earth(*q) - earth(*p)), atol=2e-3)


def test_places_are_told_from_the_first(tmp_path: Path, gather) -> None:
    for i in range(4):
        block = place_block("<", (33, 51, 2460 - 100 * i)) if i else camera_block("<", 1)
        image = np.roll(TEXTURE[:160, :200], 20 * i, 1)
        (tmp_path / f"{i}.jpg").write_bytes(exif_jpeg(block, image))
    found = gather(tmp_path)
    views = found.artifact.views
    assert views[0].place_m is None and views[1].place_m == (0, 0, 0)
    assert views[3].place_m == pytest.approx((0, 2 * 30.81, 0), abs=0.1)  # a second of arc at 34 degrees south
    assert "151" not in str([v.place_m for v in views])


@pytest.mark.parametrize(
    "data", [b"", b"\xff\xd8", b"\xff\xd8\xff\xe1\x00\x08Exif\0\0", b"II*\0", b"II*\0\xff\xff\xff\xff"]
)
def test_damaged_metadata_gives_nothing(data: bytes) -> None:
    assert read_exif(data) == Exif()


def test_metadata_that_points_anywhere_never_raises() -> None:
    """And what it then says can be worked with: a known orientation, lengths that are above 0 or unknown."""
    random, whole = np.random.default_rng(1), read_exif(exif_jpeg(camera_block("<"), TEXTURE[:64, :64]))
    block, as_before = bytearray(camera_block("<")), 0
    for _ in range(300):
        broken = bytearray(block)
        for at in random.integers(4, len(broken), 6):
            broken[at] = random.integers(256)
        found = read_exif(exif_jpeg(bytes(broken), TEXTURE[:64, :64]))
        assert found.orientation in range(1, 9)
        for length in (found.focal_mm, found.focal_35mm, found.pixels_per_mm, found.exposure):
            assert length is None or 0 < length < float("inf"), found
        as_before += found.focal_mm == whole.focal_mm
    assert 30 < as_before < 270, "some blocks are still read, others are not"


@pytest.mark.parametrize("orientation", range(1, 9))
def test_upright_is_what_opencv_shows(orientation: int, tmp_path: Path) -> None:
    """Oracle: imdecode in colour applies the orientation itself."""
    image = cv2.GaussianBlur(TEXTURE[:160, :200], (0, 0), 4)
    data = np.frombuffer(exif_jpeg(camera_block("<", orientation), image), np.uint8)
    stored = cv2.imdecode(data, cv2.IMREAD_UNCHANGED)
    assert stored.shape == image.shape  # not turned by itself
    np.testing.assert_array_equal(turn_upright(stored, orientation), cv2.imdecode(data, cv2.IMREAD_COLOR))
