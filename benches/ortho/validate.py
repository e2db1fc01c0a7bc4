"""Whether rasters of rowgram are what GDAL and rio-cogeo take for cloud optimised GeoTIFFs.

    venv/bin/pip install rasterio rio-cogeo
    venv/bin/python benches/ortho/validate.py ortho.tif ortho_provenance.tif dem.tif ...

Exits with 1 where one is not valid. QGIS opens a file as GDAL does.
"""

import sys

import numpy as np
import rasterio
from rio_cogeo.cogeo import cog_validate

bad = False
for path in sys.argv[1:]:
    valid, errors, warnings = cog_validate(path, quiet=True)
    with rasterio.open(path) as file:
        overviews = file.overviews(1)
        # Every tile of every level can be decoded.
        for level in [None, *range(len(overviews))]:
            with rasterio.open(path, **({} if level is None else {"overview_level": level})) as one:
                for _, window in one.block_windows(1):
                    one.read(window=window)
        small = file.read(1, out_shape=(min(file.height, 256), min(file.width, 256)), masked=True)
        print(
            f"{path}: valid {valid}, {file.width} x {file.height} x {file.count} {file.dtypes[0]}, {file.crs}, nodata {file.nodata}, "
            f"{file.colorinterp[-1].name}, blocks {file.block_shapes[0]}, overviews {overviews}, "
            f"data in {100 * np.ma.count(small) / small.size:.1f} % ({errors} {warnings})"
        )
    bad |= not valid or bool(errors)
sys.exit(bad)
