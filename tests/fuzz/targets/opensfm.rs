//! OpenSfM's reconstruction: any bytes.
#![no_main]

libfuzzer_sys::fuzz_target!(|bytes: &[u8]| {
    rowgram_fuzz::read(bytes, "reconstruction.json", |path| rowgram::io::opensfm::read_poses(path).map(drop));
});
