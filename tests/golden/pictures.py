#!/usr/bin/env python3
"""Pictures of one plant in forms that the tests cannot write: CMYK, an internal mask, nodata, an EXIF rotation.

Made with Python 3.11 and Pillow 13: python tests/golden/pictures.py. The plant is a disc of 11 px about (90, 60) in 180 x 120 pixels; what
is not to be seen (left of column 40 and right of column 139) is as green as the plant.
"""
import pathlib
import random
import struct
import zlib

from PIL import Image

FOLDER = pathlib.Path(__file__).parent / "pictures"
WIDTH, HEIGHT = 180, 120


def plant(hidden=None):
    """RGB pixels with noise; `hidden` is the colour of what is not to be seen."""
    rng = random.Random(7)
    pixels = []
    for v in range(HEIGHT):
        for u in range(WIDTH):
            leaf = (u - 90) ** 2 + (v - 60) ** 2 < 11**2
            colour = (62, 118, 48) if leaf else (122, 104, 84)
            pixel = tuple(value + rng.randrange(14) for value in colour)
            pixels.append(pixel if hidden is None or 40 <= u < 140 else hidden)
    return pixels


def tiff(path, pixels, nodata=None, mask=None):
    """A TIFF of one strip; with `mask`, a second directory of the kind that GDAL reads as an internal mask."""
    data = zlib.compress(bytes(value for pixel in pixels for value in pixel), 9)
    out = bytearray(b"II*\0\0\0\0\0")

    def directory(entries, blob, link):
        start = len(out)
        out.extend(blob)
        extra = {}
        for tag, kind, count, value in entries:
            if isinstance(value, bytes) and len(value) > 4:
                extra[tag] = len(out)
                out.extend(value)
        if len(out) % 2:
            out.append(0)
        struct.pack_into("<I", out, link, len(out))
        out.extend(struct.pack("<H", len(entries)))
        for tag, kind, count, value in sorted(entries):
            if value == "strip":
                value = start
            if isinstance(value, bytes):
                packed = struct.pack("<I", extra[tag]) if tag in extra else value.ljust(4, b"\0")
            else:
                packed = struct.pack("<HH" if kind == 3 else "<I", *((value, 0) if kind == 3 else (value,)))
            out.extend(struct.pack("<HHI", tag, kind, count) + packed)
        out.extend(b"\0\0\0\0")
        return len(out) - 4

    common = [(256, 4, 1, WIDTH), (257, 4, 1, HEIGHT), (259, 3, 1, 8), (273, 4, 1, "strip"), (278, 4, 1, HEIGHT)]
    colour = [(258, 3, 3, struct.pack("<HHH", 8, 8, 8)), (262, 3, 1, 2), (277, 3, 1, 3), (279, 4, 1, len(data))]
    if nodata is not None:
        text = nodata.encode() + b"\0"
        colour.append((42113, 2, len(text), text))
    link = directory(common + colour, data, 4)
    if mask is not None:
        mask = zlib.compress(mask, 9)
        packed = [(254, 4, 1, 4), (258, 3, 1, 1), (262, 3, 1, 4), (277, 3, 1, 1), (279, 4, 1, len(mask))]
        directory(common + packed, mask, link)
    path.write_bytes(bytes(out))


def main():
    FOLDER.mkdir(exist_ok=True)
    picture = Image.new("RGB", (WIDTH, HEIGHT))
    picture.putdata(plant())
    picture.convert("CMYK").save(FOLDER / "cmyk.jpg", quality=92)
    exif = Image.Exif()
    exif[274] = 6
    picture.save(FOLDER / "turned.jpg", quality=92, exif=exif)
    green = (30, 200, 30)
    # One bit per pixel, rows of whole bytes.
    bits = "".join("1" if 40 <= u < 140 else "0" for u in range(WIDTH)).ljust(-(-WIDTH // 8) * 8, "0")
    seen = int(bits, 2).to_bytes(len(bits) // 8, "big") * HEIGHT
    tiff(FOLDER / "internal_mask.tif", plant(green), mask=seen)
    tiff(FOLDER / "nodata.tif", plant((7, 7, 7)), nodata="7")


if __name__ == "__main__":
    main()
