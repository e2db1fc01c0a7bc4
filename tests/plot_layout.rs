//! Plot layouts on synthetic fields, whose plots are known.

use crate::maps;
use data_synth::field::{Field, FieldConfig};
use rand_chacha::{
    ChaCha8Rng,
    rand_core::{Rng, SeedableRng},
};
use rowgram::{
    io::{csv_table::CsvTable, polygons},
    monitor::{Recorder, Silent},
    options::{Choice, Options},
    phenotype::layout::{
        Plan,
        design::{Design, FieldCorner, Numbering, Side},
        observed::FoundPlant,
        refine::{Assumptions, Refinement, refine},
    },
    pipeline::{
        Project, Stage,
        locate::locate,
        plots::{
            layout::{LayoutOptions, LayoutRequest, LayoutSource, layout},
            plots,
        },
        segment::segment,
        synth::{FlightOptions, write_flight},
    },
    problems::plot_layout::{
        Placement,
        corners::{self, Corner, CornerSigmas},
    },
    raster::georeference::{Crs, Georeference},
};
use std::path::{Path, PathBuf};

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
    let of = |corner| {
        let at = design.corner(corner);
        Corner { at, surveyed_m: wrong.map(at) }
    };
    let surveyed: Vec<Corner> = FieldCorner::all().into_iter().map(of).collect();
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

/// A field that was planted by a machine: rows and lines of ends are a little off as a whole.
struct Machine {
    design: Design,
    truth: Placement,
    /// Standard deviations of rows and of lines of ends, metres.
    row_m: f64,
    line_m: f64,
    /// Shift of each plot along and across, metres.
    plot_m: f64,
}

impl Machine {
    fn new() -> Machine {
        let (_, small) = field(1);
        let design = Design {
            ranges: 5,
            plots_per_range: 12,
            rows_per_plot: 4,
            plot_length_m: 6.0,
            plot_width_m: 4.0 * 0.76,
            alley_m: 1.2,
            ..small
        };
        let mut truth =
            Placement::nominal([1000.0, 2000.0], 1.4, design.plan().unwrap().half_length_m());
        truth.affine = [0.31, -0.62, 0.012, 0.007, -0.006, 0.002];
        truth.bend_m = [0.12, -0.05, 0.02];
        Machine { design, truth, row_m: 0.02, line_m: 0.03, plot_m: 0.0 }
    }

    /// Plants every 0.2 m from a phase of their own; `w` of each plot.
    fn plants(&self, draws: &mut Draws) -> (Vec<FoundPlant>, Vec<[f64; 2]>) {
        let plan = self.design.plan().unwrap();
        let rows = self.design.plots_per_range * self.design.rows_per_plot;
        let of_rows: Vec<f64> = (0..rows).map(|_| self.row_m * draws.normal()).collect();
        let of_ends: Vec<[f64; 2]> =
            (0..self.design.ranges).map(|_| [0, 1].map(|_| self.line_m * draws.normal())).collect();
        let mut plants = Vec::new();
        let mut shifts = Vec::new();
        for plot in &plan.plots {
            let shift = [0, 1].map(|_| self.plot_m * draws.normal());
            shifts.push(shift);
            for (k, row) in plot.rows.iter().enumerate() {
                let row_number = (plot.column - 1) * self.design.rows_per_plot + k;
                let [begin, end] = of_ends[plot.range - 1];
                let last = row.ends[1][0] + end;
                let mut s = row.ends[0][0] + begin + 0.2 * draws.unit();
                while s < last {
                    if draws.unit() > 0.08 {
                        let t = row.across(s) + of_rows[row_number] + 0.02 * draws.normal();
                        let at = [s + 0.03 * draws.normal() + shift[0], t + shift[1]];
                        plants.push(FoundPlant { at_m: self.truth.map(at), row: row_number });
                    }
                    s += 0.2;
                }
            }
        }
        (plants, shifts)
    }

    /// The plan where somebody believes it to be.
    fn believed(&self, draws: &mut Draws) -> (Plan, Placement) {
        let plan = self.design.plan().unwrap();
        let mut about =
            Placement::nominal(self.truth.origin_m, self.truth.heading_rad, plan.half_length_m());
        let spoil = [0.4, 0.4, 0.012, 0.006, 0.006, 0.002].map(|sigma| sigma * draws.normal());
        about.affine = std::array::from_fn(|k| self.truth.affine[k] + spoil[k]);
        (plan, about)
    }
}

/// Standard deviations hold where rows and lines of ends are off as a whole, which plants alone would not tell.
#[test]
fn sigmas_hold_for_what_a_planter_does() {
    let machine = Machine::new();
    let mut sums = [[0.0; 2]; 2];
    let mut count = 0.0;
    for seed in 1..=12 {
        let mut draws = Draws::new(100 + seed);
        let (plants, _) = machine.plants(&mut draws);
        let (plan, about) = machine.believed(&mut draws);
        let found = refine(&plan, &about, &plants, &ASSUMED, &|_| true).unwrap();
        for &at in plan.plots.iter().flat_map(|plot| plot.rings.iter().flatten()) {
            let placement = &found.fit.placement;
            let (is, truth) =
                (placement.frame(placement.map(at)), placement.frame(machine.truth.map(at)));
            let sigma = found.sigma_m(at);
            for axis in 0..2 {
                sums[axis][0] += (is[axis] - truth[axis]).powi(2);
                sums[axis][1] += ((is[axis] - truth[axis]) / sigma[axis]).powi(2);
            }
            count += 1.0;
        }
        println!("seed {seed}: {:?} margin {:.3}", found.fit.scatter, found.fit.margin_m);
    }
    for (axis, name) in ["along", "across"].iter().enumerate() {
        let (rms, ratio) = ((sums[axis][0] / count).sqrt(), (sums[axis][1] / count).sqrt());
        println!("{name}: rms {rms:.4} m, errors over sigma {ratio:.2}");
        assert!(rms < 0.04, "{name}: {rms}");
        assert!((0.5..1.5).contains(&ratio), "{name}: {ratio}");
    }
}

/// The largest error of a corner, metres.
fn worst(config: &FieldConfig, plan: &Plan, found: &Refinement) -> f64 {
    let of = errors(config, plan, found);
    of.into_iter().map(|(error, _)| error[0].hypot(error[1])).fold(0.0, f64::max)
}

/// A layout that is a whole row off comes back, because a row is left over on one side and lacks on the other; with rows
/// on both sides that no plot has, nothing tells, and that is said.
#[test]
fn which_row_is_which_is_told_by_the_outer_rows() {
    let (config, design) = field(3);
    let plan = design.plan().unwrap();
    let one_off = |config: &FieldConfig| {
        let mut about = Placement::nominal([0.0; 2], config.heading_rad(), plan.half_length_m());
        about.affine[1] = config.inter_row_m;
        about
    };
    let mut draws = Draws::new(3);
    let plants = found(&config, &mut draws);
    let is = refine(&plan, &one_off(&config), &plants, &ASSUMED, &|_| true).unwrap();
    assert!(worst(&config, &plan, &is) < 0.06, "{}", worst(&config, &plan, &is));
    assert!(is.alternatives.iter().all(|other| other.odds < 0.05), "{:?}", is.alternatives);

    // Two border rows on either side.
    let bordered = FieldConfig { rows: config.rows + 4, ..config.clone() };
    let plants = found(&bordered, &mut draws);
    let is = refine(&plan, &one_off(&bordered), &plants, &ASSUMED, &|_| true).unwrap();
    let rival = is.alternatives.first().expect("the other row is named");
    assert!(rival.odds > 0.05 && (rival.across_m.abs() - 0.76).abs() < 0.2, "{rival:?}");
    // Who knows the place to a few centimetres is not in doubt.
    let about = Placement { affine: [0.0; 6], ..one_off(&bordered) };
    let sure = Assumptions { position_m: 0.1, ..ASSUMED };
    let is = refine(&plan, &about, &plants, &sure, &|_| true).unwrap();
    assert!(worst(&bordered, &plan, &is) < 0.06, "{}", worst(&bordered, &plan, &is));
    assert!(is.alternatives.iter().all(|other| other.odds < 0.05), "{:?}", is.alternatives);
}

#[test]
fn a_range_that_was_not_planted_is_bridged_or_named() {
    let (config, design) = field(5);
    let config = FieldConfig { row_length_m: 27.75, ..config };
    let design = Design { ranges: 3, ..design };
    let mut draws = Draws::new(5);
    let mut plants = found(&config, &mut draws);
    plants.retain(|plant| {
        config.along_across(plant.at_m[0], plant.at_m[1])[0].abs() > 0.5 * 8.25 + 0.75
    });
    for missing_ranges in [vec![2], vec![]] {
        let is_named = !missing_ranges.is_empty();
        let design = Design { missing_ranges, ..design.clone() };
        let (plan, about) = spoiled(&config, &design, &mut draws);
        let is = refine(&plan, &about, &plants, &ASSUMED, &|_| true).unwrap();
        assert!(worst(&config, &plan, &is) < 0.08, "{}", worst(&config, &plan, &is));
        let empty = is.plots.iter().filter(|plot| plot.plants == 0).count();
        assert_eq!(empty, if is_named { 0 } else { 4 });
    }
}

#[test]
fn polygons_move_like_a_design_and_plots_by_themselves() {
    use rowgram::phenotype::layout::polygons::{Drawn, direction, middle, plan};
    let machine = Machine { plot_m: 0.06, ..Machine::new() };
    let mut draws = Draws::new(77);
    let (plants, shifts) = machine.plants(&mut draws);
    let (of_design, believed) = machine.believed(&mut draws);
    let drawn: Vec<Drawn> = of_design
        .plots
        .iter()
        .map(|plot| Drawn { name: plot.name.clone(), rings: plot.on_map(&believed) })
        .collect();
    let heading = direction(&drawn);
    let origin = middle(&drawn);
    let of_polygons = plan(&drawn, origin, heading, Some(4), 0.76).unwrap();
    let about = Placement::nominal(origin, heading, of_polygons.half_length_m());
    // The sides of a rectangle have two directions; the rows are along one of them.
    let quarter = std::f64::consts::FRAC_PI_2;
    let turned = ((1.4 + 0.012 - heading) / quarter).round() * quarter;
    let (of_polygons, about) = match turned.abs() < 0.1 {
        true => (of_polygons, about),
        false => {
            let of = plan(&drawn, origin, heading + turned, Some(4), 0.76).unwrap();
            let half = of.half_length_m();
            (of, Placement::nominal(origin, heading + turned, half))
        }
    };
    let assumed = Assumptions { plot_shift_m: Some(0.06), ..ASSUMED };
    let found = refine(&of_polygons, &about, &plants, &assumed, &|_| true).unwrap();
    let mut sums = [0.0; 2];
    for (k, plot) in of_design.plots.iter().enumerate() {
        let middle = plot.rows[1].ends;
        let at = [0.5 * (middle[0][0] + middle[1][0]), middle[0][1]];
        // Where the plot was drawn, where it is now, and where it is planted.
        let placement = &found.fit.placement;
        let now = placement.frame(placement.map(about.plan(believed.map(at))));
        let own = found.plots[k].shift_m;
        let planted = [at[0] + shifts[k][0], at[1] + shifts[k][1]];
        let truth = placement.frame(machine.truth.map(planted));
        for axis in 0..2 {
            sums[axis] += (now[axis] + own[axis] - truth[axis]).powi(2);
        }
    }
    let rms = sums.map(|sum| (sum / of_design.plots.len() as f64).sqrt());
    println!("plots by themselves: rms {rms:?} m of 0.06 m");
    assert!(rms[0] < 0.05 && rms[1] < 0.03, "{rms:?}");
}

#[test]
fn rows_of_another_layout_are_refused() {
    let (config, design) = field(1);
    let plants = found(&config, &mut Draws::new(1));
    let plan = design.plan().unwrap();
    let at =
        |turn: f64| Placement::nominal([0.0; 2], config.heading_rad() + turn, plan.half_length_m());
    let refused = |plan: &Plan, about: &Placement, plants: &[FoundPlant]| {
        refine(plan, about, plants, &ASSUMED, &|_| true).unwrap_err().to_string()
    };
    let error = refused(&plan, &at(1.5), &plants);
    assert!(error.contains("run") && error.contains("corners named rightly"), "{error}");
    assert!(refused(&plan, &at(0.0), &[]).contains("no rows of plants"));
    let wide = Design { row_spacing_m: 1.5, plot_width_m: 7.5, plots_per_range: 2, ..design };
    let error = refused(&wide.plan().unwrap(), &at(0.0), &plants);
    assert!(error.contains("m apart") && error.contains("1.500 m"), "{error}");
    let mut away = at(0.0);
    away.origin_m = [300.0, 0.0];
    let error = refused(&plan, &away, &plants);
    assert!(error.contains("pieces of rows"), "{error}");
}

#[test]
fn a_system_without_a_code_places_corners_in_degrees() {
    let folder = tempfile::tempdir().unwrap();
    let corners = folder.path().join("corners.csv");
    let table = "corner,longitude,latitude\nfirst,-87.0,40.4\nalong,-87.0,40.4001\n";
    std::fs::write(&corners, table).unwrap();
    let design = "ranges = 1\nplots_per_range = 2\nrows_per_plot = 2\nrow_spacing_m = 0.76\nplot_length_m = 11.1\n";
    let options = LayoutOptions::default().with(&design.parse().unwrap()).unwrap();
    let plots = |words: &str, name: &str| {
        let output = folder.path().join(name);
        let request = LayoutRequest {
            source: LayoutSource::Corners(&corners),
            field_map: None,
            crs: Some(words),
            project: None,
            output: &output,
            force: false,
        };
        let outcome = layout(&request, &options, &mut Silent).unwrap();
        let drawn = std::fs::read(output.join("plots.geojson")).unwrap();
        let drawn: serde_json::Value = serde_json::from_slice(&drawn).unwrap();
        (outcome.epsg, drawn["features"].clone())
    };
    let (code, by_code) = plots("EPSG:32616", "code");
    let (none, by_definition) = plots("+proj=utm +zone=16 +datum=WGS84 +units=m", "definition");
    assert_eq!((code, none), (Some(32616), None));
    assert_eq!(by_code, by_definition);
}

/// The truth of the plots: name, and corners first row's start and end, last row's end and start.
fn true_plots(path: &Path) -> Vec<(String, [[f64; 2]; 4])> {
    let table = CsvTable::read(path).unwrap();
    let column = |name: &str| table.numbers(name).unwrap();
    let corners: Vec<[Vec<f64>; 2]> = (0..4)
        .map(|k| ["easting", "northing"].map(|axis| column(&format!("{axis}_{k}_m"))))
        .collect();
    let names = table.texts("plot").unwrap().into_iter().map(str::to_owned);
    let of = |row: usize| std::array::from_fn(|k| [corners[k][0][row], corners[k][1][row]]);
    names.enumerate().map(|(row, name)| (name, of(row))).collect()
}

/// A project that is the picture of a synthetic field from straight above, with the truth of its plots.
fn project_of_picture(folder: &Path) -> PathBuf {
    let preset = data_synth::twin::FlightPreset::Small;
    let config = data_synth::twin::TwinConfig::preset(preset);
    let options = FlightOptions { photos: false, ..FlightOptions::default() };
    let flight = folder.join("flight");
    std::fs::create_dir(&flight).unwrap();
    write_flight(&config, &options, &flight, false, &mut Silent).unwrap();
    let picture = image::open(flight.join("truth/picture.png")).unwrap().into_rgb8();
    let world = std::fs::read_to_string(flight.join("truth/picture.pgw")).unwrap();
    let world: Vec<f64> = world.lines().map(|line| line.trim().parse().unwrap()).collect();
    let code = config.build().unwrap().site.config().epsg;
    let place = Georeference {
        per_column: [world[0], world[1]],
        per_row: [world[2], world[3]],
        origin: [world[4], world[5]],
        crs: Crs::projected(code),
    };
    let root = folder.join("field");
    std::fs::create_dir(&root).unwrap();
    maps::write(&root.join("field.tif"), &picture, place);
    root
}

/// From a picture to plants, from corners that are wrong to plots that are right, and from their files to traits.
#[test]
#[ignore = "slow; cargo test -- --include-ignored"]
fn a_layout_is_moved_onto_the_picture_of_a_field() {
    let folder = tempfile::tempdir().unwrap();
    let root = project_of_picture(folder.path());
    let truth = true_plots(&folder.path().join("flight/truth/plots.csv"));
    assert_eq!(truth.len(), 8);
    let project = Project::open(&root).unwrap();
    segment(&project, &project.config().segment, &mut Silent).unwrap();
    locate(&project, &project.config().locate, &mut Silent).unwrap();

    // The corners of the field, off by 0.4 m and half a row, a degree and a hundredth. The twin counts plots along the rows.
    let corners = [
        ("first", truth[0].1[0]),
        ("along", truth[1].1[1]),
        ("across", truth[6].1[3]),
        ("opposite", truth[7].1[2]),
    ];
    let middle = [0, 1].map(|axis| corners.iter().map(|of| of.1[axis]).sum::<f64>() / 4.0);
    let (sin, cos) = 1f64.to_radians().sin_cos();
    let mut table = "corner,easting_m,northing_m\n".to_owned();
    for (name, at) in corners {
        let [x, y] = [at[0] - middle[0], at[1] - middle[1]].map(|x| 1.01 * x);
        let moved = [middle[0] + cos * x - sin * y + 0.4, middle[1] + sin * x + cos * y - 0.38];
        table += &format!("{name},{:.4},{:.4}\n", moved[0], moved[1]);
    }
    std::fs::write(root.join("corners.csv"), table).unwrap();
    let map: String = (0..8).map(|plot| format!("{plot},G{plot},{}\n", plot % 2)).collect();
    std::fs::write(root.join("map.csv"), format!("plot,genotype,block\n{map}")).unwrap();
    let design = "ranges = 2\nplots_per_range = 4\nrows_per_plot = 5\nrow_spacing_m = 0.76\nplot_length_m = 8.25\n\
                  alley_m = 1.5\nnumbering = \"along\"\nfirst_number = 0\n";
    let options = LayoutOptions::default().with(&design.parse().unwrap()).unwrap();
    let (corners, map) = (root.join("corners.csv"), root.join("map.csv"));
    let mut request = LayoutRequest {
        source: LayoutSource::Corners(&corners),
        field_map: Some(&map),
        crs: None,
        project: Some(&project),
        output: &root,
        force: false,
    };
    let mut silent = Silent;
    let mut recorder = Recorder::new(&mut silent);
    let outcome = layout(&request, &options, &mut recorder).unwrap();
    let codes: Vec<&str> = recorder.diagnostics.iter().map(|of| &*of.code).collect();
    assert!(!codes.iter().any(|code| code.starts_with("layout-amb")), "{:?}", recorder.diagnostics);
    println!("{codes:?}\n{:?}", outcome.refined);

    let place = Georeference::north_up([0.0; 2], 1.0, Crs::projected(outcome.epsg.unwrap()));
    let errors = |path: &Path| -> Vec<f64> {
        let plots = polygons::read(path, Some(&place)).unwrap();
        let found = |name: &str| plots.iter().find(|plot| plot.name == name).unwrap();
        let off = |at: &[f64; 2], ring: &[[f64; 2]]| {
            let near = ring.iter().map(|[u, v]| (u - at[0]).hypot(-v - at[1]));
            near.fold(f64::INFINITY, f64::min)
        };
        let of = |(name, corners): &(String, [[f64; 2]; 4])| {
            let ring = &found(name).polygon.rings[0];
            corners.iter().map(|at| off(at, ring)).collect::<Vec<_>>()
        };
        truth.iter().flat_map(of).collect()
    };
    let rms =
        |errors: &[f64]| (errors.iter().map(|e| e * e).sum::<f64>() / errors.len() as f64).sqrt();
    for name in ["plots.geojson", "plots.gpkg", "plots.shp"] {
        let errors = errors(&root.join(name));
        let worst = errors.iter().copied().fold(0.0, f64::max);
        println!("{name}: rms {:.4} m, worst {worst:.4} m", rms(&errors));
        assert!(rms(&errors) < 0.04 && worst < 0.08, "{name}: {errors:?}");
    }
    let sigma = outcome.plots.iter().map(|plot| plot.sigma_m.unwrap());
    let sigma = sigma.map(|[a, b]| a.hypot(b)).fold(0.0, f64::max);
    println!("largest sigma {sigma:.4} m");
    assert!(rms(&errors(&root.join("plots.geojson"))) < 1.5 * sigma);
    assert!(root.join("figures/layout.png").is_file());
    crate::formats::assert_columns_are_documented(&root);

    // Polygons that somebody drew come back likewise; here those of corners alone, which nothing has moved yet.
    let (drawn, moved) = (root.join("drawn"), root.join("moved"));
    let system = format!("EPSG:{}", outcome.epsg.unwrap());
    let alone = LayoutRequest { project: None, crs: Some(&system), output: &drawn, ..request };
    layout(&alone, &options, &mut Silent).unwrap();
    let before = rms(&errors(&drawn.join("plots.gpkg")));
    let path = drawn.join("plots.gpkg");
    (request.source, request.field_map, request.output) =
        (LayoutSource::Polygons(&path), None, &moved);
    layout(&request, &LayoutOptions::default(), &mut Silent).unwrap();
    let after = rms(&errors(&moved.join("plots.gpkg")));
    println!("polygons: from {before:.3} m to {after:.4} m");
    assert!(before > 0.4 && after < 0.06, "{before} {after}");

    // The file in the project is what plots are of, and its attributes come along.
    plots(&project, &project.config().plots, &mut Silent).unwrap();
    let traits = CsvTable::read(&project.file(Stage::Plots, "traits.csv")).unwrap();
    assert_eq!(traits.texts("genotype").unwrap()[3], "G3");
    let text = std::fs::read_to_string(project.file(Stage::Plots, "traits.geojson")).unwrap();
    assert!(text.contains("\"genotype\":\"G3\"") && text.contains("\"block\":1"), "{text}");

    // Plots that the map shows a part of, and none of, are told.
    let geojson = std::fs::read_to_string(root.join("plots.geojson")).unwrap();
    let mut document: serde_json::Value = serde_json::from_str(&geojson).unwrap();
    for (plot, east) in [(0, -3.0), (1, 500.0)] {
        let ring = &mut document["features"][plot]["geometry"]["coordinates"][0];
        for at in ring.as_array_mut().unwrap() {
            at[0] = (at[0].as_f64().unwrap() + east).into();
        }
    }
    std::fs::write(root.join("plots.geojson"), document.to_string()).unwrap();
    let mut recorder = Recorder::new(&mut silent);
    let outcome = plots(&project, &project.config().plots, &mut recorder).unwrap();
    let codes: Vec<&str> = recorder.diagnostics.iter().map(|of| &*of.code).collect();
    assert!(
        codes.contains(&"plots-outside") && codes.contains(&"plots-partly-outside"),
        "{codes:?}"
    );
    assert_eq!((outcome.outside.len(), outcome.partly_outside.len()), (1, 1), "{outcome:?}");
}
