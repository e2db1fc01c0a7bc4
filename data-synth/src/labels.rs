//! Which leaf each pixel shows, from straight above: the truth for leaf segmentation.
//!
//! By the pixel rule of [`crate::render`], and of several leaves the highest, as the picture shows it.

use crate::{
    corrupt::Weed,
    field::Field,
    render::{BAND_ROWS, Bands, band_rows, project, ribbons, sweep},
};
use rayon::prelude::*;

/// Labels of the pixels of a field's frame, row by row.
#[derive(Debug, Clone, PartialEq, Eq)]
pub struct Labels {
    /// Number of columns.
    pub width: usize,
    /// Number of rows.
    pub height: usize,
    /// 0 where no leaf is seen, else 1 + the leaf's place in [`Field::leaves`]; the leaves of weeds come behind those of
    /// the plants.
    pub data: Vec<u32>,
}

/// The labels of a field; pixels that show leaf are those of [`crate::render::mask`].
pub fn labels(field: &Field, weeds: &[Weed]) -> Labels {
    let frame = &field.frame;
    let ribbons = ribbons(field, weeds);
    let places: std::collections::HashMap<*const crate::leaf::Leaf, u32> = field
        .leaves()
        .chain(weeds.iter().flat_map(|weed| &weed.leaves))
        .enumerate()
        .map(|(place, leaf)| (std::ptr::from_ref(leaf), place as u32 + 1))
        .collect();
    // Not every leaf is drawn: what is left out keeps its place.
    let label_of: Vec<u32> = ribbons
        .iter()
        .map(|&leaf| places.get(&std::ptr::from_ref(leaf)).copied().unwrap_or(0))
        .collect();
    let bands = Bands::new(frame, &ribbons, [0.0; 2]);
    let (width, height) = (frame.width_px as usize, frame.height_px as usize);
    let mut data = vec![0; width * height];
    data.par_chunks_mut(width * BAND_ROWS).enumerate().for_each(|(band, labels)| {
        let rows = band_rows(band, labels.len() / width);
        let mut heights = vec![f64::NEG_INFINITY; labels.len()];
        for &number in bands.numbers(band) {
            let nodes = project(frame, ribbons[number as usize], [0.0; 2]);
            let label = label_of[number as usize];
            sweep(&nodes, width, &rows, |hit| {
                let (a, b) = (nodes[hit.segment], nodes[hit.segment + 1]);
                let z_m = a.z_m + hit.along * (b.z_m - a.z_m);
                let index = (hit.v - rows.start) * width + hit.u;
                if z_m > heights[index] {
                    heights[index] = z_m;
                    labels[index] = label;
                }
            });
        }
    });
    Labels { width, height, data }
}

#[cfg(test)]
mod tests {
    use super::*;
    use crate::{field::FieldConfig, render};

    #[test]
    fn labels_cover_the_mask_and_the_highest_leaf_is_seen() {
        let config =
            FieldConfig { rows: 2, row_length_m: 1.5, gsd_m: 0.006, ..FieldConfig::default() };
        let field = Field::plant(&config).unwrap();
        let (labels, mask) = (labels(&field, &[]), render::mask(&field, &[]));
        let seen: Vec<bool> = labels.data.iter().map(|&label| label > 0).collect();
        let leaf: Vec<bool> = mask.iter().map(|&pixel| pixel > 0).collect();
        assert!(seen == leaf);
        let count = field.leaves().count();
        assert!(labels.data.iter().all(|&label| label as usize <= count));
        let shown: std::collections::BTreeSet<u32> = labels.data.iter().copied().collect();
        // Most leaves are seen at least in part.
        assert!(shown.len() * 10 > count * 9, "{} of {count}", shown.len());
    }
}
