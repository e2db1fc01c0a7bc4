//! EXIF and XMP of a photo: any bytes.
#![no_main]

libfuzzer_sys::fuzz_target!(|bytes: &[u8]| {
    rowgram::io::photo::parse(bytes);
});
