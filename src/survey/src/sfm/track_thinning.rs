//! Fewer tie points where there are more than an adjustment needs.
//!
//! Memory and time of an adjustment grow with image measurements, its accuracy hardly does: neighbouring tie points have the same errors. So
//! of a large block the longest tracks are kept that leave no part of an image without: images are cut into cells, tracks are
//! looked at from the longest on, and one is kept where any of its members lies in a cell with fewer than `q` kept so far. `q` is
//! the largest that fits into the number wanted; what is left of that goes to tracks that `q + 1` would keep.

use super::{Features, tracks::Tracks};

/// Cells of an image in each direction. Not searched for; a block with 1,500 features in an image, six for each cell, was as exact as one with
/// 6,000 (`docs/optimisation.md`).
const CELLS: usize = 16;

impl Tracks {
    /// At most `most` members in the longest tracks that cover every image; more only where one track in each cell of an image takes
    /// more. Everything where it is no more than that.
    pub fn thinned(self, features: &[Features], most: usize) -> Tracks {
        if self.member_count() <= most {
            return self;
        }
        let cells = self.cells(features);
        let mut order: Vec<u32> = (0..self.count() as u32).collect();
        order.sort_by_key(|&track| std::cmp::Reverse(self.of(track as usize).len()));
        let mut counts = vec![0u32; features.len() * CELLS * CELLS];
        // Adds what a quota keeps, up to `most` members; whether that was all.
        let mut add = |kept: &mut [bool], quota: u32, most: usize| {
            counts.fill(0);
            let mut total = 0;
            let of = |track: u32| &cells[self.places(track as usize)];
            for &track in order.iter().filter(|&&track| kept[track as usize]) {
                of(track).iter().for_each(|&cell| counts[cell as usize] += 1);
                total += of(track).len();
            }
            for &track in &order {
                let cells = of(track);
                let is_wanted = cells.iter().any(|&cell| counts[cell as usize] < quota);
                if kept[track as usize] || !is_wanted {
                    continue;
                }
                total += cells.len();
                if total > most {
                    return false;
                }
                cells.iter().for_each(|&cell| counts[cell as usize] += 1);
                kept[track as usize] = true;
            }
            true
        };
        let mut found = vec![false; self.count()];
        add(&mut found, 1, usize::MAX);
        // The largest quota that fits lies between these two.
        let (mut fits, mut exceeds) = (1, most as u32 + 1);
        while exceeds - fits > 1 {
            let quota = if exceeds > 2 * fits { 2 * fits } else { fits.midpoint(exceeds) };
            let mut kept = vec![false; self.count()];
            match add(&mut kept, quota, most) {
                true => (fits, found) = (quota, kept),
                false => exceeds = quota,
            }
        }
        add(&mut found, fits + 1, most);
        let thinned = self.only(&found);
        tracing::debug!(
            "{} of {} tie points, {} of {} measurements are adjusted: {fits} in each cell of a photo",
            thinned.count(),
            self.count(),
            thinned.member_count(),
            self.member_count()
        );
        thinned
    }

    /// The cell of each member, of those of all images.
    fn cells(&self, features: &[Features]) -> Vec<u32> {
        let bounds: Vec<[[f64; 2]; 2]> = features
            .iter()
            .map(|of| {
                [0, 1].map(|k| {
                    let at = of.positions_px.iter().map(|at| at[k]);
                    let low = at.clone().fold(f64::INFINITY, f64::min);
                    [low, (at.fold(f64::NEG_INFINITY, f64::max) - low).max(1e-9)]
                })
            })
            .collect();
        (0..self.member_count())
            .map(|place| {
                let member = self.member(place);
                let image = member.image as usize;
                let at = features[image].positions_px[member.feature as usize];
                let [u, v] = [0, 1].map(|k| {
                    let [low, extent] = bounds[image][k];
                    ((CELLS as f64 * (at[k] - low) / extent) as usize).min(CELLS - 1)
                });
                ((image * CELLS + v) * CELLS + u) as u32
            })
            .collect()
    }
}

#[cfg(test)]
mod tests {
    use super::*;
    use std::collections::BTreeSet;

    /// A strip of 30 images of 4000 features, each seen by the two to six images that show its place.
    fn strip() -> (Vec<Features>, Tracks) {
        let mut features = vec![Features::default(); 30];
        let mut pairs: std::collections::BTreeMap<[u32; 2], Vec<[u32; 2]>> = Default::default();
        for point in 0..20_000u32 {
            let (x, y) = (f64::from(point % 1000) / 1000.0 * 34.0, f64::from(point / 1000) / 20.0);
            // Some are seen by fewer images than show them.
            let most = 2 + (point as usize * 7) % 5;
            let images = (0..30u32).filter(|&k| (0.0..6.0).contains(&(x - f64::from(k))));
            let mut last: Option<[u32; 2]> = None;
            for image in images.take(most) {
                let of = &mut features[image as usize];
                of.positions_px.push([100.0 * (x - f64::from(image)), 450.0 * y]);
                let own = [image, of.positions_px.len() as u32 - 1];
                if let Some([image, feature]) = last {
                    pairs.entry([image, own[0]]).or_default().push([feature, own[1]]);
                }
                last = Some(own);
            }
        }
        let tracks = Tracks::of_pairs(&features, pairs.iter().map(|(of, m)| (*of, m.as_slice())));
        (features, tracks)
    }

    #[test]
    fn the_longest_are_kept_and_every_part_of_an_image_keeps_some() {
        let (features, tracks) = strip();
        let all = tracks.member_count();
        assert_eq!(tracks.clone().thinned(&features, all), tracks);
        let most = all / 3;
        let thinned = tracks.clone().thinned(&features, most);
        assert!((most * 9 / 10..=most).contains(&thinned.member_count()), "{all}");
        let mean = |tracks: &Tracks| tracks.member_count() as f64 / tracks.count() as f64;
        assert!(mean(&thinned) > 1.1 * mean(&tracks), "{} {}", mean(&thinned), mean(&tracks));
        let covered =
            |tracks: &Tracks| tracks.cells(&features).into_iter().collect::<BTreeSet<u32>>();
        assert_eq!(covered(&thinned), covered(&tracks));
        for track in 0..thinned.count() {
            for (image, place) in
                thinned.of(track).iter().map(|m| m.image).zip(thinned.places(track))
            {
                assert!(thinned.in_image(image as usize).contains(&(track as u32, place as u32)));
            }
        }
        // Fewer than cover all images are not kept.
        let least = tracks.clone().thinned(&features, 10);
        assert_eq!(covered(&least), covered(&tracks));
        assert!(least.member_count() < thinned.member_count());
    }
}
