//! Where a block starts: three images that see much of the same from different places and whose
//! pairs agree.
//!
//! A loop of three pairs closes where `R31 R23 R12 = I` up to noise, and the third baseline is the
//! sum of the other two for one choice of their lengths. Among the loops that close, the start is
//! the one with most points seen by all three at good angles.

use super::block::{Features, Pair};
use crate::sfm::tracks::Tracks;
use nalgebra::{Matrix3, Vector3};
use std::collections::HashMap;

/// Three images with the pairs between them.
#[derive(Debug, Clone, PartialEq)]
pub struct Triplet {
    /// Indices of the images, ascending.
    pub images: [u32; 3],
    /// Angle of the rotation that is left around the loop, radians.
    pub closure_rad: f64,
    /// What it is worth as a start.
    pub score: f64,
}

/// The most rotation that may be left around a loop, radians.
pub(super) const MAX_CLOSURE_RAD: f64 = 0.05;
/// The angle between rays at which a pair is as good as any, radians.
const GOOD_ANGLE_RAD: f64 = 0.17;

/// Pairs by their images, ascending.
pub struct Graph<'a> {
    pairs: &'a [Pair],
    places: HashMap<[u32; 2], usize>,
    neighbours: Vec<Vec<u32>>,
}

impl<'a> Graph<'a> {
    /// The graph of some pairs; each pair once, its images ascending.
    pub fn new(images: usize, pairs: &'a [Pair]) -> Graph<'a> {
        let mut graph =
            Graph { pairs, places: HashMap::new(), neighbours: vec![Vec::new(); images] };
        for (k, pair) in pairs.iter().enumerate() {
            graph.places.insert(pair.images, k);
            let [a, b] = pair.images;
            graph.neighbours[a as usize].push(b);
            graph.neighbours[b as usize].push(a);
        }
        graph.neighbours.iter_mut().for_each(|list| list.sort_unstable());
        graph
    }

    /// The pair of two images in either order.
    pub fn pair(&self, a: u32, b: u32) -> Option<&'a Pair> {
        self.places.get(&[a.min(b), a.max(b)]).map(|&k| &self.pairs[k])
    }

    /// Images that an image is paired with, ascending.
    pub fn neighbours(&self, image: u32) -> &[u32] {
        &self.neighbours[image as usize]
    }

    /// Rotation and unit translation that take the camera frame of `from` to that of `to`.
    pub fn relative(&self, from: u32, to: u32) -> Option<(Matrix3<f64>, Vector3<f64>)> {
        let pair = self.pair(from, to)?;
        let pose = if pair.images[0] == from { pair.pose } else { pair.pose.inverse() };
        Some((pose.rotation, pose.translation))
    }

    /// All loops of three among images that are `allowed`, by their score, best first.
    pub fn triplets(
        &self,
        tracks: &Tracks,
        features: &[Features],
        allowed: &[bool],
    ) -> Vec<Triplet> {
        let common = common_tracks(tracks, features.len());
        let mut found = Vec::new();
        for pair in self.pairs {
            let [a, b] = pair.images;
            for &c in self.neighbours(b).iter().filter(|&&c| c > b) {
                let three = [a, b, c];
                if !three.iter().all(|&k| allowed[k as usize]) {
                    continue;
                }
                if let Some(triplet) = self.triplet(three, &common) {
                    found.push(triplet);
                }
            }
        }
        found.sort_by(|x, y| y.score.total_cmp(&x.score).then(x.images.cmp(&y.images)));
        found
    }

    fn triplet(&self, [a, b, c]: [u32; 3], common: &HashMap<[u32; 3], usize>) -> Option<Triplet> {
        let (ab, bc, ac) = (self.relative(a, b)?, self.relative(b, c)?, self.relative(a, c)?);
        let loop_turn = ac.0.transpose() * bc.0 * ab.0;
        let closure_rad = (0.5 * (loop_turn.trace() - 1.0)).clamp(-1.0, 1.0).acos();
        // The baselines in the frame of the third image: R_bc t_ab, t_bc, t_ac.
        let (u, v, w) = (bc.0 * ab.1, bc.1, ac.1);
        let normal = u.cross(&v);
        // How far the baselines are from one plane, a sine. Three images in a row have no plane, and any third baseline fits.
        let out_of_plane = if normal.norm() < 0.1 { 0.0 } else { normal.normalize().dot(&w).abs() };
        let common = common.get(&[a, b, c]).copied().unwrap_or(0);
        if closure_rad > MAX_CLOSURE_RAD || out_of_plane > 0.3 || common < 10 {
            return None;
        }
        let good = |x: u32, y: u32| -> f64 {
            self.pair(x, y).map_or(0.0, |pair| (pair.angle_rad / GOOD_ANGLE_RAD).min(1.0))
        };
        let angle = good(a, b).max(good(b, c)).max(good(a, c));
        let sharp = 1.0 / (1.0 + (closure_rad / (0.2 * MAX_CLOSURE_RAD)).powi(2));
        let score = common as f64 * angle * sharp;
        Some(Triplet { images: [a, b, c], closure_rad, score })
    }
}

/// How many tracks each three images share.
fn common_tracks(tracks: &Tracks, images: usize) -> HashMap<[u32; 3], usize> {
    let mut counts = HashMap::new();
    debug_assert!(images > 0 || tracks.count() == 0);
    for track in 0..tracks.count() {
        let members = tracks.of(track);
        // Long tracks have many threes; neighbours in the list say enough.
        let reach = if members.len() > 12 { 4 } else { members.len() };
        for i in 0..members.len() {
            for j in i + 1..members.len().min(i + reach) {
                for k in j + 1..members.len().min(j + reach) {
                    let three = [members[i].image, members[j].image, members[k].image];
                    *counts.entry(three).or_insert(0) += 1;
                }
            }
        }
    }
    counts
}
