//! How the datum of a system lies to WGS84.

/// Datum shifts that definitions lack: dx, dy, dz in metres, rx, ry, rz in seconds, scale in parts per
/// million, of the EPSG transformations that are meant for a whole country.
pub(super) const SHIFTS: [(&[u32], &str); 5] = [
    (&[27700], "446.448,-125.157,542.06,0.15,0.247,0.842,-20.489"),
    (&[28991, 28992], "565.4171,50.3319,465.5524,-0.398957,0.343988,-1.87740,4.0725"),
    (&[21781, 2056], "674.374,15.056,405.346,0,0,0,0"),
    (&[31466, 31467, 31468, 31469], "598.1,73.7,418.2,0.202,0.045,-2.455,6.7"),
    (
        &[31254, 31255, 31256, 31257, 31258, 31259, 31287],
        "577.326,90.129,463.919,5.137,1.474,5.297,2.4232",
    ),
];

/// Whether a definition says how its datum lies to WGS84 ([`super::Crs::knows_datum`]).
pub fn knows_datum(definition: &str) -> bool {
    let same_as_wgs84 = ["+ellps=GRS80", "+ellps=WGS84"].iter().any(|e| definition.contains(e));
    same_as_wgs84 || ["+datum=", "+towgs84="].iter().any(|key| definition.contains(key))
}

/// Whether a datum is within a metre or two of WGS84: that of receivers, but for what continents move.
pub fn is_global(definition: &str) -> bool {
    let shift = definition.split_whitespace().find_map(|word| word.strip_prefix("+towgs84="));
    let is_shifted = shift.is_some_and(|shift| {
        shift.split(',').take(3).any(|m| m.parse::<f64>().is_ok_and(|m| m.abs() > 2.0))
    });
    let global = ["+datum=WGS84", "+datum=NAD83", "+ellps=GRS80", "+ellps=WGS84", "+a=6378137"];
    !is_shifted && global.iter().any(|key| definition.contains(key))
}
