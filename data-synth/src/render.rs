//! The leaf mask: which pixels show leaf, from straight above.
//!
//! **Pixel rule.** A leaf is the union over its axis segments of all points whose distance to the
//! nearest point of the segment is at most the half width there (linear between the nodes). A pixel
//! shows leaf where that distance, from the centre of the pixel, is at most the half width plus
//! [`REACH_PX`]: the leaf touches the circle inscribed in the pixel. Leaf tips thinner than a pixel
//! therefore stay connected, as they do in photographs, where a pixel half covered by leaf is
//! still green.
//!
//! Rows of pixels are drawn in bands, each band by one thread and every leaf of it in order, so the
//! bytes do not depend on the number of threads.

use crate::{
    corrupt::Weed,
    field::{Field, Frame},
    leaf::{Leaf, NODES},
};
use image::GrayImage;
use rayon::prelude::*;
use std::ops::Range;

/// How far from a leaf a pixel's centre may lie and still show it, pixels.
pub const REACH_PX: f64 = 0.5;

/// Pixel rows drawn by one thread at a time.
pub(crate) const BAND_ROWS: usize = 128;

/// The mask of all leaves that are not dying, and of all weeds: 255 where a pixel shows leaf, 0 elsewhere.
pub fn mask(field: &Field, weeds: &[Weed]) -> GrayImage {
    let frame = &field.frame;
    let ribbons = ribbons(field, weeds);
    let bands = Bands::new(frame, &ribbons, [0.0; 2]);
    let width = frame.width_px as usize;
    let mut image = GrayImage::new(frame.width_px, frame.height_px);
    image.par_chunks_mut(width * BAND_ROWS).enumerate().for_each(|(band, pixels)| {
        let rows = band_rows(band, pixels.len() / width);
        for leaf in bands.leaves(band, &ribbons).filter(|leaf| !leaf.senescent) {
            sweep(&project(frame, leaf, [0.0; 2]), width, &rows, |hit| {
                pixels[(hit.v - rows.start) * width + hit.u] = 255;
            });
        }
    });
    image
}

/// Every ribbon that is drawn, plants first, in a fixed order.
pub(crate) fn ribbons<'a>(field: &'a Field, weeds: &'a [Weed]) -> Vec<&'a Leaf> {
    field.leaves().chain(weeds.iter().flat_map(|weed| &weed.leaves)).collect()
}

/// The pixel rows of a band that is `count` rows high.
pub(crate) fn band_rows(band: usize, count: usize) -> Range<usize> {
    band * BAND_ROWS..band * BAND_ROWS + count
}

/// A node of a ribbon in the picture.
#[derive(Debug, Clone, Copy)]
pub(crate) struct Node {
    pub(crate) u_px: f64,
    pub(crate) v_px: f64,
    pub(crate) half_px: f64,
    pub(crate) z_m: f64,
}

/// A leaf in the picture, each node moved by its height times `shift` (metres per metre of height,
/// X and Y): zero for the leaf itself, the sun's slant for its shadow on the ground.
pub(crate) fn project(frame: &Frame, leaf: &Leaf, shift: [f64; 2]) -> [Node; NODES] {
    std::array::from_fn(|i| {
        let [x_m, y_m, z_m] = leaf.axis_m[i];
        let [u_px, v_px] = frame.pixel(x_m + z_m * shift[0], y_m + z_m * shift[1]);
        Node { u_px, v_px, half_px: leaf.half_width_m[i] / frame.gsd_m, z_m }
    })
}

/// Which leaves touch which band, by number, ascending.
pub(crate) struct Bands {
    lists: Vec<Vec<u32>>,
}

impl Bands {
    pub(crate) fn new(frame: &Frame, ribbons: &[&Leaf], shift: [f64; 2]) -> Bands {
        let spans: Vec<(f64, f64)> = ribbons
            .par_iter()
            .map(|leaf| {
                let nodes = project(frame, leaf, shift);
                nodes.iter().fold((f64::INFINITY, f64::NEG_INFINITY), |(low, high), node| {
                    let reach = node.half_px + REACH_PX;
                    (low.min(node.v_px - reach), high.max(node.v_px + reach))
                })
            })
            .collect();
        let height = frame.height_px as usize;
        let mut lists = vec![Vec::new(); height.div_ceil(BAND_ROWS)];
        for (leaf, (low, high)) in spans.into_iter().enumerate() {
            if high < 0.0 || low > (height - 1) as f64 {
                continue;
            }
            let last = (high as usize).min(height - 1) / BAND_ROWS;
            for list in &mut lists[low.max(0.0) as usize / BAND_ROWS..=last] {
                list.push(leaf as u32);
            }
        }
        Bands { lists }
    }

    /// The numbers of the ribbons that touch a band, ascending.
    pub(crate) fn numbers(&self, band: usize) -> &[u32] {
        &self.lists[band]
    }

    pub(crate) fn leaves<'a>(
        &'a self,
        band: usize,
        ribbons: &'a [&'a Leaf],
    ) -> impl Iterator<Item = &'a Leaf> {
        self.lists[band].iter().map(|&leaf| ribbons[leaf as usize])
    }
}

/// A pixel that a segment of a ribbon covers.
pub(crate) struct Hit {
    pub(crate) u: usize,
    pub(crate) v: usize,
    /// The segment, from 0.
    pub(crate) segment: usize,
    /// Where along the segment, in [0, 1].
    pub(crate) along: f64,
    /// Distance from the axis as a fraction of the reach there, in [-1, 1], positive on the left of
    /// the axis as seen in the picture with `v` down.
    pub(crate) across: f64,
}

/// Visits every pixel of `rows` that a ribbon covers by the pixel rule, once per segment that
/// covers it.
pub(crate) fn sweep(nodes: &[Node], width: usize, rows: &Range<usize>, mut visit: impl FnMut(Hit)) {
    for (segment, pair) in nodes.windows(2).enumerate() {
        let (a, b) = (pair[0], pair[1]);
        let (du, dv) = (b.u_px - a.u_px, b.v_px - a.v_px);
        let length2 = du * du + dv * dv;
        let reach = a.half_px.max(b.half_px) + REACH_PX;
        let columns = whole(a.u_px.min(b.u_px) - reach, a.u_px.max(b.u_px) + reach, &(0..width));
        for v in whole(a.v_px.min(b.v_px) - reach, a.v_px.max(b.v_px) + reach, rows) {
            let pv = v as f64 - a.v_px;
            for u in columns.clone() {
                let pu = u as f64 - a.u_px;
                let along = if length2 > 0.0 {
                    ((pu * du + pv * dv) / length2).clamp(0.0, 1.0)
                } else {
                    0.0
                };
                let (ru, rv) = (pu - along * du, pv - along * dv);
                let reach = a.half_px + along * (b.half_px - a.half_px) + REACH_PX;
                let distance2 = ru * ru + rv * rv;
                if distance2 <= reach * reach {
                    let side = (du * rv - dv * ru).signum();
                    let across = side * distance2.sqrt() / reach;
                    visit(Hit { u, v, segment, along, across });
                }
            }
        }
    }
}

/// The whole numbers from `low` to `high`, both included, that lie in `limits`.
fn whole(low: f64, high: f64, limits: &Range<usize>) -> Range<usize> {
    // A conversion to usize saturates at 0 from below.
    let first = (low.ceil() as usize).max(limits.start);
    let end = if high < 0.0 { 0 } else { (high.floor() as usize + 1).min(limits.end) };
    first..end.max(first)
}

#[cfg(test)]
mod tests {
    use super::*;
    use crate::field::{FieldConfig, GrowthStage};

    /// The pixel rule without any bounding: every pixel against every segment.
    fn exhaustive(field: &Field) -> GrayImage {
        GrayImage::from_fn(field.frame.width_px, field.frame.height_px, |u, v| {
            let near = field.leaves().any(|leaf| {
                project(&field.frame, leaf, [0.0; 2]).windows(2).any(|pair| {
                    let d = [pair[1].u_px - pair[0].u_px, pair[1].v_px - pair[0].v_px];
                    let p = [f64::from(u) - pair[0].u_px, f64::from(v) - pair[0].v_px];
                    let t =
                        ((p[0] * d[0] + p[1] * d[1]) / (d[0] * d[0] + d[1] * d[1])).clamp(0.0, 1.0);
                    let half = (1.0 - t) * pair[0].half_px + t * pair[1].half_px;
                    f64::hypot(p[0] - t * d[0], p[1] - t * d[1]) <= half + 0.5
                })
            });
            image::Luma([if near { 255 } else { 0 }])
        })
    }

    #[test]
    fn the_mask_is_the_pixel_rule_applied_to_every_pixel() {
        for (stage, gsd_m, margin_m) in [
            (GrowthStage::Early, 0.015, 0.1),
            (GrowthStage::Late, 0.02, 0.0),
            (GrowthStage::Mid, 0.005, 0.05),
        ] {
            let config = FieldConfig {
                rows: 2,
                row_length_m: 0.8,
                heading_deg: 30.0,
                stage,
                gsd_m,
                margin_m,
                ..FieldConfig::default()
            };
            let field = Field::plant(&config).unwrap();
            let (drawn, expected) = (mask(&field, &[]), exhaustive(&field));
            let differing = drawn.iter().zip(expected.iter()).filter(|(a, b)| a != b).count();
            assert_eq!(differing, 0, "{stage}");
            assert!(drawn.contains(&255));
        }
    }

    #[test]
    fn leaves_reach_across_bands() {
        let config = FieldConfig {
            rows: 1,
            row_length_m: 8.0,
            heading_deg: 90.0,
            gsd_m: 0.01,
            ..FieldConfig::default()
        };
        let field = Field::plant(&config).unwrap();
        assert!(field.frame.height_px as usize > 4 * BAND_ROWS);
        assert_eq!(mask(&field, &[]), exhaustive(&field));
    }

    #[test]
    fn whole_numbers_are_those_inside() {
        assert_eq!(whole(-3.5, 2.0, &(0..10)), 0..3);
        assert_eq!(whole(1.2, 1.8, &(0..10)).len(), 0);
        assert_eq!(whole(-5.0, -1.0, &(0..10)).len(), 0);
        assert_eq!(whole(8.0, 99.0, &(4..10)), 8..10);
        assert_eq!(whole(20.0, 30.0, &(4..10)).len(), 0);
    }
}
