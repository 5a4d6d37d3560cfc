"""A minimal EXIF reader: the TIFF tags that the pipeline uses.

These are orientation, focal length, make, model, lens, exposure, white balance, flash and GPS position. A file with
damaged or no metadata gives an empty `Exif`, never an error: metadata is optional. Source: EXIF 2.32 (CIPA DC-008),
TIFF 6.0.
"""

from __future__ import annotations

import math
import struct
from collections.abc import Iterator
from dataclasses import dataclass

Tags = dict[int, tuple[float, ...] | str]

MAKE, MODEL, ORIENTATION, EXIF_IFD = 0x10F, 0x110, 0x112, 0x8769
FOCAL_MM, FOCAL_35MM, PIXEL_X, PIXEL_Y, LENS = 0x920A, 0xA405, 0xA002, 0xA003, 0xA434
PLANE_X_RESOLUTION, PLANE_UNIT = 0xA20E, 0xA210
GPS_IFD, LAT_REF, LAT, LON_REF, LON, ALT_REF, ALT = 0x8825, 1, 2, 3, 4, 5, 6
EXPOSURE_S, F_NUMBER, ISO, WHITE_BALANCE, FLASH = 0x829A, 0x829D, 0x8827, 0xA403, 0x9209
COLOUR_SPACE, INTEROP_IFD, INTEROP_INDEX, ICC_PROFILE = 0xA001, 0xA005, 1, 34675
ADOBE_RGB, UNCALIBRATED = "Adobe RGB, by EXIF", "uncalibrated"
WHITE_BALANCES: dict[tuple[float, ...], str] = {(0,): "auto", (1,): "manual"}
EARTH_M, FLATTENING = 6_378_137.0, 1 / 298.257223563  # WGS 84
FULL_FRAME_DIAGONAL_MM = math.hypot(36.0, 24.0)  # CIPA DC-X001: equivalent focal lengths compare diagonals
FOCAL = (0.05, 100.0)  # of the longest edge: values outside come from damaged metadata
_UNIT_MM = {2: 25.4, 3: 10.0, 4: 1.0, 5: 0.001}
_TYPES = {1: ("B", 1), 2: ("s", 1), 3: ("H", 2), 4: ("I", 4), 5: ("II", 8), 7: ("B", 1), 9: ("i", 4), 10: ("ii", 8),
          16: ("Q", 8)}  # fmt: skip
_MAX_TAGS, _MAX_VALUES = 1000, 1_000_000
_WANTED = {
    MAKE,
    MODEL,
    ORIENTATION,
    EXIF_IFD,
    FOCAL_MM,
    FOCAL_35MM,
    PIXEL_X,
    PIXEL_Y,
    LENS,
    PLANE_X_RESOLUTION,
    PLANE_UNIT,
    GPS_IFD,
    LAT_REF,
    LAT,
    LON_REF,
    LON,
    ALT_REF,
    ALT,
    EXPOSURE_S,
    F_NUMBER,
    ISO,
    WHITE_BALANCE,
    FLASH,
    COLOUR_SPACE,
    INTEROP_IFD,
    INTEROP_INDEX,
    ICC_PROFILE,
    273,
    279,
    324,
    325,
}  # fmt: skip  (the last four: offsets and sizes of a TIFF's strips and tiles)


@dataclass(frozen=True, slots=True)
class Exif:
    """orientation: 1..8 as in EXIF. body: "make model lens", "" if unknown. Focal lengths in mm, None if unknown.
    recorded_edge: the longer edge of the frame as recorded, pixels.

    exposure: seconds x ISO / f-number^2, to which the linear value of a grey is proportional; None if one is missing.
    white_balance: auto, manual, or "" if unknown. colours: ADOBE_RGB, UNCALIBRATED (not sRGB), or None. flash: whether
    a flash fired, None if unknown. place: degrees north, degrees east, metres up.
    """

    orientation: int = 1
    body: str = ""
    focal_mm: float | None = None
    focal_35mm: float | None = None
    pixels_per_mm: float | None = None
    recorded_edge: int | None = None
    exposure: float | None = None
    white_balance: str = ""
    flash: bool | None = None
    place: tuple[float, float, float] | None = None
    colours: str | None = None

    def focal_px(self, width: int, height: int) -> float | None:
        """Focal length in pixels of an image of width x height, or None."""
        found = None
        if self.focal_35mm:
            found = self.focal_35mm / FULL_FRAME_DIAGONAL_MM * math.hypot(width, height)
        elif self.focal_mm and self.pixels_per_mm and self.recorded_edge:
            # the resolution is that of the recorded frame; a copy that was scaled down has fewer pixels per millimetre
            found = self.focal_mm * self.pixels_per_mm * max(width, height) / self.recorded_edge
        low, high = FOCAL
        return found if found is not None and low <= found / max(width, height) <= high else None


def read_exif(data: bytes) -> Exif:
    """Metadata of a JPEG, PNG (eXIf) or TIFF file from its bytes."""
    block = _exif_block(data)
    if block is None:
        return Exif()
    tags = first_ifd(block)
    offset = tags.get(EXIF_IFD)
    if isinstance(offset, tuple) and offset:
        tags = tags | _ifd(block, int(offset[0]))
    unit = _UNIT_MM.get(int(_number(tags, PLANE_UNIT) or 2))
    resolution = _number(tags, PLANE_X_RESOLUTION)
    orientation = int(_number(tags, ORIENTATION) or 1)
    # the longer edge: of a portrait photo that is stored upright, X is the shorter one
    edge = max(_number(tags, PIXEL_X) or 0, _number(tags, PIXEL_Y) or 0)
    return Exif(
        orientation=orientation if 1 <= orientation <= 8 else 1,
        body=" ".join(t for t in (_text(tags, MAKE), _text(tags, MODEL), _text(tags, LENS)) if t),
        focal_mm=_number(tags, FOCAL_MM),
        focal_35mm=_number(tags, FOCAL_35MM),
        pixels_per_mm=resolution / unit if resolution and unit else None,
        recorded_edge=int(edge) or None,
        exposure=_exposure(tags),
        white_balance=WHITE_BALANCES.get(_values_of(tags, WHITE_BALANCE)[:1], ""),
        flash=_fired(_values_of(tags, FLASH)),
        place=_place(_ifd(block, int(_values_of(tags, GPS_IFD)[0])) if _values_of(tags, GPS_IFD) else {}),
        colours=_colours(block, tags),
    )


def metres_from(place: tuple[float, float, float], origin: tuple[float, float, float]) -> tuple[float, float, float]:
    """East, north and up in metres of a place near another (degrees north, east; metres up), on the ellipsoid WGS 84.

    m = a (1 - e^2) / w^3,  n = a / w,  w^2 = 1 - e^2 sin^2(lat); north = m dlat, east = n cos(lat) dlon
    """
    lat, eccentricity = math.radians(origin[0]), FLATTENING * (2 - FLATTENING)
    w = math.sqrt(1 - eccentricity * math.sin(lat) ** 2)
    around = (place[1] - origin[1] + 180) % 360 - 180
    east = EARTH_M / w * math.cos(lat) * math.radians(around)
    north = EARTH_M * (1 - eccentricity) / w**3 * math.radians(place[0] - origin[0])
    return east, north, place[2] - origin[2]


def _fired(value: tuple[float, ...]) -> bool | None:
    """Bit 0 of the tag Flash."""
    known = len(value) == 1 and math.isfinite(value[0]) and 0 <= value[0] < 256
    return bool(int(value[0]) & 1) if known else None


def _colours(block: bytes, tags: Tags) -> str | None:
    """What EXIF says of colours that are not sRGB. Cameras that are set to Adobe RGB write "uncalibrated", and name it
    in the directory of interoperability (R03, of the DCF standard); some programs write 2."""
    space, at = _number(tags, COLOUR_SPACE), _values_of(tags, INTEROP_IFD)[:1]
    if space not in (2, 65535):
        return None
    index = _text(_ifd(block, int(at[0])), INTEROP_INDEX) if at and math.isfinite(at[0]) and at[0] >= 0 else ""
    if index == "R98":
        return None  # sRGB after all
    return ADOBE_RGB if space == 2 or index == "R03" else UNCALIBRATED


def _exposure(tags: Tags) -> float | None:
    seconds, stop, iso = (_number(tags, t) for t in (EXPOSURE_S, F_NUMBER, ISO))
    return seconds * iso / stop**2 if seconds and stop and iso else None


def _place(gps: Tags) -> tuple[float, float, float] | None:
    """Degrees north and east, metres up; None if an angle is missing or out of range."""
    angles = []
    for tag, ref, negative, limit in ((LAT, LAT_REF, "S", 90), (LON, LON_REF, "W", 180)):
        dms = _values_of(gps, tag)
        if len(dms) != 3 or not all(math.isfinite(v) for v in dms):
            return None
        angle = dms[0] + dms[1] / 60 + dms[2] / 3600
        if not 0 <= angle <= limit:
            return None
        angles.append(-angle if _text(gps, ref).startswith(negative) else angle)
    below = _values_of(gps, ALT_REF) == (1,)
    up = _number(gps, ALT) or 0.0
    return angles[0], angles[1], -up if below else up


def jpeg_segments(data: bytes) -> Iterator[tuple[int, int, int]]:
    """(marker, first byte, end) of each segment of a JPEG's header, up to the first SOS (0xDA), which is included."""
    at = 2
    while at + 4 <= len(data) and data[at] == 0xFF:
        marker = data[at + 1]
        if marker == 0xFF:  # fill byte
            at += 1
            continue
        end = at + 2 + int.from_bytes(data[at + 2 : at + 4], "big")
        yield marker, at + 4, end
        if marker == 0xDA:
            return
        at = end


def png_chunks(data: bytes) -> Iterator[tuple[bytes, int, int]]:
    """(type, first byte, end) of each chunk of a PNG; `end` may lie beyond the data if the file is cut off."""
    at = 8
    while at + 12 <= len(data):
        length = int.from_bytes(data[at : at + 4], "big")
        yield data[at + 4 : at + 8], at + 8, at + 8 + length
        at += 12 + length


def is_tiff(data: bytes) -> bool:
    """Whether a file is a TIFF, or a BigTIFF, whose offsets and counts have eight bytes."""
    return data[:4] in (b"II*\0", b"MM\0*") or _is_big(data)


def first_ifd(block: bytes) -> Tags:
    """Tags of a TIFF block's first directory; empty if it is damaged."""
    at, offset = (8, "Q") if _is_big(block) else (4, "I")
    if not is_tiff(block) or len(block) < 2 * at:
        return {}
    return _ifd(block, struct.unpack_from(_order(block) + offset, block, at)[0])


def _exif_block(data: bytes) -> bytes | None:
    if data[:2] == b"\xff\xd8":
        blocks = (data[a:b] for m, a, b in jpeg_segments(data) if m == 0xE1)
        return next((b[6:] for b in blocks if b[:6] == b"Exif\0\0"), None)
    if data[:8] == b"\x89PNG\r\n\x1a\n":
        return next((data[a:b] for t, a, b in png_chunks(data) if t == b"eXIf"), None)
    return data if is_tiff(data) else None


def _is_big(data: bytes) -> bool:
    return data[:4] in (b"II+\0", b"MM\0+")


def _order(block: bytes) -> str:
    return "<" if block[:2] == b"II" else ">"


def _ifd(block: bytes, offset: int) -> Tags:
    """The tags of one directory, without entries that point outside the block."""
    order, tags, big = _order(block), Tags(), _is_big(block)
    length, offset_code, head = (8, "Q", 12) if big else (2, "I", 8)  # of the number of entries, and before the value
    room = struct.calcsize("<" + offset_code)
    if offset + length > len(block):
        return tags
    for i in range(min(struct.unpack_from(order + ("Q" if big else "H"), block, offset)[0], _MAX_TAGS)):
        entry = offset + length + (head + room) * i
        if entry + head + room > len(block):
            break
        tag, kind, count = struct.unpack_from(f"{order}HH{offset_code}", block, entry)
        code, size = _TYPES.get(kind, ("", 0))
        if not size or count > _MAX_VALUES or tag in tags or tag not in _WANTED:
            continue
        inline = size * count <= room
        at = entry + head if inline else struct.unpack_from(order + offset_code, block, entry + head)[0]
        if at + size * count <= len(block):
            tags[tag] = _values(block, order, code, at, count)
    return tags


def _values(block: bytes, order: str, code: str, at: int, count: int) -> tuple[float, ...] | str:
    if code == "s":
        return block[at : at + count].split(b"\0")[0].decode("latin-1").strip()
    raw = struct.unpack_from(f"{order}{count * len(code)}{code[0]}", block, at)
    if len(code) == 1:
        return raw
    return tuple(n / d if d else math.nan for n, d in zip(raw[::2], raw[1::2], strict=True))


def _number(tags: Tags, tag: int) -> float | None:
    """A tag's first value if it is a positive finite number; cameras write 0 for unknown."""
    value = tags.get(tag)
    if not isinstance(value, tuple) or not value or not math.isfinite(value[0]) or value[0] <= 0:
        return None
    return float(value[0])


def _values_of(tags: Tags, tag: int) -> tuple[float, ...]:
    value = tags.get(tag)
    return value if isinstance(value, tuple) else ()


def _text(tags: Tags, tag: int) -> str:
    value = tags.get(tag)
    return value if isinstance(value, str) else ""
