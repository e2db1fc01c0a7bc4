//! Points that are found again in another photo, and their correspondences.
//!
//! SIFT (Lowe, IJCV 2004), with the scale space, the thresholds and the descriptor of OpenCV, so that key
//! points can be compared one to one: [`detect`] finds and describes them, [`matching`] finds
//! which belong together, [`pairs`] says which photos are worth trying.
//!
//! Positions are `u` right and `v` down with the centre of the top-left pixel at (0, 0). Results are the
//! same for any number of threads.

mod blur;
mod budget;
mod describe;
mod detect;
mod gradient;
pub mod least_squares;
pub mod matching;
mod orient;
pub mod pairs;
mod photo;
mod pyramid;
pub mod retrieval;
pub mod sketch;

use image::{GrayImage, RgbImage};
use rayon::prelude::*;
use serde::{Deserialize, Serialize};
use std::sync::Arc;

/// Bytes of a descriptor.
pub const DESCRIPTOR_LENGTH: usize = 128;

/// How the photo is enlarged before the search.
#[derive(Debug, Clone, Copy, PartialEq, Eq, Default, Serialize, Deserialize)]
#[serde(rename_all = "kebab-case")]
pub enum Upscale {
    /// Twice the size with the pixels where they were: positions carry no shift.
    #[default]
    Precise,
    /// Twice the size as OpenCV does it by default: positions are 0.25 px too large in `u` and `v`.
    HalfPixel,
    /// Not enlarged: a quarter of the time and memory, without the finest points.
    None,
}

impl Upscale {
    fn factor(self) -> u32 {
        match self {
            Upscale::Precise | Upscale::HalfPixel => 2,
            Upscale::None => 1,
        }
    }
}

/// How descriptors are made comparable.
#[derive(Debug, Clone, Copy, PartialEq, Eq, Default, Serialize, Deserialize)]
#[serde(rename_all = "kebab-case")]
pub enum Norm {
    /// Square roots of shares (RootSIFT): Euclidean distance then is Hellinger's, which matches better.
    #[default]
    Root,
    /// Unit length, as first published and as in OpenCV.
    L2,
}

/// What is looked for.
#[derive(Debug, Clone, Copy, PartialEq, Serialize, Deserialize)]
#[serde(default, deny_unknown_fields)]
pub struct FeatureOptions {
    /// The most features that are kept, spread over the photo; 0 keeps all.
    pub max_features: usize,
    /// Enlargement before the search.
    pub upscale: Upscale,
    /// Normalisation of the descriptors.
    pub norm: Norm,
    /// Least contrast of a key point, times three, grey values taken as 0 to 1.
    pub contrast_threshold: f32,
    /// Largest ratio of the principal curvatures; above it a point lies on an edge.
    pub edge_threshold: f32,
}

impl Default for FeatureOptions {
    fn default() -> FeatureOptions {
        FeatureOptions {
            max_features: 8192,
            upscale: Upscale::default(),
            norm: Norm::default(),
            contrast_threshold: 0.04,
            edge_threshold: 10.0,
        }
    }
}

/// One key point.
#[derive(Debug, Clone, Copy, PartialEq)]
pub struct KeyPoint {
    /// Column, in pixels; 0 is the centre of the leftmost pixel.
    pub u_px: f32,
    /// Row, in pixels; 0 is the centre of the topmost pixel.
    pub v_px: f32,
    /// Blur at which it stands out, in pixels of the photo (half of OpenCV's `size`).
    pub sigma_px: f32,
    /// Direction of its gradients, from the `u` axis towards the `v` axis, from 0 to 2 pi.
    pub angle_rad: f32,
    /// Contrast, grey values taken as 0 to 1.
    pub response: f32,
}

/// Descriptors, one after the other.
#[derive(Debug, Clone, PartialEq, Eq, Default)]
pub struct Descriptors {
    bytes: Vec<u8>,
}

impl Descriptors {
    /// Descriptors from their bytes; `None` where these are not a multiple of [`DESCRIPTOR_LENGTH`].
    pub fn from_bytes(bytes: Vec<u8>) -> Option<Descriptors> {
        bytes.len().is_multiple_of(DESCRIPTOR_LENGTH).then_some(Descriptors { bytes })
    }

    /// All bytes, [`DESCRIPTOR_LENGTH`] for each.
    pub fn as_bytes(&self) -> &[u8] {
        &self.bytes
    }

    /// How many there are.
    pub fn len(&self) -> usize {
        self.bytes.len() / DESCRIPTOR_LENGTH
    }

    /// Whether there is none.
    pub fn is_empty(&self) -> bool {
        self.bytes.is_empty()
    }

    /// One after the other.
    pub fn iter(&self) -> impl ExactSizeIterator<Item = &[u8; DESCRIPTOR_LENGTH]> {
        self.bytes.as_chunks().0.iter()
    }

    /// Those at `indices`, in their order; indices beyond the end are left out.
    pub fn select(&self, indices: &[usize]) -> Descriptors {
        let all = self.bytes.as_chunks::<DESCRIPTOR_LENGTH>().0;
        let bytes = indices.iter().filter_map(|&index| all.get(index)).flatten().copied().collect();
        Descriptors { bytes }
    }
}

/// Where the descriptors of photos come from: memory, or files that are read when they are needed.
pub trait DescriptorSource: Sync {
    /// The descriptors of a photo, by its index.
    fn descriptors(&self, photo: usize) -> Arc<Descriptors>;

    /// None are needed for a while: what can be read again may leave the memory.
    fn release(&self) {}
}

impl DescriptorSource for Vec<Arc<Descriptors>> {
    fn descriptors(&self, photo: usize) -> Arc<Descriptors> {
        self.get(photo).map(Arc::clone).unwrap_or_default()
    }
}

/// The features of a photo: as many key points as descriptors.
#[derive(Debug, Clone, PartialEq, Default)]
pub struct Features {
    /// Photo columns.
    pub width_px: u32,
    /// Photo rows.
    pub height_px: u32,
    /// Where they are.
    pub key_points: Vec<KeyPoint>,
    /// What they look like, in the same order.
    pub descriptors: Descriptors,
}

/// The grey picture of a photo, `0.299 R + 0.587 G + 0.114 B`, rounded as OpenCV does.
pub fn grey(photo: &RgbImage) -> GrayImage {
    let mut grey = GrayImage::new(photo.width(), photo.height());
    let (pixels, _) = photo.as_raw().as_chunks::<3>();
    const TASK: usize = 1 << 16;
    grey.par_chunks_mut(TASK).zip(pixels.par_chunks(TASK)).for_each(|(out, pixels)| {
        for (out, pixel) in out.iter_mut().zip(pixels) {
            let [r, g, b] = pixel.map(u32::from);
            *out = ((9798 * r + 19235 * g + 3735 * b + (1 << 14)) >> 15) as u8;
        }
    });
    grey
}

/// Finds and describes the features of a grey photo.
///
/// They are ordered from fine to coarse octaves, within these by blocks of 128 pixels. A point with
/// several directions gives several features. A photo too small or too flat gives none.
///
/// Memory: about 10 bytes for each pixel of the photo enlarged, 0.5 GB for 12 megapixels.
pub fn detect(photo: &GrayImage, options: &FeatureOptions) -> Features {
    let (width_px, height_px) = photo.dimensions();
    let factor = options.upscale.factor() as f32;
    let pyramid = pyramid::Pyramid::new(options);
    let mut found = Vec::new();
    let mut octaves: Vec<pyramid::Octave> = Vec::new();
    let enlarged = photo::Photo { grey: photo, upscale: options.upscale };
    let mut made = pyramid.octave(&enlarged, 0);
    while let Some(pyramid::Made { layers, extrema, next }) = made {
        octaves.push(layers);
        found.extend(extrema);
        made = pyramid.octave(&next, octaves.len() as u8);
    }
    let to_photo = |octave: u8| f32::from(octave).exp2() / factor;
    let mut order: Vec<usize> = Vec::new();
    if options.max_features > 0 {
        let points: Vec<(f32, f32, f32)> = found
            .iter()
            .map(|e| {
                let (x, y) = e.position();
                (x * to_photo(e.octave), y * to_photo(e.octave), e.response)
            })
            .collect();
        let size = (width_px as f32, height_px as f32);
        order = budget::grid_select(&points, size, options.max_features);
        found = order.iter().map(|&index| found[index]).collect();
    }
    let layer_of = |e: &detect::Extremum| &octaves[usize::from(e.octave)][usize::from(e.layer) - 1];
    let directed: Vec<Vec<f32>> = found
        .par_iter()
        .with_min_len(64)
        .map(|e| {
            pulp::Arch::new().dispatch(orient::Directions {
                layer: layer_of(e),
                column: e.column as usize,
                row: e.row as usize,
                sigma_px: e.sigma(),
            })
        })
        .collect();
    let mut directed: Vec<(usize, f32)> = directed
        .iter()
        .enumerate()
        .flat_map(|(index, angles)| angles.iter().map(move |&angle| (index, angle)))
        .collect();
    if options.max_features > 0 {
        directed.truncate(options.max_features);
        // From the order of their worth back to the order of their places.
        directed.sort_by_key(|&(index, _)| order[index]);
    }
    let directed: Vec<(detect::Extremum, f32)> =
        directed.into_iter().map(|(index, angle)| (found[index], angle)).collect();
    let mut bytes = vec![0; directed.len() * DESCRIPTOR_LENGTH];
    bytes.par_chunks_exact_mut(DESCRIPTOR_LENGTH).zip(&directed).with_min_len(16).for_each(
        |(out, (e, angle))| {
            pulp::Arch::new().dispatch(describe::Describe {
                layer: layer_of(e),
                column: e.column as usize,
                row: e.row as usize,
                sigma_px: e.sigma(),
                angle_deg: *angle,
                norm: options.norm,
                out,
            });
        },
    );
    let key_points = directed
        .iter()
        .map(|(e, angle)| {
            let (x, y) = e.position();
            let scale = to_photo(e.octave);
            let clockwise = if *angle > 0.0 { 360.0 - angle } else { 0.0 };
            KeyPoint {
                u_px: x * scale,
                v_px: y * scale,
                sigma_px: e.sigma() * scale,
                angle_rad: clockwise.to_radians(),
                response: e.response,
            }
        })
        .collect();
    Features { width_px, height_px, key_points, descriptors: Descriptors { bytes } }
}
