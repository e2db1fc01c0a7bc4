//! COLMAP's binary form: three files in one, parted by a line of `====`.
#![no_main]

libfuzzer_sys::fuzz_target!(|bytes: &[u8]| {
    let names = ["cameras.bin", "images.bin", "points3D.bin"];
    rowgram_fuzz::read_parts(bytes, &names, |folder| rowgram::io::colmap::read(folder).map(drop));
});
