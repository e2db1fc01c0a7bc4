//! How much of each leaf is seen from straight above.

use crate::{
    corrupt::Weed,
    field::{Field, Frame},
    render::{BAND_ROWS, Bands, Node, band_rows, project, ribbons, sweep},
};
use rayon::prelude::*;

/// Distance of the places that are looked at, metres.
const STEP_M: f64 = 0.004;

/// The visible part of every leaf's plan view, in the order of [`Field::leaves`]: of the places 4 mm apart that the leaf
/// covers, those where no other leaf lies higher. A leaf too small to cover any is wholly visible.
pub fn visible_fractions(field: &Field, weeds: &[Weed]) -> Vec<f64> {
    let count = field.leaves().count();
    // Tall leaves reach beyond the field's own raster.
    let margin_m = 1.0;
    let scale = field.frame.gsd_m / STEP_M;
    let size = |pixels: u32| (f64::from(pixels) * scale + 2.0 * margin_m / STEP_M).ceil() as u32;
    let frame = Frame {
        left_m: field.frame.left_m - margin_m,
        top_m: field.frame.top_m + margin_m,
        gsd_m: STEP_M,
        width_px: size(field.frame.width_px),
        height_px: size(field.frame.height_px),
    };
    let ribbons = ribbons(field, weeds);
    let bands = Bands::new(&frame, &ribbons, [0.0; 2]);
    let width = frame.width_px as usize;
    let height = frame.height_px as usize;
    let sums: Vec<Vec<(u32, u32, u32)>> = (0..height.div_ceil(BAND_ROWS))
        .into_par_iter()
        .map_init(
            || (Vec::new(), Vec::new()),
            |(top_m, top): &mut (Vec<f32>, Vec<u32>), band| {
                let rows = band_rows(band, BAND_ROWS.min(height - band * BAND_ROWS));
                top_m.clear();
                top_m.resize(rows.len() * width, f32::NEG_INFINITY);
                top.clear();
                top.resize(rows.len() * width, 0u32);
                let mut seen = Vec::new();
                let mut covered = Vec::new();
                for (local, &leaf) in bands.numbers(band).iter().enumerate() {
                    let nodes = project(&frame, ribbons[leaf as usize], [0.0; 2]);
                    // Segments overlap at their nodes; each place counts once.
                    covered.clear();
                    sweep(&nodes, width, &rows, |hit| {
                        let (a, b): (&Node, &Node) = (&nodes[hit.segment], &nodes[hit.segment + 1]);
                        let z_m = a.z_m + hit.along * (b.z_m - a.z_m);
                        covered.push(((hit.v - rows.start) * width + hit.u, z_m as f32));
                    });
                    covered.sort_unstable_by(|a, b| a.0.cmp(&b.0).then(b.1.total_cmp(&a.1)));
                    covered.dedup_by_key(|place| place.0);
                    for &(index, z_m) in &covered {
                        if z_m > top_m[index] {
                            top_m[index] = z_m;
                            top[index] = local as u32 + 1;
                        }
                    }
                    seen.push((leaf, covered.len() as u32, 0));
                }
                for &local in top.iter().filter(|&&local| local > 0) {
                    seen[local as usize - 1].2 += 1;
                }
                seen
            },
        )
        .collect();
    let mut totals = vec![(0u64, 0u64); count];
    for (leaf, covered, seen) in sums.into_iter().flatten() {
        if let Some(total) = totals.get_mut(leaf as usize) {
            total.0 += u64::from(covered);
            total.1 += u64::from(seen);
        }
    }
    totals
        .into_iter()
        .map(|(covered, seen)| if covered == 0 { 1.0 } else { seen as f64 / covered as f64 })
        .collect()
}

#[cfg(test)]
mod tests {
    use super::*;
    use crate::field::FieldConfig;

    #[test]
    fn the_highest_leaf_is_all_visible_and_hidden_ones_less() {
        let config =
            FieldConfig { rows: 2, row_length_m: 2.0, spacing_m: 0.1, ..FieldConfig::default() };
        let field = Field::plant(&config).unwrap();
        let visible = visible_fractions(&field, &[]);
        assert_eq!(visible.len(), field.leaves().count());
        assert!(visible.iter().all(|part| (0.0..=1.0).contains(part)));
        let mean = visible.iter().sum::<f64>() / visible.len() as f64;
        assert!((0.3..0.95).contains(&mean), "{mean}");
        let single =
            FieldConfig { rows: 1, row_length_m: 0.3, spacing_m: 0.3, jitter_along: 0.0, ..config };
        let mut field = Field::plant(&single).unwrap();
        field.plants.truncate(1);
        field.plants[0].leaves.truncate(1);
        assert_eq!(visible_fractions(&field, &[]), [1.0]);
    }
}
