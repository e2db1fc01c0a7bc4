//! Segments that are more than one leaf, told by their width.
//!
//! A grass leaf has one widest place: its width rises from the collar and falls to the tip. So a
//! segment is cut
//!
//! - *across*, where its width has a deep minimum between two maxima, or where it has a kink: two leaves that follow
//!   each other, such as the opposite leaves of a plant, base to base;
//! - *lengthwise*, where it is about twice as wide as a single leaf over a longer stretch: two leaves side
//!   by side, which share the stretch along its axis.

use super::{
    axis::{Axis, distance},
    part::Local,
    segments::{Across, Segment},
    slices::turn,
};

/// A minimum is deep below this share of the smaller of the maxima on its two sides.
const DEEP: f64 = 0.62;
/// A bend by more than this within three widths is a kink, radians.
const KINK: f64 = 0.6;

/// Cuts segments; `widths_px`: the usual width of a leaf, and that from which on there are two side by side.
pub(super) fn split(
    local: &Local,
    across: &Across,
    number: &[u32],
    segments: Vec<Segment>,
    widths_px: [f64; 2],
) -> Vec<Segment> {
    let mut pieces = Vec::with_capacity(segments.len());
    for segment in segments {
        for piece in at_minima(local, across, number, segment) {
            lengthwise(local, across, number, piece, widths_px, &mut pieces);
        }
    }
    pieces
}

/// The places where an axis has a kink: of neighbouring ones the sharpest.
fn kinks(axis: &Axis) -> Vec<usize> {
    let points = &axis.points;
    let reach = (1.5 * axis.mean_width()).max(3.0);
    let sharpness: Vec<f64> = (0..points.len())
        .map(|i| {
            let ahead = (i..points.len()).find(|&j| distance(points[i], points[j]) >= reach);
            let behind = (0..=i).rev().find(|&j| distance(points[i], points[j]) >= reach);
            let (Some(a), Some(b)) = (behind, ahead) else { return 0.0 };
            let angle = |p: [f64; 2], q: [f64; 2]| (q[1] - p[1]).atan2(q[0] - p[0]);
            turn(angle(points[a], points[i]), angle(points[i], points[b]))
        })
        .collect();
    (1..points.len().saturating_sub(1))
        .filter(|&i| {
            let near = |j: &usize| distance(points[i], points[*j]) < reach;
            let before = (0..i).rev().take_while(near).all(|j| sharpness[j] < sharpness[i]);
            let after =
                (i + 1..points.len()).take_while(near).all(|j| sharpness[j] <= sharpness[i]);
            sharpness[i] > KINK && before && after
        })
        .collect()
}

/// The pieces of a segment between the deep minima of its width, and its kinks.
fn at_minima(local: &Local, across: &Across, number: &[u32], segment: Segment) -> Vec<Segment> {
    let widths = &segment.axis.widths;
    let mut cuts = Vec::new();
    let mut from = 0;
    while let Some(cut) = deepest(&segment.axis, from) {
        cuts.push(cut);
        from = cut;
        if cuts.len() > widths.len() {
            break;
        }
    }
    cuts.extend(kinks(&segment.axis));
    cuts.sort_unstable();
    cuts.dedup();
    if cuts.is_empty() {
        return vec![segment];
    }
    let mut sets = vec![Vec::new(); cuts.len() + 1];
    for &pixel in &segment.pixels {
        let point = nearest(&segment.axis, local.at(pixel));
        sets[cuts.partition_point(|&cut| cut < point)].push(pixel);
    }
    rebuild(local, across, number, sets)
}

/// The first deep minimum behind the point `from` of the axis.
fn deepest(axis: &Axis, from: usize) -> Option<usize> {
    let widths = &axis.widths;
    let mean = axis.mean_width();
    let mut before = 0.0f64;
    let mut along = 0.0;
    for i in from + 1..widths.len().saturating_sub(1) {
        before = before.max(widths[i - 1]);
        along += distance(axis.points[i - 1], axis.points[i]);
        if widths[i] > widths[i - 1] || widths[i] > widths[i + 1] || along < 2.0 * mean {
            continue;
        }
        let after = widths[i + 1..].iter().copied().fold(0.0, f64::max);
        let rest: f64 = axis.points[i..].windows(2).map(|pair| distance(pair[0], pair[1])).sum();
        if widths[i] < DEEP * before.min(after) && rest > 2.0 * mean {
            return Some(i);
        }
    }
    None
}

/// Cuts the stretches that are two leaves wide along their axis.
fn lengthwise(
    local: &Local,
    across: &Across,
    number: &[u32],
    segment: Segment,
    [single_px, double_px]: [f64; 2],
    pieces: &mut Vec<Segment>,
) {
    let axis = &segment.axis;
    let wide: Vec<bool> = axis.widths.iter().map(|&width| width > double_px).collect();
    let steps = axis.points.windows(2).zip(wide.windows(2));
    let length: f64 = steps
        .filter(|(_, wide)| wide[0] && wide[1])
        .map(|(pair, _)| distance(pair[0], pair[1]))
        .sum();
    if length < 3.0 * single_px {
        pieces.push(segment);
        return;
    }
    // Left, right and, where one leaf alone goes on, the narrow rest on either side of the double stretch.
    let first = wide.iter().position(|&wide| wide).unwrap_or(0);
    let last = wide.iter().rposition(|&wide| wide).unwrap_or(0);
    let mut sets = vec![Vec::new(); 4];
    for &pixel in &segment.pixels {
        let at = local.at(pixel);
        let point = nearest(axis, at);
        if point < first {
            sets[0].push(pixel);
        } else if point > last {
            sets[1].push(pixel);
        } else {
            let next = (point + 1).min(axis.points.len() - 1);
            let (a, b) = (axis.points[next - 1], axis.points[next]);
            let side = (b[0] - a[0]) * (at[1] - a[1]) - (b[1] - a[1]) * (at[0] - a[0]);
            sets[if side > 0.0 { 2 } else { 3 }].push(pixel);
        }
    }
    let cut = rebuild(local, across, number, sets);
    pieces.extend(cut);
}

fn rebuild(local: &Local, across: &Across, number: &[u32], sets: Vec<Vec<u32>>) -> Vec<Segment> {
    let usable = sets.into_iter().filter(|pixels| pixels.len() >= 3);
    usable
        .map(|pixels| {
            let axis = Axis::of(local, across, number, &pixels);
            Segment { pixels, axis }
        })
        .collect()
}

fn nearest(axis: &Axis, at: [f64; 2]) -> usize {
    let mut best = (f64::INFINITY, 0);
    for (index, &point) in axis.points.iter().enumerate() {
        let d = distance(point, at);
        if d < best.0 {
            best = (d, index);
        }
    }
    best.1
}
