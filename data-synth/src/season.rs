//! One field on several days: the same plants, sown once, on the day that a flight sees them.
//!
//! Plant `i` of plot `p` comes up `E_i = E + N(0, plot^2)_p + N(0, plant^2)_i` days after sowing. At the age `a > 0` days its
//! leaves have, relative to what they are in the end, the area
//!
//! ```text
//! A(a) = s (1 - exp(-a / u)) + (1 - s) / (1 + exp(-r_p (a - h_p))),
//! ```
//!
//! what a seedling unfolds from the reserves of its seed (a share `s` within about `u` days), and a logistic curve whose
//! rate `r_p` (per day) and half time `h_p` (days) are the plot's. Lengths and widths follow the root of the area. Leaf `j` of a
//! stalk, from 0, is there from the age `(j - 1) c` on and opens within two days. From its emergence on a plant is lost with
//! a constant hazard per day.
//!
//! Reference: the logistic curve of leaf area, e.g. R. Hunt, *Plant Growth Curves*, 1982, chapter 4.
//!
//! What grows is drawn from streams of the season's seed; what differs from one flight to the next (trajectory, receiver, exposure,
//! noise, clicks, weeds, weathered soil) from those of the flight's own ([`SeasonDay::flight_seed`]).

use crate::{
    check::{ConfigError, within},
    field::{FieldConfig, Plant},
    leaf::{GROUND_M, Leaf},
    streams::{Draw, Stage, stream},
};
use serde::{Deserialize, Serialize};

/// Days in which a leaf opens.
const OPENING_DAYS: f64 = 2.0;
/// Days in which a seedling unfolds from its seed.
const UNFOLDING_DAYS: f64 = 1.0;

/// A day of a season, and how the season's plants grow.
#[derive(Debug, Clone, PartialEq, Serialize, Deserialize)]
#[serde(default, deny_unknown_fields)]
pub struct SeasonDay {
    /// Days from sowing to this day.
    pub day: f64,
    /// Number of the flight, from 0: another one draws another trajectory, light and noise over the same field.
    pub flight: u64,
    /// Mean time from sowing to emergence, days.
    pub emergence_days: f64,
    /// Standard deviation of that time between plots, days.
    pub emergence_plot_days: f64,
    /// Standard deviation of that time between the plants of a plot, days.
    pub emergence_plant_days: f64,
    /// Share of its final leaf area that a seedling has from the reserves of its seed.
    pub reserve_share: f64,
    /// Age at which the logistic part of the leaf area has half of its final value, days.
    pub half_days: f64,
    /// Standard deviation of that age between plots, days.
    pub half_plot_days: f64,
    /// Rate of the logistic part, per day.
    pub rate_per_day: f64,
    /// Standard deviation of the logarithm of that rate between plots.
    pub rate_plot_spread: f64,
    /// Days from one leaf of a stalk to the next.
    pub leaf_interval_days: f64,
    /// Probability per day that a plant that has emerged is lost.
    pub loss_per_day: f64,
    /// Share of the soil's unevenness that is new at every flight.
    pub weathering: f64,
}

impl Default for SeasonDay {
    fn default() -> SeasonDay {
        SeasonDay {
            day: 20.0,
            flight: 0,
            emergence_days: 9.0,
            emergence_plot_days: 1.0,
            emergence_plant_days: 1.0,
            reserve_share: 0.05,
            half_days: 14.0,
            half_plot_days: 1.5,
            rate_per_day: 0.3,
            rate_plot_spread: 0.1,
            leaf_interval_days: 2.5,
            loss_per_day: 0.001,
            weathering: 0.3,
        }
    }
}

/// How the plants of one plot grow.
#[derive(Debug, Clone, Copy, PartialEq)]
pub struct PlotGrowth {
    /// Mean time from sowing to emergence, days.
    pub emergence_days: f64,
    /// Age at which the logistic part of the leaf area has half of its final value, days.
    pub half_days: f64,
    /// Rate of the logistic part, per day.
    pub rate_per_day: f64,
}

/// When a plant comes and goes.
#[derive(Debug, Clone, Copy, PartialEq)]
pub struct Life {
    /// From sowing to emergence, days.
    pub emergence_days: f64,
    /// From sowing to its loss, days; infinite where nothing is ever lost.
    pub lost_days: f64,
}

impl Life {
    /// Whether the plant is there so many days after sowing.
    pub fn is_there(&self, day: f64) -> bool {
        (self.emergence_days..self.lost_days).contains(&day)
    }
}

impl SeasonDay {
    /// Checks every parameter.
    ///
    /// # Errors
    /// The first parameter that cannot be used: its name, its value and what was expected.
    pub fn check(&self) -> Result<(), ConfigError> {
        within("season.day", self.day, 0.0..=1000.0)?;
        within("season.flight", self.flight, 0..=10_000)?;
        within("season.emergence_days", self.emergence_days, 0.0..=200.0)?;
        within("season.emergence_plot_days", self.emergence_plot_days, 0.0..=50.0)?;
        within("season.emergence_plant_days", self.emergence_plant_days, 0.0..=50.0)?;
        within("season.reserve_share", self.reserve_share, 0.0..=0.5)?;
        within("season.half_days", self.half_days, 0.0..=500.0)?;
        within("season.half_plot_days", self.half_plot_days, 0.0..=100.0)?;
        within("season.rate_per_day", self.rate_per_day, 0.01..=5.0)?;
        within("season.rate_plot_spread", self.rate_plot_spread, 0.0..=1.0)?;
        within("season.leaf_interval_days", self.leaf_interval_days, 0.0..=100.0)?;
        within("season.loss_per_day", self.loss_per_day, 0.0..=0.5)?;
        within("season.weathering", self.weathering, 0.0..=1.0)
    }

    /// The seed of what differs from one flight to the next over a field of this seed.
    pub fn flight_seed(&self, seed: u64) -> u64 {
        // SplitMix64 (Steele, Lea and Flood 2014): neighbouring numbers give unrelated seeds.
        let mut z = seed.wrapping_add((self.flight + 1).wrapping_mul(0x9e37_79b9_7f4a_7c15));
        z = (z ^ (z >> 30)).wrapping_mul(0xbf58_476d_1ce4_e5b9);
        z = (z ^ (z >> 27)).wrapping_mul(0x94d0_49bb_1331_11eb);
        (z ^ (z >> 31)) & i64::MAX.unsigned_abs()
    }

    /// How the plants of a plot grow.
    pub fn plot(&self, seed: u64, plot: usize) -> PlotGrowth {
        let mut rng = stream(seed, Stage::PlotGrowth, plot as u64);
        PlotGrowth {
            emergence_days: self.emergence_days + self.emergence_plot_days * rng.normal(),
            half_days: (self.half_days + self.half_plot_days * rng.normal()).max(0.0),
            rate_per_day: self.rate_per_day * (self.rate_plot_spread * rng.normal()).exp(),
        }
    }

    /// When a plant of a field comes and goes.
    pub fn life(&self, seed: u64, plant: &Plant) -> Life {
        let item = (crate::streams::pair(plant.row, plant.site) << 1) | u64::from(plant.second);
        let mut rng = stream(seed, Stage::PlantGrowth, item);
        let own = self.emergence_plant_days * rng.normal();
        let emergence_days = (self.plot(seed, plant.plot).emergence_days + own).max(0.0);
        let lasts_days = -(1.0 - rng.unit()).ln() / self.loss_per_day;
        Life { emergence_days, lost_days: emergence_days + lasts_days }
    }

    /// Leaf area at an age, days, relative to the final one.
    pub fn area_share(&self, plot: &PlotGrowth, age_days: f64) -> f64 {
        if age_days <= 0.0 {
            return 0.0;
        }
        let seedling = 1.0 - (-age_days / UNFOLDING_DAYS).exp();
        let logistic = 1.0 / (1.0 + (-plot.rate_per_day * (age_days - plot.half_days)).exp());
        self.reserve_share * seedling + (1.0 - self.reserve_share) * logistic
    }

    /// The plant as it is on this day; `None` before its emergence and after its loss.
    pub(crate) fn grown(&self, config: &FieldConfig, mut plant: Plant) -> Option<Plant> {
        let life = self.life(config.seed, &plant);
        if !life.is_there(self.day) {
            return None;
        }
        let age_days = self.day - life.emergence_days;
        let plot = self.plot(config.seed, plant.plot);
        let size = self.area_share(&plot, age_days).sqrt();
        let base_m = [plant.x_m, plant.y_m];
        for stalk in &mut plant.stalks {
            stalk.top_m = stalk.top_m.map(|part| size * part);
            stalk.radius_m *= size;
            stalk.panicle_m *= size;
        }
        plant.tilt_m = plant.tilt_m.map(|part| size * part);
        let (mut stalk, mut rank) = (0, 0.0_f64);
        plant.leaves.retain_mut(|leaf| {
            if leaf.stalk != stalk {
                (stalk, rank) = (leaf.stalk, 0.0);
            }
            let from_days = (rank - 1.0).max(0.0) * self.leaf_interval_days;
            rank += 1.0;
            let open = ((age_days - from_days) / OPENING_DAYS).clamp(0.0, 1.0).sqrt();
            shrink(leaf, base_m, size, size * open);
            open > 0.0
        });
        Some(plant)
    }
}

/// A leaf whose collar is nearer to the foot of its plant by `collar` and whose blade is smaller by `blade`.
fn shrink(leaf: &mut Leaf, base_m: [f64; 2], collar: f64, blade: f64) {
    let from = leaf.axis_m[0];
    let to = [
        base_m[0] + collar * (from[0] - base_m[0]),
        base_m[1] + collar * (from[1] - base_m[1]),
        collar * from[2],
    ];
    for node in &mut leaf.axis_m {
        let [x, y, z] = [0, 1, 2].map(|k| to[k] + blade * (node[k] - from[k]));
        *node = [x, y, z.max(GROUND_M)];
    }
    leaf.half_width_m = leaf.half_width_m.map(|half| blade * half);
    leaf.length_m *= blade;
    leaf.width_m *= blade;
}

#[cfg(test)]
mod tests {
    use super::*;
    use crate::field::Field;

    fn field(day: f64, loss_per_day: f64) -> Field {
        let season = SeasonDay { day, loss_per_day, ..SeasonDay::default() };
        Field::plant(&FieldConfig { season: Some(season), ..FieldConfig::default() }).unwrap()
    }

    fn area_m2(field: &Field) -> f64 {
        field.leaves().map(Leaf::area_m2).sum()
    }

    #[test]
    fn the_same_plants_grow_and_stay_where_they_are() {
        let all = Field::plant(&FieldConfig::default()).unwrap();
        let fields: Vec<Field> =
            [5.0, 9.0, 14.0, 20.0, 30.0, 200.0].map(|day| field(day, 0.0)).into();
        assert!(fields[0].plants.is_empty());
        let share = fields[1].plants.len() as f64 / all.plants.len() as f64;
        assert!((0.2..0.8).contains(&share), "half have emerged on the day of emergence: {share}");
        for pair in fields.windows(2) {
            assert!(area_m2(&pair[0]) < area_m2(&pair[1]));
        }
        let grown = &fields[5];
        approx::assert_relative_eq!(area_m2(grown), area_m2(&all), max_relative = 1e-9);
        for later in &fields {
            for plant in &later.plants {
                let same = |other: &&Plant| {
                    (other.row, other.site, other.second) == (plant.row, plant.site, plant.second)
                };
                let of_all = all.plants.iter().find(same).unwrap();
                assert_eq!([plant.x_m, plant.y_m], [of_all.x_m, of_all.y_m]);
            }
        }
    }

    #[test]
    fn plants_are_lost_at_the_rate_asked_for_and_do_not_come_back() {
        let all = field(30.0, 0.0).plants.len() as f64;
        let [some, fewer] = [30.0, 60.0].map(|day| field(day, 0.01).plants);
        // 21 days after emergence, a tenth more than exp(-0.21) of 150 plants at three standard deviations.
        let expected = (-0.21_f64).exp();
        let sigma = (expected * (1.0 - expected) / all).sqrt();
        assert!((some.len() as f64 / all - expected).abs() < 3.0 * sigma);
        let key = |plant: &Plant| (plant.row, plant.site, plant.second);
        assert!(fewer.iter().all(|plant| some.iter().any(|other| key(other) == key(plant))));
    }

    #[test]
    fn flights_have_seeds_of_their_own() {
        let seed = |flight| SeasonDay { flight, ..SeasonDay::default() }.flight_seed(1);
        let mut seeds: Vec<u64> = (0..100).map(seed).collect();
        seeds.sort_unstable();
        seeds.dedup();
        assert_eq!(seeds.len(), 100);
        assert!(seeds.iter().all(|seed| crate::check::seed(*seed).is_ok()));
    }
}
