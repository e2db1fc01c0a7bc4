//! Plans of plots: from the design of a field, or from polygons that somebody drew; and their place on the map.
//!
//! A plan is in metres along and across the rows ([`crate::problems::plot_layout`]); a [`Placement`] puts it on the map.
//!
//! | step | where |
//! |---|---|
//! | design to plan | [`design`] |
//! | polygons to plan | [`polygons`] |
//! | plants that were found to pieces and ends of rows | [`observed`] |
//! | where the plan may lie: coarse search over shift and stretch | [`search`] |
//! | the plan onto the rows, with standard deviations | [`refine`] |

pub mod design;
pub mod observed;
pub mod polygons;
pub mod refine;
pub mod search;

use crate::problems::plot_layout::Placement;

/// A row of a plot in the plan.
#[derive(Debug, Clone, Copy, PartialEq)]
pub struct PlannedRow {
    /// Its ends `(s, t)`, metres; the first has the smaller `s`.
    pub ends: [[f64; 2]; 2],
}

impl PlannedRow {
    /// `t` at a place along.
    pub fn across(&self, s: f64) -> f64 {
        let [from, to] = self.ends;
        from[1] + (s - from[0]) / (to[0] - from[0]) * (to[1] - from[1])
    }
}

/// A plot in the plan.
#[derive(Debug, Clone, PartialEq)]
pub struct PlannedPlot {
    /// Its name: the number, or what the polygon is called.
    pub name: String,
    /// Number of its range, from 1; 0 where there is no design.
    pub range: usize,
    /// Number within its range, from 1; 0 where there is no design.
    pub column: usize,
    /// Its outline `(s, t)`, metres; rings as those of a polygon.
    pub rings: Vec<Vec<[f64; 2]>>,
    /// Its rows.
    pub rows: Vec<PlannedRow>,
}

/// A plan of plots.
#[derive(Debug, Clone, PartialEq)]
pub struct Plan {
    /// The plots in the order of their numbers.
    pub plots: Vec<PlannedPlot>,
    /// Distance between rows, metres.
    pub row_spacing_m: f64,
}

/// Points along a bent side of a plot, metres apart.
const STEP_M: f64 = 1.0;
/// From this distance between chord and side on a side has points of its own, metres. Half a pixel of a usual map.
const MIN_SAGITTA_M: f64 = 0.005;

impl Plan {
    /// The extent `[low, high]` of all plots along and across, metres.
    pub fn extent(&self) -> [[f64; 2]; 2] {
        let points = || self.plots.iter().flat_map(|plot| plot.rings.iter().flatten());
        [0, 1].map(|axis| {
            let low = points().map(|at| at[axis]).fold(f64::INFINITY, f64::min);
            let high = points().map(|at| at[axis]).fold(f64::NEG_INFINITY, f64::max);
            [low, high]
        })
    }

    /// Half its length along the rows, metres.
    pub fn half_length_m(&self) -> f64 {
        let [[low, high], _] = self.extent();
        (0.5 * (high - low)).max(f64::MIN_POSITIVE)
    }
}

impl PlannedPlot {
    /// Its outline on the map, metres. Bent sides get points of their own.
    pub fn on_map(&self, placement: &Placement) -> Vec<Vec<[f64; 2]>> {
        let side = |from: [f64; 2], to: [f64; 2]| {
            let length = (to[0] - from[0]).hypot(to[1] - from[1]);
            let parts = match placement.sagitta_m(from, to) > MIN_SAGITTA_M {
                true => (length / STEP_M).ceil().max(1.0) as usize,
                false => 1,
            };
            (0..parts).map(move |part| {
                let share = part as f64 / parts as f64;
                [0, 1].map(|axis| from[axis] + share * (to[axis] - from[axis]))
            })
        };
        let ring = |ring: &Vec<[f64; 2]>| {
            let sides = (0..ring.len()).flat_map(|k| side(ring[k], ring[(k + 1) % ring.len()]));
            sides.map(|at| placement.map(at)).collect()
        };
        self.rings.iter().map(ring).collect()
    }
}
