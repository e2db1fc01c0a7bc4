#!/usr/bin/env python3
"""The golden values of `site::tests`: UTM to latitude and longitude by pyproj (written with 3.7.2)."""
from pyproj import Transformer

for epsg, easting, northing in [
    (32616, 500680.0, 4480140.0),
    (32616, 612345.678, 4412345.678),
    (32630, 351034.5909, 6042805.5356),
    (32721, 250000.0, 6200000.0),
]:
    longitude, latitude = Transformer.from_crs(epsg, 4326, always_xy=True).transform(easting, northing)
    print(f"({epsg}, {easting!r}, {northing!r}, {latitude:.12f}, {longitude:.12f}),")
