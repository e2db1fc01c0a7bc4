//! The photos of an orthomosaic: which are used, and their pixels.

use super::write::OrthoInput;
use crate::photo_names::number_of;
use image::RgbImage;
use rowgram_base::error::Error;
use rowgram_files::{geotiff, images};
use rowgram_optim::output::FileError;
use rowgram_raster::window::Window;
use rowgram_survey::mapping::{View, photo::DecodedPhoto, views};
use std::{
    collections::HashSet,
    path::{Path, PathBuf},
};

/// The photos that are used.
pub(super) struct Chosen {
    pub(super) views: Vec<View>,
    pub(super) photos: Vec<PathBuf>,
    /// Index of the camera of each.
    pub(super) cameras: Vec<usize>,
}

pub(super) fn chosen(input: &OrthoInput<'_>, only: &[String]) -> Result<Chosen, Error> {
    let all = views(input.reconstruction);
    if all.is_empty() {
        return Err(Error::Argument("there is no photo with a pose".into()));
    }
    let wanted = (only.iter())
        .map(|name| number_of(all.iter().map(|view| view.name.as_str()), name))
        .collect::<Result<HashSet<usize>, String>>()
        .map_err(|why| Error::Argument(format!("[ortho] only: {why}")))?;
    let cameras = input.reconstruction.images.iter().map(|image| image.camera);
    let mut chosen = Chosen { views: Vec::new(), photos: Vec::new(), cameras: Vec::new() };
    for (k, ((view, photo), camera)) in all.into_iter().zip(input.photos).zip(cameras).enumerate() {
        if only.is_empty() || wanted.contains(&k) {
            chosen.views.push(view);
            chosen.photos.push(photo.clone());
            chosen.cameras.push(camera);
        }
    }
    Ok(chosen)
}

/// Reads a photo that must be as large as its camera says.
pub(crate) fn read_photo(path: &Path, size_px: [u32; 2]) -> Result<DecodedPhoto, Error> {
    let (photo, gaps) = read_pixels(path, size_px)?;
    Ok(DecodedPhoto::new(&photo, gaps.as_deref()))
}

/// The same before it is decoded: its colours, and where it has none.
pub(crate) fn read_pixels(
    path: &Path,
    size_px: [u32; 2],
) -> Result<(RgbImage, Option<Vec<bool>>), Error> {
    let mut first = [0; 4];
    let tiff = std::fs::File::open(path)
        .and_then(|mut file| std::io::Read::read_exact(&mut file, &mut first))
        .is_ok_and(|()| geotiff::is_tiff(&first));
    let (photo, gaps) = if tiff {
        let reader = geotiff::Reader::open(path)?;
        reader.read_rgb_and_gaps(Window::whole(reader.width(), reader.height()))?
    } else {
        images::read_colour_and_gaps(path)?
    };
    if [photo.width(), photo.height()] != size_px {
        let message = format!(
            "it has {} x {} pixels, its camera {} x {}",
            photo.width(),
            photo.height(),
            size_px[0],
            size_px[1]
        );
        return Err(FileError::malformed(path, None, message).into());
    }
    Ok((photo, gaps))
}
