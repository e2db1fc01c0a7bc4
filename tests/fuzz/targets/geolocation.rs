//! `geolocation.csv`: any bytes.
#![no_main]

libfuzzer_sys::fuzz_target!(|bytes: &[u8]| {
    rowgram_fuzz::read(bytes, "geolocation.csv", |path| rowgram::io::camera_positions::read(path, None).map(drop));
});
