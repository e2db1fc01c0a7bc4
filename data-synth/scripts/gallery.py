#!/usr/bin/env python3
"""A gallery of a flight: the field from above, one photo, its mask, its truth. The README's has photo and mask.

    rowgram synth flight --preset small --photo-truth -o field
    python gallery.py field IMG_0006 docs/twin.jpg --panels photo,mask

Needs pillow and numpy. The truth panel colours every pixel by the plant that it shows and marks the stalk bases.
"""
import argparse
import csv
import pathlib

import numpy as np
from PIL import Image, ImageDraw

PANEL = (640, 480)
GAP = 8


def fitted(image, size=PANEL, middle=(0.5, 0.5)):
    """The largest part of an image that has the panel's shape, about a point, at the panel's size."""
    scale = max(size[0] / image.width, size[1] / image.height)
    width, height = size[0] / scale, size[1] / scale
    left = min(max(middle[0] * image.width - width / 2, 0), image.width - width)
    top = min(max(middle[1] * image.height - height / 2, 0), image.height - height)
    return image.resize(size, Image.LANCZOS, box=(left, top, left + width, top + height))


def truth(folder, photo, image):
    """Plants in colours of their own over the darkened photo, stalk bases as crosses."""
    code = np.asarray(Image.open(folder / "truth/photos" / f"{photo}_plants.png")).astype(np.int64)
    number = code[..., 0] + 256 * code[..., 1] + 65536 * code[..., 2]
    palette = np.random.default_rng(1).integers(70, 256, (number.max() + 1, 3))
    out = (0.35 * np.asarray(image)).astype(np.uint8)
    shown = number > 0
    out[shown] = palette[number[shown]]
    picture = Image.fromarray(out)
    draw = ImageDraw.Draw(picture)
    with open(folder / "truth/photos" / f"{photo}.csv", newline="") as file:
        for row in csv.DictReader(file):
            u, v = float(row["u_px"]), float(row["v_px"])
            for du, dv in ((4, 0), (0, 4)):
                draw.line((u - du, v - dv, u + du, v + dv), fill=(255, 255, 255), width=1)
    return picture


def main():
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("folder", type=pathlib.Path)
    parser.add_argument("photo")
    parser.add_argument("output", type=pathlib.Path)
    parser.add_argument("--panels", default="above,photo,mask,truth")
    args = parser.parse_args()
    image = Image.open(args.folder / "images" / f"{args.photo}.JPG").convert("RGB")
    make = {
        "above": lambda: Image.open(args.folder / "truth/picture.png").convert("RGB"),
        "photo": lambda: image,
        "mask": lambda: Image.open(args.folder / "truth/photos" / f"{args.photo}_mask.png").convert("RGB"),
        "truth": lambda: truth(args.folder, args.photo, image),
    }
    panels = [fitted(make[name]()) for name in args.panels.split(",")]
    rows = (len(panels) + 1) // 2
    sheet = Image.new("RGB", (2 * PANEL[0] + GAP, rows * (PANEL[1] + GAP) - GAP), "white")
    for place, panel in enumerate(panels):
        sheet.paste(panel, ((place % 2) * (PANEL[0] + GAP), (place // 2) * (PANEL[1] + GAP)))
    sheet.save(args.output, quality=80, optimize=True)


main()
