"""Golden places for tests/crs.rs, from PROJ through pyproj.

    pip install pyproj && python tests/golden/crs.py

EPSG:27700 with the seven parameters (not the OSTN15 grid), which is what a PROJ string holds.
"""

import pyproj

WGS84 = "EPSG:4979"
SEVEN = (
    "+proj=pipeline +step +proj=axisswap +order=2,1 +step +proj=unitconvert +xy_in=deg +xy_out=rad "
    "+step +proj=cart +ellps=WGS84 +step +inv +proj=helmert +x=446.448 +y=-125.157 +z=542.06 +rx=0.15 +ry=0.247 "
    "+rz=0.842 +s=-20.489 +convention=position_vector +step +inv +proj=cart +ellps=airy "
    "+step +proj=tmerc +lat_0=49 +lon_0=-2 +k=0.9996012717 +x_0=400000 +y_0=-100000 +ellps=airy"
)
for code, places in [
    (32611, [(34.4083, -119.8799), (33.1, -116.2)]),
    (32755, [(-37.5, 145.25)]),
    (2154, [(45.75, 4.85)]),
    (25832, [(51.5, 7.3)]),
]:
    to = pyproj.Transformer.from_crs("EPSG:4326", f"EPSG:{code}", always_xy=True)
    for lat, lon in places:
        e, n = to.transform(lon, lat)
        print(f"    ({code}, {lat}, {lon}, {e:.4f}, {n:.4f}),")
to = pyproj.Transformer.from_pipeline(SEVEN)
for lat, lon in [(54.5090622, -2.7582823), (51.5, -0.1)]:
    e, n, _ = to.transform(lat, lon, 0.0)
    print(f"    (27700, {lat}, {lon}, {e:.4f}, {n:.4f}),")
ecef = pyproj.Transformer.from_crs("EPSG:4979", "EPSG:4978")
print(ecef.transform(54.5, -2.75, 343.0))
