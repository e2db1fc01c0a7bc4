//! `camera.toml`: any bytes.
#![no_main]

libfuzzer_sys::fuzz_target!(|bytes: &[u8]| {
    rowgram_fuzz::read(bytes, "camera.toml", |path| rowgram::io::camera::read(path).map(drop));
});
