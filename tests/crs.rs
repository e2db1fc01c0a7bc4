//! Reference systems against PROJ (pyproj 3.7, PROJ 9.5), by `tests/golden/crs.py`.

use rowgram::crs::{Crs, LocalPlane, ecef_m};

/// Code, latitude, longitude, easting, northing.
const PLACES: [(u32, f64, f64, f64, f64); 7] = [
    (32611, 34.4083, -119.8799, 235286.0848, 3811190.2496),
    (32611, 33.1, -116.2, 574649.2351, 3662657.6547),
    (32755, -37.5, 145.25, 345311.0840, 5848220.2947),
    (2154, 45.75, 4.85, 843814.2437, 6518396.0189),
    (25832, 51.5, 7.3, 382002.2209, 5706799.3266),
    (27700, 54.5090622, -2.7582823, 351000.2080, 512903.8172),
    (27700, 51.5, -0.1, 531979.2927, 179606.9085),
];

#[test]
fn places_fall_where_proj_puts_them_and_come_back() {
    for (code, latitude, longitude, easting, northing) in PLACES {
        let crs = Crs::from_epsg(code).unwrap();
        let [e, n] = crs.from_wgs84(latitude, longitude).unwrap();
        // Golden numbers have four digits.
        assert!((e - easting).abs() < 1e-3 && (n - northing).abs() < 1e-3, "{code}: {e} {n}");
        let [lat, lon] = crs.to_wgs84(e, n).unwrap();
        // The way back of a datum shift starts from height 0 again: some millimetres at most.
        assert!(
            (lat - latitude).abs() < 3e-8 && (lon - longitude).abs() < 3e-8,
            "{code}: {lat} {lon}"
        );
    }
}

#[test]
fn systems_are_named_in_several_ways() {
    for words in [
        "EPSG:32611",
        "32611",
        "WGS84 UTM 11N",
        "+proj=utm +zone=11 +datum=WGS84 +units=m +no_defs",
    ] {
        let [e, _] = Crs::from_words(words).unwrap().from_wgs84(34.4083, -119.8799).unwrap();
        assert!((e - 235286.0848).abs() < 1e-3, "{words}: {e}");
    }
    for (words, part) in [
        ("EPSG:4326", "geographic"),
        ("EPSG:99999", "not a known"),
        ("somewhere", "names no coordinate reference system"),
        ("EPSG:2225", "not the metre"),
    ] {
        let said = Crs::from_words(words).unwrap_err().to_string();
        assert!(said.contains(part), "{words}: {said}");
    }
    assert_eq!(Crs::utm_of(34.4, -119.9).unwrap().name(), "EPSG:32611");
    assert_eq!(Crs::utm_of(-37.5, 145.2).unwrap().name(), "EPSG:32755");
}

#[test]
fn a_local_plane_is_level_and_true_to_scale() {
    let at = ecef_m([54.5, -2.75, 343.0]);
    for (a, b) in at.iter().zip([3707971.3146843, -178106.6342966, 5169539.2808517]) {
        assert!((a - b).abs() < 1e-6, "{at:?}");
    }
    let plane = LocalPlane::at([54.5, -2.75, 0.0]);
    let up = plane.from_wgs84([54.5, -2.75, 80.0]);
    assert!(up[0].abs() < 1e-8 && up[1].abs() < 1e-8 && (up[2] - 80.0).abs() < 1e-8);
    let [e, n] = Crs::from_epsg(32630).unwrap().from_wgs84(54.5005, -2.7495).unwrap();
    let [e0, n0] = Crs::from_epsg(32630).unwrap().from_wgs84(54.5, -2.75).unwrap();
    let local = plane.from_wgs84([54.5005, -2.7495, 0.0]);
    // The grid's scale is 0.9996 there.
    let ratio = (e - e0).hypot(n - n0) / local[0].hypot(local[1]);
    assert!((ratio - 0.9996).abs() < 1e-4, "{ratio}");
}
