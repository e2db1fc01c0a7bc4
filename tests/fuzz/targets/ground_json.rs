//! OpenSfM's `ground_control_points.json`: any bytes.
#![no_main]

libfuzzer_sys::fuzz_target!(|bytes: &[u8]| {
    rowgram_fuzz::read(bytes, "ground_control_points.json", |path| {
        rowgram::io::gcp_list::read_opensfm(path, &Default::default(), |_| Some([4000, 3000])).map(drop)
    });
});
