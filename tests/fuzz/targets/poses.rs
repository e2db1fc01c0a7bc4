//! Tables of poses: any bytes.
#![no_main]

libfuzzer_sys::fuzz_target!(|bytes: &[u8]| {
    rowgram_fuzz::read(bytes, "exterior_orientation.csv", |path| rowgram::io::poses::read(path).map(drop));
});
