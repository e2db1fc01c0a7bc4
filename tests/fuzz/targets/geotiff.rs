//! GeoTIFF: any bytes, the first rows of what claims to be a raster.
#![no_main]
use rowgram::{io::geotiff::Reader, raster::window::Window};

libfuzzer_sys::fuzz_target!(|bytes: &[u8]| {
    rowgram_fuzz::read(bytes, "raster.tif", |path| {
        let reader = Reader::open(path)?;
        let (width, height) = (reader.width(), reader.height().min(64));
        // What says that it is huge is read by its owner, in windows that fit.
        if width <= 4096 { reader.read_f32(Window::rows(width, 0..height)).map(drop) } else { Ok(()) }
    });
});
