//! `gcps.csv`: any bytes.
#![no_main]

libfuzzer_sys::fuzz_target!(|bytes: &[u8]| {
    rowgram_fuzz::read(bytes, "gcps.csv", |path| rowgram::io::control::ground_points(path, &Default::default()).map(drop));
});
