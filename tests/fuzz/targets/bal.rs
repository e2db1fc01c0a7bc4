//! BAL problems: any bytes.
#![no_main]

libfuzzer_sys::fuzz_target!(|bytes: &[u8]| {
    rowgram_fuzz::read(bytes, "block.txt", |path| rowgram::io::bal::read(path).map(drop));
});
