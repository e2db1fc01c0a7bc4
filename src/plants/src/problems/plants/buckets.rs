//! Plants in square buckets, to find those around a place.
//!
//! About one plant per bucket if they were spread evenly. A plant outside the picture lies in the
//! bucket at the border next to it; searches are cut at the border in the same way, so it is found.
//!
//! Positions and distances in pixels (squared where the name ends in 2).

use super::index::Bounds;

/// Plants by the square of the picture in which they lie.
#[derive(Debug, Clone, Default)]
pub(super) struct Buckets {
    origin_px: [f64; 2],
    side_px: f64,
    columns: usize,
    rows: usize,
    members: Vec<Vec<u32>>,
    plants: usize,
}

impl Buckets {
    /// Buckets over the extent of the pixels.
    pub(super) fn new(extent: Option<Bounds>, plants: &[[f64; 2]]) -> Buckets {
        let Some(extent) = extent else { return Buckets::default() };
        let width = f64::from(extent.u_max) - f64::from(extent.u_min) + 1.0;
        let height = f64::from(extent.v_max) - f64::from(extent.v_min) + 1.0;
        let side_px = (width * height / plants.len().max(1) as f64).sqrt().max(1.0);
        let columns = (width / side_px).ceil().max(1.0) as usize;
        let rows = (height / side_px).ceil().max(1.0) as usize;
        let mut buckets = Buckets {
            origin_px: [f64::from(extent.u_min) - 0.5, f64::from(extent.v_min) - 0.5],
            side_px,
            columns,
            rows,
            members: vec![Vec::new(); columns * rows],
            plants: plants.len(),
        };
        for (plant, &at) in (0u32..).zip(plants) {
            let bucket = buckets.bucket_of(at);
            buckets.members[bucket].push(plant);
        }
        buckets
    }

    fn column_of(&self, u_px: f64) -> usize {
        // The cast saturates: below the border is 0.
        (((u_px - self.origin_px[0]) / self.side_px) as usize).min(self.columns.saturating_sub(1))
    }

    fn row_of(&self, v_px: f64) -> usize {
        (((v_px - self.origin_px[1]) / self.side_px) as usize).min(self.rows.saturating_sub(1))
    }

    fn bucket_of(&self, at: [f64; 2]) -> usize {
        self.row_of(at[1]) * self.columns + self.column_of(at[0])
    }

    /// Follows a plant to its new place.
    pub(super) fn moved(&mut self, plant: u32, old: [f64; 2], new: [f64; 2]) {
        let (from, to) = (self.bucket_of(old), self.bucket_of(new));
        if from != to {
            self.members[from].retain(|&member| member != plant);
            self.members[to].push(plant);
        }
    }

    /// Lists the plants whose squared distance to the box is at most `reach2`.
    pub(super) fn within(
        &self,
        bounds: &Bounds,
        reach2: f32,
        plants: &[[f64; 2]],
        found: &mut Vec<(u32, [f64; 2])>,
    ) {
        found.clear();
        let limit2 = f64::from(reach2) * 1.000_01;
        let reach = limit2.sqrt();
        let first = self.column_of(f64::from(bounds.u_min) - reach);
        let last = self.column_of(f64::from(bounds.u_max) + reach);
        let top = self.row_of(f64::from(bounds.v_min) - reach);
        let bottom = self.row_of(f64::from(bounds.v_max) + reach);
        if self.members.is_empty() {
            return;
        }
        for row in top..=bottom {
            for members in &self.members[row * self.columns + first..=row * self.columns + last] {
                for &plant in members {
                    let at = plants[plant as usize];
                    if bounds.distance2(at) <= limit2 {
                        found.push((plant, at));
                    }
                }
            }
        }
    }

    /// Distance from a place to the second nearest plant; infinite with fewer than two.
    pub(super) fn second_nearest(&self, at: [f64; 2], plants: &[[f64; 2]]) -> f64 {
        if self.plants < 2 {
            return f64::INFINITY;
        }
        let point = Bounds {
            u_min: at[0] as f32,
            u_max: at[0] as f32,
            v_min: at[1] as f32,
            v_max: at[1] as f32,
        };
        let mut found = Vec::new();
        let mut radius = self.side_px;
        loop {
            self.within(&point, (radius * radius) as f32, plants, &mut found);
            if found.len() >= 2 {
                let (mut near2, mut second2) = (f64::INFINITY, f64::INFINITY);
                for (_, plant) in &found {
                    let d2 = (plant[0] - at[0]).powi(2) + (plant[1] - at[1]).powi(2);
                    if d2 < near2 {
                        (near2, second2) = (d2, near2);
                    } else if d2 < second2 {
                        second2 = d2;
                    }
                }
                // Slightly more, for the middle was rounded to `f32`.
                return second2.sqrt() * 1.000_01 + 1e-3;
            }
            radius *= 2.0;
        }
    }
}
