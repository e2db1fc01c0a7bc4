//! Plot layouts on synthetic fields, whose plots are known.

use data_synth::field::{Field, FieldConfig};
use rand_chacha::{
    ChaCha8Rng,
    rand_core::{Rng, SeedableRng},
};
use rowgram::{
    phenotype::layout::{
        Plan,
        design::{Design, Numbering, Side},
        observed::FoundPlant,
        refine::{Assumptions, Refinement, refine},
    },
    problems::plot_layout::{
        Placement,
        corners::{self, Corner, CornerSigmas},
    },
};

/// Uniform and normal numbers from a seed.
struct Draws(ChaCha8Rng);

impl Draws {
    fn new(seed: u64) -> Draws {
        Draws(ChaCha8Rng::seed_from_u64(seed))
    }

    fn unit(&mut self) -> f64 {
        (self.0.next_u64() >> 11) as f64 / (1u64 << 53) as f64
    }

    fn normal(&mut self) -> f64 {
        (0..12).map(|_| self.unit()).sum::<f64>() - 6.0
    }

    fn sign(&mut self) -> f64 {
        if self.unit() < 0.5 { -1.0 } else { 1.0 }
    }
}

/// The field of the small flight, and its design.
fn field(seed: u64) -> (FieldConfig, Design) {
    let preset = data_synth::twin::TwinConfig::preset(data_synth::twin::FlightPreset::Small);
    let config = FieldConfig { seed, ..preset.field };
    let design = Design {
        ranges: 2,
        plots_per_range: 4,
        rows_per_plot: 5,
        row_spacing_m: 0.76,
        plot_length_m: 8.25,
        plot_width_m: 3.8,
        alley_m: 1.5,
        plot_gap_m: 0.0,
        plots_to: Side::Right,
        numbering: Numbering::Across,
        serpentine: false,
        first_number: 1,
        missing_ranges: vec![],
        missing_plots: vec![],
    };
    (config, design)
}

/// Where a place of the plan truly is: from the middle of the field, `t` to the left; rows bow as they were planted.
fn true_place(config: &FieldConfig, [s, t]: [f64; 2]) -> [f64; 2] {
    let bow = config.row_across(0, s) - config.row_across(0, 0.5 * config.row_length_m);
    config.ground(s, -t + bow)
}

/// Plants as a locator finds them: a few are missed, a few are weeds, and all are a little off.
fn found(config: &FieldConfig, draws: &mut Draws) -> Vec<FoundPlant> {
    let field = Field::plant(config).unwrap();
    let mut plants = Vec::new();
    for plant in &field.plants {
        if draws.unit() < 0.03 {
            continue;
        }
        let [along, across] = config.along_across(plant.x_m, plant.y_m);
        let at = [along + 0.025 * draws.normal(), across + 0.015 * draws.normal()];
        plants.push(FoundPlant { at_m: config.ground(at[0], at[1]), row: plant.row });
        if draws.unit() < 0.02 {
            let along = (draws.unit() - 0.5) * config.row_length_m;
            let across = config.row_across(plant.row, along) + 0.1 * draws.normal();
            plants.push(FoundPlant { at_m: config.ground(along, across), row: plant.row });
        }
    }
    plants
}

const ASSUMED: Assumptions = Assumptions {
    position_m: 0.5,
    rotation_rad: 0.0175,
    stretch: 0.01,
    shear_rad: 0.0035,
    bend_m: 0.1,
    plot_shift_m: None,
    segment_m: 2.0,
};

/// Corners that are off by a shift of 0.4 m, half a row, a degree and a hundredth, and the plan on them.
fn spoiled(config: &FieldConfig, design: &Design, draws: &mut Draws) -> (Plan, Placement) {
    let plan = design.plan().unwrap();
    let turn = draws.sign() * 1f64.to_radians();
    let angle = draws.unit() * std::f64::consts::TAU;
    let half_row = draws.sign() * 0.5 * config.inter_row_m;
    let (a, b) = (draws.sign() * 0.01, draws.sign() * 0.01);
    let mut wrong = Placement::nominal([0.0; 2], config.heading_rad(), plan.half_length_m());
    wrong.affine = [0.4 * angle.cos(), 0.4 * angle.sin() + half_row, turn, a, b, 0.0];
    let surveyed: Vec<Corner> =
        design.corners().map(|at| Corner { at, surveyed_m: wrong.map(at) }).into();
    let start = Placement::nominal([0.3, -0.2], config.heading_rad() + 0.01, plan.half_length_m());
    let sigmas = CornerSigmas { corner_m: 0.05, stretch: 0.01, shear_rad: 0.0035 };
    let fitted = corners::fit(&start, &surveyed, &sigmas).unwrap();
    (plan, fitted.placement)
}

/// Errors of all corners of plots along and across, with their standard deviations, metres.
fn errors(config: &FieldConfig, plan: &Plan, found: &Refinement) -> Vec<([f64; 2], [f64; 2])> {
    let placement = &found.fit.placement;
    let corners = plan.plots.iter().flat_map(|plot| plot.rings.iter().flatten());
    corners
        .map(|&at| {
            let is = placement.frame(placement.map(at));
            let truth = placement.frame(true_place(config, at));
            ([is[0] - truth[0], is[1] - truth[1]], found.sigma_m(at))
        })
        .collect()
}

#[test]
fn a_spoiled_layout_comes_back_and_its_sigmas_are_true() {
    let mut sums = [[0.0; 2]; 2];
    let (mut count, mut worst) = (0.0, [0.0f64; 2]);
    for seed in 1..=20 {
        let (config, design) = field(seed);
        let mut draws = Draws::new(seed);
        let plants = found(&config, &mut draws);
        let (plan, about) = spoiled(&config, &design, &mut draws);
        let found = refine(&plan, &about, &plants, &ASSUMED, &|_| true).unwrap();
        let likely = found.alternatives.iter().filter(|other| other.odds > 0.05).count();
        assert_eq!(likely, 0, "seed {seed}: {:?}", found.alternatives);
        for (error, sigma) in errors(&config, &plan, &found) {
            for axis in 0..2 {
                sums[axis][0] += error[axis].powi(2);
                sums[axis][1] += (error[axis] / sigma[axis]).powi(2);
                worst[axis] = worst[axis].max(error[axis].abs());
            }
            count += 1.0;
        }
        println!("seed {seed}: {:?} margin {:.3}", found.fit.scatter, found.fit.margin_m);
    }
    for (axis, name) in ["along", "across"].iter().enumerate() {
        let (rms, ratio) = ((sums[axis][0] / count).sqrt(), (sums[axis][1] / count).sqrt());
        println!(
            "{name}: rms {rms:.4} m, worst {:.4} m, errors over sigma {ratio:.2}",
            worst[axis]
        );
        assert!(rms < 0.03, "{name}: {rms}");
        assert!((0.5..1.5).contains(&ratio), "{name}: {ratio}");
    }
}
