//! OpenDroneMap's `gcp_list.txt`: any bytes.
#![no_main]

libfuzzer_sys::fuzz_target!(|bytes: &[u8]| {
    rowgram_fuzz::read(bytes, "gcp_list.txt", |path| rowgram::io::gcp_list::read(path, &Default::default(), None).map(drop));
});
