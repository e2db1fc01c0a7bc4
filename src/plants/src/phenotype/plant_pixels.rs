//! Which plant a leaf pixel belongs to: the nearest, if it is in reach.
//!
//! Leaves are not told apart here. A pixel goes to the plant with the least distance, ties to the first one; none farther than
//! `REACH` usual distances of neighbours. Where leaves of neighbours overlap, pixels in between are as often the other plant's: means
//! over pixels of a plant are then drawn towards those of its neighbours.

use crate::score::tree::Tree;
use rowgram_optim::robust::median;

/// Usual distances of neighbouring plants within which a pixel belongs to the nearest one. Leaves are longer than plants are apart in
/// most rows, and shorter than rows are apart.
const REACH: f64 = 2.0;

/// Plants by square of the picture, to find the nearest.
#[derive(Debug, Clone, Default)]
pub struct PlantPixels {
    plants_px: Vec<[f64; 2]>,
    /// Plants within, and side of a square, pixels; 0 where fewer than two plants are there.
    reach_px: f64,
    first_px: [f64; 2],
    squares: [usize; 2],
    members: Vec<Vec<usize>>,
}

impl PlantPixels {
    /// Of plants at these places, pixels.
    pub fn new(plants_px: &[[f64; 2]]) -> PlantPixels {
        let tree = Tree::new(plants_px);
        let nearest = (0..plants_px.len())
            .filter_map(|k| tree.nearest(plants_px, plants_px[k], Some(k)))
            .map(|(_, distance)| distance)
            .filter(|distance| *distance > 0.0);
        PlantPixels::with_side(plants_px, REACH * median(nearest).unwrap_or(0.0))
    }

    /// How far from its plant a pixel can be, pixels.
    pub fn reach_px(&self) -> f64 {
        self.reach_px
    }

    /// The plant of a pixel, by its place among the plants.
    pub fn of(&self, at_px: [f64; 2]) -> Option<usize> {
        let range = |axis: usize| {
            let square = ((at_px[axis] - self.first_px[axis]) / self.reach_px).floor();
            // Casts of floats saturate: what lies before the first square looks at that.
            (square - 1.0).max(0.0) as usize
                ..((square + 2.0).max(0.0) as usize).min(self.squares[axis])
        };
        let mut best: Option<(f64, usize)> = None;
        for row in range(1) {
            for &plant in range(0).flat_map(|column| &self.members[row * self.squares[0] + column])
            {
                let place = self.plants_px[plant];
                let distance = (place[0] - at_px[0]).hypot(place[1] - at_px[1]);
                let is_better = best.is_none_or(|best| (distance, plant) < best);
                if distance <= self.reach_px && is_better {
                    best = Some((distance, plant));
                }
            }
        }
        best.map(|(_, plant)| plant)
    }

    fn with_side(plants_px: &[[f64; 2]], side_px: f64) -> PlantPixels {
        if plants_px.is_empty() || !(side_px.is_finite() && side_px > 0.0) {
            return PlantPixels::default();
        }
        let bound = |axis: usize| {
            let all = || plants_px.iter().map(|at| at[axis]);
            let (low, high) =
                (all().fold(f64::INFINITY, f64::min), all().fold(f64::NEG_INFINITY, f64::max));
            (low, ((high - low) / side_px) as usize + 1)
        };
        let [(u, columns), (v, rows)] = [bound(0), bound(1)];
        let mut found = PlantPixels {
            plants_px: plants_px.to_vec(),
            reach_px: side_px,
            first_px: [u, v],
            squares: [columns, rows],
            members: vec![Vec::new(); columns * rows],
        };
        for (plant, at) in plants_px.iter().enumerate() {
            let [u, v] = [0, 1].map(|axis| ((at[axis] - found.first_px[axis]) / side_px) as usize);
            found.members[v * columns + u].push(plant);
        }
        found
    }
}

#[cfg(test)]
mod tests {
    use super::*;
    use rand::{RngExt, SeedableRng};
    use rand_chacha::ChaCha8Rng;

    #[test]
    fn a_pixel_belongs_to_the_nearest_plant_in_reach() {
        let mut rng = ChaCha8Rng::seed_from_u64(7);
        // Two rows of plants about 10 px apart.
        let plants: Vec<[f64; 2]> = (0..80)
            .map(|k| {
                let [u, v] = [0, 1].map(|_| rng.random_range(-2.0..2.0));
                [10.0 * f64::from(k % 40) + u, 60.0 * f64::from(k / 40) + v]
            })
            .collect();
        let found = PlantPixels::new(&plants);
        assert!((14.0..22.0).contains(&found.reach_px()), "{}", found.reach_px());
        for _ in 0..2000 {
            let at = [rng.random_range(-40.0..440.0), rng.random_range(-40.0..100.0)];
            let distance = |k: &usize| (plants[*k][0] - at[0]).hypot(plants[*k][1] - at[1]);
            let nearest = (0..80).min_by(|a, b| distance(a).total_cmp(&distance(b)));
            assert_eq!(found.of(at), nearest.filter(|k| distance(k) <= found.reach_px()), "{at:?}");
        }
    }

    #[test]
    fn plants_on_one_line_have_pixels() {
        let plants: Vec<[f64; 2]> = (0..30).map(|k| [10.0 * f64::from(k), 5.0]).collect();
        let found = PlantPixels::new(&plants);
        assert_eq!((found.reach_px(), found.of([51.0, 9.0])), (20.0, Some(5)));
    }

    #[test]
    fn without_neighbours_nothing_is_in_reach() {
        assert_eq!(PlantPixels::new(&[]).of([0.0, 0.0]), None);
        assert_eq!(PlantPixels::new(&[[3.0, 4.0]]).of([3.0, 4.0]), None);
    }
}
