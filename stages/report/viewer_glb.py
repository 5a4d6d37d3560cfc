"""The asset's glb as the page holds it: its pictures as WebP, pixel by pixel the same, and all of it as gzip."""

from __future__ import annotations

import gzip
import json
import struct

import cv2
import numpy as np

from stages.report.pictures import lossless_webp

HEAD, CHUNK = struct.Struct("<4sII"), struct.Struct("<I4s")


def packed_glb(content: bytes) -> bytes:
    """A gzip file of the glb with WebP in place of PNG."""
    length = CHUNK.unpack_from(content, HEAD.size)[0]
    start = HEAD.size + CHUNK.size
    document = json.loads(content[start : start + length])
    binary = content[start + length + CHUNK.size :]
    pictures = {i["bufferView"]: i for i in document.get("images", [])}
    data = bytearray()
    for number, view in enumerate(document["bufferViews"]):
        first = view.get("byteOffset", 0)
        part = binary[first : first + view["byteLength"]]
        if number in pictures:
            pictures[number]["mimeType"] = "image/webp"
            part = lossless_webp(np.asarray(cv2.imdecode(np.frombuffer(part, np.uint8), cv2.IMREAD_COLOR), np.uint8))
        data += bytes(-len(data) % 4)
        view |= {"byteOffset": len(data), "byteLength": len(part)}
        data += part
    data += bytes(-len(data) % 4)
    document["buffers"] = [{"byteLength": len(data)}]
    text = json.dumps(document, separators=(",", ":")).encode()
    text += b" " * (-len(text) % 4)
    body = CHUNK.pack(len(text), b"JSON") + text + CHUNK.pack(len(data), b"BIN\0") + bytes(data)
    return gzip.compress(HEAD.pack(b"glTF", 2, HEAD.size + len(body)) + body, 6, mtime=0)
