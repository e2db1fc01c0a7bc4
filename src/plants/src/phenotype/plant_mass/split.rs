//! Plants of one component: its pixels cut into as many groups as it holds plants.
//!
//! ```text
//! min sum_i w_i min_p |z_i - x_p|^2,   w_i the posterior of pixel i
//! ```
//!
//! by Lloyd's descent, started from quantiles along the longest axis of the component.

/// A pixel `[u, v]` and its weight.
pub type Weighted = ([f64; 2], f64);

/// Most pixels that the descent looks at; larger components are thinned.
const PIXELS: usize = 4000;

/// The middles of `plants` groups of pixels, in pixels, along the longest axis.
pub fn split(pixels: &[Weighted], plants: usize) -> Vec<[f64; 2]> {
    let step = pixels.len().div_ceil(PIXELS).max(1);
    let pixels: Vec<Weighted> = pixels.iter().copied().step_by(step).collect();
    let Some(middle) = mean(pixels.iter()) else { return Vec::new() };
    let plants = plants.min(pixels.len());
    if plants <= 1 {
        return vec![middle; plants];
    }
    let axis = longest_axis(&pixels, middle);
    let along = |z: &[f64; 2]| (z[0] - middle[0]) * axis[0] + (z[1] - middle[1]) * axis[1];
    let mut sorted = pixels.clone();
    sorted.sort_by(|a, b| along(&a.0).total_cmp(&along(&b.0)));
    let part = |p: usize| p * sorted.len() / plants..(p + 1) * sorted.len() / plants;
    let mut centres: Vec<[f64; 2]> =
        (0..plants).filter_map(|p| mean(sorted[part(p)].iter())).collect();
    for _ in 0..30 {
        let mut sums = vec![[0.0; 3]; centres.len()];
        for (z, weight) in &pixels {
            let sum = &mut sums[nearest(&centres, z)];
            *sum = [sum[0] + weight * z[0], sum[1] + weight * z[1], sum[2] + weight];
        }
        let mut moved = 0.0_f64;
        for (centre, sum) in centres.iter_mut().zip(sums).filter(|(_, sum)| sum[2] > 0.0) {
            let next = [sum[0] / sum[2], sum[1] / sum[2]];
            moved = moved.max((next[0] - centre[0]).hypot(next[1] - centre[1]));
            *centre = next;
        }
        if moved < 0.01 {
            break;
        }
    }
    centres.sort_by(|a, b| along(a).total_cmp(&along(b)));
    centres
}

fn nearest(centres: &[[f64; 2]], z: &[f64; 2]) -> usize {
    let squared = |c: &[f64; 2]| (c[0] - z[0]).powi(2) + (c[1] - z[1]).powi(2);
    let closer = |best, p| if squared(&centres[p]) < squared(&centres[best]) { p } else { best };
    (1..centres.len()).fold(0, closer)
}

fn mean<'a>(pixels: impl Iterator<Item = &'a Weighted>) -> Option<[f64; 2]> {
    let [u, v, weight] = pixels.fold([0.0; 3], |sum, (z, weight)| {
        [sum[0] + weight * z[0], sum[1] + weight * z[1], sum[2] + weight]
    });
    (weight > 0.0).then(|| [u / weight, v / weight])
}

fn longest_axis(pixels: &[Weighted], middle: [f64; 2]) -> [f64; 2] {
    let [uu, uv, vv] = pixels.iter().fold([0.0; 3], |sum, (z, weight)| {
        let (u, v) = (z[0] - middle[0], z[1] - middle[1]);
        [sum[0] + weight * u * u, sum[1] + weight * u * v, sum[2] + weight * v * v]
    });
    let angle = 0.5 * (2.0 * uv).atan2(uu - vv);
    [angle.cos(), angle.sin()]
}

#[cfg(test)]
mod tests {
    use super::*;

    fn disc(u: f64, v: f64) -> impl Iterator<Item = Weighted> {
        let at = move |i: i32, j: i32| ([u + f64::from(i), v + f64::from(j)], 1.0);
        (-6..=6)
            .flat_map(move |i| (-6..=6).map(move |j| (i, j)))
            .filter(|(i, j)| i * i + j * j <= 36)
            .map(move |(i, j)| at(i, j))
    }

    #[test]
    fn touching_discs_are_told_apart() {
        let places = [[10.0, 10.0], [20.0, 12.0], [31.0, 9.0]];
        let pixels: Vec<Weighted> = places.iter().flat_map(|p| disc(p[0], p[1])).collect();
        let found = split(&pixels, 3);
        for (found, place) in found.iter().zip(places) {
            assert!(
                (found[0] - place[0]).hypot(found[1] - place[1]) < 0.5,
                "{found:?}, expected {place:?}"
            );
        }
    }

    #[test]
    fn one_plant_stands_in_the_weighted_middle() {
        assert_eq!(split(&[([0.0, 0.0], 1.0), ([4.0, 2.0], 3.0)], 1), [[3.0, 1.5]]);
        assert!(split(&[], 2).is_empty());
        assert_eq!(split(&[([1.0, 1.0], 1.0)], 5).len(), 1);
    }
}
