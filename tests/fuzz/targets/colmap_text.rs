//! COLMAP's text form: three files in one, parted by a line of `====`.
#![no_main]

libfuzzer_sys::fuzz_target!(|bytes: &[u8]| {
    let names = ["cameras.txt", "images.txt", "points3D.txt"];
    rowgram_fuzz::read_parts(bytes, &names, |folder| rowgram::io::colmap::read(folder).map(drop));
});
