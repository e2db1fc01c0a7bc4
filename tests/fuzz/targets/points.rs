//! Tables of places: any bytes.
#![no_main]

libfuzzer_sys::fuzz_target!(|bytes: &[u8]| {
    rowgram_fuzz::read(bytes, "plants.csv", |path| rowgram::io::points::read(path).map(drop));
});
