#!/usr/bin/env python3
"""Writes geotiff/*.tif: small rasters as GDAL writes them; with --check FILE..., looks at ours.

    pip install rasterio rio-cogeo numpy
    python3 tests/golden/geotiff.py
    python3 tests/golden/geotiff.py --check ours.tif

Every raster has 70 x 45 pixels; sample b of pixel (u, v) is (7 u + 13 v + 101 b) mod 251, in 16 bits
that times 257, in float that plus 0.25. No tolerance but for JPEG, which is smooth instead,
60 + u + v (+ 20 per band), and may differ by 4.
"""

import pathlib
import sys

import numpy as np
import rasterio
from rasterio.transform import Affine

WIDTH, HEIGHT = 70, 45
HERE = pathlib.Path(__file__).parent / "geotiff"


def pattern(bands):
    v, u = np.mgrid[0:HEIGHT, 0:WIDTH]
    return np.stack([(7 * u + 13 * v + 101 * b) % 251 for b in range(bands)])


def write(name, data, **options):
    profile = dict(driver="GTiff", width=WIDTH, height=HEIGHT, count=len(data), dtype=data.dtype,
                   crs="EPSG:32616", transform=Affine(0.013, 0, 500000, 0, -0.013, 4475000))
    profile.update(options)
    with rasterio.open(HERE / name, "w", **profile) as out:
        out.write(data)


def make():
    HERE.mkdir(exist_ok=True)
    byte = pattern(3).astype(np.uint8)
    tiled = dict(tiled=True, blockxsize=32, blockysize=16)
    write("lzw_tiles.tif", byte, compress="lzw", photometric="RGB", predictor=2, **tiled)
    write("packbits_strips.tif", byte[:1], compress="packbits", blockysize=7)
    write("planar_bigtiff.tif", byte, compress="deflate", interleave="band", BIGTIFF="YES", **tiled)
    write("u16_turned.tif", (pattern(1) * 257).astype(np.uint16), compress="deflate",
          transform=Affine(0.012, 0.005, 500000, 0.005, -0.012, 4475000), nodata=0)
    write("f32_predictor.tif", (pattern(1) + 0.25).astype(np.float32), compress="deflate",
          predictor=3, nodata=-9999, **tiled)
    write("degrees.tif", byte[:1], crs="EPSG:4326", transform=Affine(1e-6, 0, 9, 0, -1e-6, 48))
    v, u = np.mgrid[0:HEIGHT, 0:WIDTH]
    smooth = np.stack([60 + u + v + 20 * b for b in range(3)]).astype(np.uint8)
    write("jpeg_ycbcr.tif", smooth, compress="jpeg", photometric="YCbCr", jpeg_quality=95, **tiled)


def check(path):
    from rio_cogeo.cogeo import cog_validate

    valid, errors, warnings = cog_validate(path)
    with rasterio.open(path) as raster:
        total = [int(np.nansum(raster.read(b).astype(np.float64))) for b in raster.indexes]
        print(path, "cog" if valid else "NO COG", errors, warnings, raster.profile, raster.overviews(1), total)
    return valid


if __name__ == "__main__":
    if sys.argv[1:2] == ["--check"]:
        sys.exit(not all([check(path) for path in sys.argv[2:]]))
    make()
