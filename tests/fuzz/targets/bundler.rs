//! Bundler: any bytes.
#![no_main]

libfuzzer_sys::fuzz_target!(|bytes: &[u8]| {
    rowgram_fuzz::read(bytes, "bundle.out", |path| rowgram::io::bundler::read(path, None, [640, 480]).map(drop));
});
