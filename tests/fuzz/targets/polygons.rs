//! Polygons: any bytes.
#![no_main]

libfuzzer_sys::fuzz_target!(|bytes: &[u8]| {
    rowgram_fuzz::read(bytes, "plots.geojson", |path| rowgram::io::polygons::read(path, None).map(drop));
});
