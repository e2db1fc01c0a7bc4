//! What masks and plants are like, in numbers that do not depend on the scale: the same for photos and synthetic fields.
//!
//! Lengths are over the spacing in the rows, areas over its square. A plant belongs to the nearest component of leaf pixels within
//! a quarter of the spacing. Gaps between neighbours in a row are over their median: from 1.5 on plants are missing, below 0.35
//! two plants share a site; from those between comes the jitter along, `sd / sqrt 2`, as two plants make a gap.

use crate::real_locators::{Case, Ready};
use rowgram::robust::median;
use rowgram::{
    phenotype::rows::Rows,
    raster::{Mask, components},
};

/// Names and meanings, in the order of [`of`].
pub(crate) const NAMES: [(&str, &str); 16] = [
    ("cover", "share of leaf in the bounding box of the plants and half a spacing around"),
    ("leaf_area", "leaf pixels per plant over the squared spacing"),
    ("leaf_px", "leaf pixels per plant"),
    ("reach", "median distance of a leaf pixel from the nearest plant"),
    ("off_centre", "median distance of a plant from the middle of the leaf pixels nearest to it"),
    ("shared_mass", "share of the leaf pixels in components of several plants"),
    ("stray_mass", "share of the leaf pixels in components with no plant within half a spacing"),
    ("bare_plants", "share of the plants without a leaf pixel within a quarter of the spacing"),
    ("parts_per_plant", "components of at least 5 pixels per plant"),
    ("area_cv", "coefficient of variation of the area of components of one plant"),
    ("leaf_width", "twice the leaf pixels over the border pixels"),
    ("jitter_along", "scatter of the plants along the row"),
    ("jitter_across", "scatter of the plants about a straight row"),
    ("missing", "missing plants over sites, from gaps"),
    ("doubles", "share of the gaps between plants of one site"),
    ("row_spacing", "distance between rows"),
];

/// The statistics of a case; what cannot be told is none.
pub(crate) fn of(ready: &Ready<'_>) -> [Option<f64>; 16] {
    let Case { mask, truth, spacing_px: spacing, .. } = ready.case;
    let plants = truth.len().max(1) as f64;
    let pixels = mask.data.iter().filter(|&&y| y != 0).count() as f64;
    let mut found = [None; 16];
    found[0] = cover(mask, truth, 0.5 * spacing);
    found[1] = Some(pixels / plants / (spacing * spacing));
    found[2] = Some(pixels / plants);
    if let Some([reach, off_centre]) = spread(mask, truth, *spacing) {
        (found[3], found[4]) = (Some(reach), Some(off_centre));
    }
    for (place, value) in parts(mask, truth, *spacing).into_iter().enumerate() {
        found[5 + place] = value;
    }
    let border = border(mask);
    found[10] = (border > 0.0).then(|| 2.0 * pixels / border / spacing);
    if let Some(rows) = ready.detection.rows() {
        for (place, value) in sowing(truth, rows, *spacing).into_iter().enumerate() {
            found[11 + place] = value;
        }
        found[15] = rows.spacing_px.map(|px| px / spacing);
    }
    found
}

fn cover(mask: &Mask, truth: &[[f64; 2]], around: f64) -> Option<f64> {
    let ends = |k: usize, most: usize| {
        let of = |f: fn(f64, f64) -> f64, from: f64| truth.iter().map(|t| t[k]).fold(from, f);
        let low = (of(f64::min, f64::INFINITY) - around).max(0.0) as usize;
        let high = (of(f64::max, 0.0) + around).max(0.0) as usize;
        low.min(most)..high.min(most)
    };
    let (columns, lines) = (ends(0, mask.width), ends(1, mask.height));
    let area = (columns.len() * lines.len()) as f64;
    let line = |v: usize| &mask.data[v * mask.width + columns.start..v * mask.width + columns.end];
    let leaf: usize = lines.map(|v| line(v).iter().filter(|&&y| y != 0).count()).sum();
    (area > 0.0).then(|| leaf as f64 / area)
}

/// Median distance of the pixels from the plants, and of the plants from the middle of their pixels.
fn spread(mask: &Mask, truth: &[[f64; 2]], spacing: f64) -> Option<[f64; 2]> {
    let mut distances = Vec::new();
    let mut sums = vec![[0.0; 3]; truth.len()];
    for (n, _) in mask.data.iter().enumerate().filter(|(_, y)| **y != 0) {
        let at = [(n % mask.width) as f64, (n / mask.width) as f64];
        let (p, d) = nearest(truth, at)?;
        distances.push(d / spacing);
        // Weeds far away belong to nobody.
        if d < spacing {
            sums[p] = [sums[p][0] + at[0], sums[p][1] + at[1], sums[p][2] + 1.0];
        }
    }
    let apart: Vec<f64> = sums
        .iter()
        .zip(truth)
        .filter(|(sum, _)| sum[2] > 0.0)
        .map(|(sum, t)| (sum[0] / sum[2] - t[0]).hypot(sum[1] / sum[2] - t[1]) / spacing)
        .collect();
    Some([median(distances)?, median(apart)?])
}

fn nearest(truth: &[[f64; 2]], at: [f64; 2]) -> Option<(usize, f64)> {
    let squared = |t: &[f64; 2]| (t[0] - at[0]).powi(2) + (t[1] - at[1]).powi(2);
    let all = truth.iter().map(squared).enumerate();
    all.min_by(|a, b| a.1.total_cmp(&b.1)).map(|(p, d2)| (p, d2.sqrt()))
}

/// Shared mass, stray mass, bare plants, parts per plant, and the variation of the area of single plants.
fn parts(mask: &Mask, truth: &[[f64; 2]], spacing: f64) -> [Option<f64>; 5] {
    let parts = components::parts(mask);
    let total: usize = parts.iter().map(|part| part.pixels).sum();
    let mut owner = vec![(usize::MAX, 0.25 * spacing); truth.len()];
    let mut stray = 0;
    for (k, part) in parts.iter().enumerate() {
        let mut near = f64::INFINITY;
        for (p, at) in truth.iter().enumerate() {
            let apart = |run: &components::Run| {
                let u = at[0].clamp(f64::from(run.start), f64::from(run.end) - 1.0);
                (u - at[0]).hypot(f64::from(run.v) - at[1])
            };
            let window = &part.window;
            let beyond = |x: f64, low: usize, length: usize| {
                (low as f64 - x).max(x - (low + length) as f64).max(0.0)
            };
            let box_px =
                beyond(at[0], window.u, window.width).hypot(beyond(at[1], window.v, window.height));
            if box_px > 0.5 * spacing {
                continue;
            }
            let distance = part.runs.iter().map(apart).fold(f64::INFINITY, f64::min);
            near = near.min(distance);
            if distance < owner[p].1 {
                owner[p] = (k, distance);
            }
        }
        if near > 0.5 * spacing {
            stray += part.pixels;
        }
    }
    let mut plants = vec![0_usize; parts.len()];
    owner.iter().filter(|o| o.0 != usize::MAX).for_each(|o| plants[o.0] += 1);
    let of = |wanted: fn(usize) -> bool| -> Vec<f64> {
        let mine = parts.iter().zip(&plants).filter(|(_, count)| wanted(**count));
        mine.map(|(part, _)| part.pixels as f64).collect()
    };
    let share = |mass: f64| (total > 0).then(|| mass / total as f64);
    let bare = owner.iter().filter(|o| o.0 == usize::MAX).count() as f64;
    let count = truth.len().max(1) as f64;
    let large = parts.iter().filter(|part| part.pixels >= 5).count() as f64;
    let single = of(|count| count == 1);
    let cv = (single.len() > 4).then(|| deviation(&single) / mean(&single));
    [
        share(of(|count| count > 1).iter().sum()),
        share(stray as f64),
        Some(bare / count),
        Some(large / count),
        cv,
    ]
}

/// Leaf pixels with a neighbour above, below, left or right that is none.
fn border(mask: &Mask) -> f64 {
    let leaf = |u: isize, v: isize| {
        let inside =
            (0..mask.width as isize).contains(&u) && (0..mask.height as isize).contains(&v);
        inside && mask.data[v as usize * mask.width + u as usize] != 0
    };
    let open = |n: usize| {
        let (u, v) = ((n % mask.width) as isize, (n / mask.width) as isize);
        leaf(u, v) && [(1, 0), (-1, 0), (0, 1), (0, -1)].iter().any(|(a, b)| !leaf(u + a, v + b))
    };
    (0..mask.data.len()).filter(|&n| open(n)).count() as f64
}

/// Jitter along and across, missing plants, doubles.
fn sowing(truth: &[[f64; 2]], rows: &Rows, spacing: f64) -> [Option<f64>; 4] {
    let mut places: Vec<[f64; 2]> = truth.iter().map(|&at| rows.axes.aligned(at)).collect();
    places.sort_by(|a, b| a[1].total_cmp(&b[1]));
    let cut = 0.4 * rows.spacing_px.unwrap_or(f64::INFINITY);
    let mut lines: Vec<Vec<[f64; 2]>> = Vec::new();
    for place in places {
        match lines.last_mut().filter(|row| row.last().is_some_and(|p| place[1] - p[1] < cut)) {
            Some(row) => row.push(place),
            None => lines.push(vec![place]),
        }
    }
    let (mut gaps, mut across) = (Vec::new(), Vec::new());
    for row in &mut lines {
        row.sort_by(|a, b| a[0].total_cmp(&b[0]));
        gaps.extend(row.windows(2).map(|pair| pair[1][0] - pair[0][0]));
        across.extend(residuals(row));
    }
    let middle = median(gaps.iter().copied()).filter(|gap| *gap > 0.0 && gaps.len() >= 6);
    let Some(middle) = middle else { return [None; 4] };
    gaps.iter_mut().for_each(|gap| *gap /= middle);
    let usual: Vec<f64> = gaps.iter().copied().filter(|gap| (0.35..1.5).contains(gap)).collect();
    let missing: f64 = gaps.iter().map(|gap| (gap.round() - 1.0).max(0.0)).sum();
    let doubles = gaps.iter().filter(|gap| **gap < 0.35).count() as f64;
    let rms = (across.iter().map(|d| d * d).sum::<f64>() / across.len().max(1) as f64).sqrt();
    [
        (usual.len() > 2).then(|| deviation(&usual) / std::f64::consts::SQRT_2),
        (across.len() > 5).then_some(rms / spacing),
        Some(missing / (truth.len() as f64 + missing)),
        Some(doubles / gaps.len() as f64),
    ]
}

/// Distances across from the straight line through the plants of a row of at least 4, which takes two degrees of freedom.
fn residuals(row: &[[f64; 2]]) -> Vec<f64> {
    if row.len() < 4 {
        return Vec::new();
    }
    let n = row.len() as f64;
    let [s, t] = [0, 1].map(|k| row.iter().map(|p| p[k]).sum::<f64>() / n);
    let of = |f: &dyn Fn(&[f64; 2]) -> f64| row.iter().map(f).sum::<f64>();
    let slope = of(&|p| (p[0] - s) * (p[1] - t)) / of(&|p| (p[0] - s).powi(2)).max(1e-9);
    let wider = (n / (n - 2.0)).sqrt();
    row.iter().map(|p| wider * (p[1] - t - slope * (p[0] - s))).collect()
}

fn mean(values: &[f64]) -> f64 {
    values.iter().sum::<f64>() / values.len().max(1) as f64
}

fn deviation(values: &[f64]) -> f64 {
    let middle = mean(values);
    let squares: f64 = values.iter().map(|x| (x - middle).powi(2)).sum();
    (squares / (values.len() as f64 - 1.0).max(1.0)).sqrt()
}

#[cfg(test)]
mod tests {
    use super::*;

    fn square(mask: &mut Mask, at: [usize; 2], half: usize) {
        for v in at[1] - half..=at[1] + half {
            for u in at[0] - half..=at[0] + half {
                mask.data[v * mask.width + u] = 1;
            }
        }
    }

    #[test]
    fn squares_in_a_row_have_the_statistics_that_they_were_drawn_with() {
        let mut mask = Mask::empty(400, 100);
        let mut truth = Vec::new();
        for row in 0..3 {
            for k in 0..18 {
                // Site 9 is empty, and there are no columns.
                if k != 9 {
                    let at = [20 + 20 * k + 7 * row, 20 + 30 * row];
                    square(&mut mask, at, 2);
                    truth.push([at[0] as f64, at[1] as f64]);
                }
            }
        }
        // A weed between the rows, as large as each of the 51 plants.
        square(&mut mask, [110, 35], 2);
        let (set, photo) = (String::new(), String::new());
        let case = Case { set, photo, mask, posterior: None, truth, spacing_px: 20.0 };
        let found = of(&Ready::new(&case));
        let value = |name: &str| found[NAMES.iter().position(|n| n.0 == name).unwrap()].unwrap();
        assert!((value("stray_mass") - 1.0 / 52.0).abs() < 1e-12, "{found:?}");
        assert!((value("leaf_area") - 52.0 * 25.0 / 51.0 / 400.0).abs() < 1e-12);
        assert!((value("missing") - 3.0 / 54.0).abs() < 1e-12, "{}", value("missing"));
        assert!(value("jitter_along") < 1e-9 && value("jitter_across") < 1e-9);
        assert!(value("shared_mass") == 0.0 && value("bare_plants") == 0.0);
        // 25 pixels, 16 of them at the border.
        assert!((value("leaf_width") - 2.0 * 25.0 / 16.0 / 20.0).abs() < 1e-12);
    }
}
