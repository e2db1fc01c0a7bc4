//! Leaf segmentation: the methods and their parts, on synthetic fields of which every leaf is known, and on real rosettes.
//!
//! - Symmetric best Dice (SBD): the smaller of the mean best Dice of found leaves over true ones and of true
//!   over found ones (Scharr et al., "Leaf segmentation in plant phenotyping", MVA 27, 2016).
//! - DiC, |DiC|: found minus true number of leaves, and its size, as shares of the true number.
//! - Length, width: mean relative error of found leaves that have a Dice above 0.7 with a true one, against the
//!   projection of the whole true leaf, hidden parts included.

use crate::{Folders, watershed};
use data_synth::{
    labels,
    scenario::{Preset, Scenario},
};
use rowgram::{
    Error,
    io::{FileError, images, output},
    phenotype::leaves::{self, Bridging, LeafOptions, Leaves},
    raster::{Mask, components},
};
use std::{collections::BTreeMap, fmt::Write as _, path::Path};

pub(crate) enum Method {
    Components,
    /// With markers at least so many usual widths apart.
    Watershed(f64),
    Slices(LeafOptions),
}

pub(crate) fn methods() -> Vec<(&'static str, Method)> {
    let (paper, all) = (LeafOptions::paper(), LeafOptions::default());
    vec![
        ("connected components", Method::Components),
        ("watershed, markers 1 width apart", Method::Watershed(1.0)),
        ("watershed, markers 2 widths apart", Method::Watershed(2.0)),
        ("watershed, markers 3 widths apart", Method::Watershed(3.0)),
        ("paper", Method::Slices(paper)),
        ("paper, no bridging", Method::Slices(LeafOptions { bridging: Bridging::None, ..paper })),
        ("global bridging", Method::Slices(LeafOptions { bridging: Bridging::Global, ..paper })),
        (
            "global bridging, curvature",
            Method::Slices(LeafOptions { bridging: Bridging::Global, curvature: true, ..paper }),
        ),
        ("global bridging, curvature, split", Method::Slices(all)),
        ("more bridges (cost up to 1)", Method::Slices(LeafOptions { bridge_cost: 1.0, ..all })),
        ("split from 1.7 widths", Method::Slices(LeafOptions { double_width_ratio: 1.7, ..all })),
        ("split, no bridging", Method::Slices(LeafOptions { bridging: Bridging::None, ..all })),
    ]
}

/// What one method did on one mask.
pub(crate) struct Run {
    scenario: String,
    method: &'static str,
    pub(crate) sbd: f64,
    pub(crate) found: f64,
    pub(crate) truth: f64,
    pub(crate) length: Option<f64>,
    pub(crate) width: Option<f64>,
}

/// Runs everything and writes `leaves.csv` and `leaves.md`.
pub(crate) fn run(folders: &Folders, masks: u64) -> Result<(), Error> {
    let mut runs = Vec::new();
    for preset in [Preset::Early20, Preset::Mid20, Preset::Mid12, Preset::Late30] {
        for gsd_cm in [0.3, 0.6, 1.0, 1.5] {
            for seed in 1..=masks {
                let mut scenario = Scenario::preset(preset);
                scenario.field.seed = seed;
                scenario.field.gsd_m = gsd_cm / 100.0;
                scenario.field.rows = 3;
                scenario.field.row_length_m = 3.0;
                synthetic(&format!("{preset} {gsd_cm} cm/px"), &scenario, &mut runs)?;
            }
        }
    }
    rosettes(&folders.data.join("leaf_cvppp_a1"), &mut runs)?;
    write(&folders.out, "leaves", &runs)
}

fn synthetic(name: &str, scenario: &Scenario, runs: &mut Vec<Run>) -> Result<(), Error> {
    let scene = scenario.build().map_err(|error| Error::Argument(error.to_string()))?;
    let truth = labels::labels(&scene.field, &scene.weeds);
    let (width, height) = (truth.width, truth.height);
    let mask = Mask { width, height, data: truth.data.iter().map(|&x| u8::from(x > 0)).collect() };
    let all: Vec<_> = scene.field.leaves().collect();
    for (method, how) in methods() {
        let (found, leaves) = segment(&mask, &how);
        let mut run = judge(name, method, &found, &truth.data);
        if let Some(leaves) = leaves {
            let (mut length, mut wide, mut count) = (0.0, 0.0, 0.0);
            for (place, true_label) in pairs(&found, &truth.data) {
                let (leaf, Some(real)) = (&leaves.leaves[place], all.get(true_label)) else {
                    continue;
                };
                let plan: f64 = real
                    .axis_m
                    .windows(2)
                    .map(|w| (w[0][0] - w[1][0]).hypot(w[0][1] - w[1][1]))
                    .sum();
                let gsd_m = scenario.field.gsd_m;
                length += leaf.length_px * gsd_m / plan - 1.0;
                wide += leaf.max_width_px() * gsd_m / real.width_m - 1.0;
                count += 1.0;
            }
            if count > 0.0 {
                (run.length, run.width) = (Some(length / count), Some(wide / count));
            }
        }
        runs.push(run);
    }
    Ok(())
}

fn rosettes(folder: &Path, runs: &mut Vec<Run>) -> Result<(), Error> {
    let entries = std::fs::read_dir(folder).map_err(|error| FileError::read(folder, error))?;
    let mut names: Vec<_> = entries.flatten().map(|entry| entry.path()).collect();
    names.sort();
    for path in names.iter().filter(|path| path.to_string_lossy().ends_with("_label.png")) {
        let (truth, mask) = classes(path)?;
        for (method, how) in methods() {
            let (found, _) = segment(&mask, &how);
            runs.push(judge("CVPPP A1 rosettes", method, &found, &truth));
        }
    }
    Ok(())
}

/// The labels of a picture in which every leaf has a colour, and the mask of all leaves.
pub(crate) fn classes(path: &Path) -> Result<(Vec<u32>, Mask), FileError> {
    let picture = match images::read(path)? {
        images::Picture::Photo(picture) => picture,
        images::Picture::Mask(mask) => mask.to_rgb(),
    };
    let mut classes: BTreeMap<[u8; 3], u32> = BTreeMap::from([([0; 3], 0)]);
    let labels: Vec<u32> = picture
        .pixels()
        .map(|pixel| {
            let next = classes.len() as u32;
            *classes.entry(pixel.0).or_insert(next)
        })
        .collect();
    let (width, height) = (picture.width() as usize, picture.height() as usize);
    let mask = Mask { width, height, data: labels.iter().map(|&x| u8::from(x > 0)).collect() };
    Ok((labels, mask))
}

pub(crate) fn segment(mask: &Mask, how: &Method) -> (Vec<u32>, Option<Leaves>) {
    let mut labels = vec![0; mask.data.len()];
    let mut paint = |runs: &[components::Run], label: u32| {
        for run in runs {
            labels[run.v * mask.width + run.start..run.v * mask.width + run.end].fill(label);
        }
    };
    match how {
        Method::Components => {
            let parts = components::parts(mask);
            parts.iter().zip(1..).for_each(|(part, label)| paint(&part.runs, label));
            (labels, None)
        }
        Method::Watershed(widths) => {
            let usual = leaves::find(mask, &LeafOptions::paper()).usual_width_px;
            (watershed::labels(mask, (widths * usual).round().max(1.0) as usize), None)
        }
        Method::Slices(options) => {
            let found = leaves::find(mask, options);
            found.leaves.iter().zip(1..).for_each(|(leaf, label)| paint(&leaf.runs, label));
            (labels, Some(found))
        }
    }
}

type Sizes = BTreeMap<u32, f64>;

/// Sizes of the labels of both, and of their intersections.
fn overlaps(found: &[u32], truth: &[u32]) -> (Sizes, Sizes, BTreeMap<(u32, u32), f64>) {
    let (mut a, mut b, mut both) = (Sizes::new(), Sizes::new(), BTreeMap::new());
    for (&f, &t) in found.iter().zip(truth) {
        if f > 0 {
            *a.entry(f).or_default() += 1.0;
        }
        if t > 0 {
            *b.entry(t).or_default() += 1.0;
        }
        if f > 0 && t > 0 {
            *both.entry((f, t)).or_default() += 1.0;
        }
    }
    (a, b, both)
}

/// Found leaves and the true leaves (from 0) with which they have a Dice above 0.7.
pub(crate) fn pairs(found: &[u32], truth: &[u32]) -> Vec<(usize, usize)> {
    let (a, b, both) = overlaps(found, truth);
    let good = both.into_iter().filter(|((f, t), n)| 2.0 * n / (a[f] + b[t]) > 0.7);
    good.map(|((f, t), _)| (f as usize - 1, t as usize - 1)).collect()
}

pub(crate) fn judge(scenario: &str, method: &'static str, found: &[u32], truth: &[u32]) -> Run {
    let (a, b, both) = overlaps(found, truth);
    let (mut best_a, mut best_b) = (Sizes::new(), Sizes::new());
    for ((f, t), n) in both {
        let dice = 2.0 * n / (a[&f] + b[&t]);
        for (best, label) in [(&mut best_a, f), (&mut best_b, t)] {
            let best = best.entry(label).or_default();
            *best = best.max(dice);
        }
    }
    let mean = |best: &Sizes, all: &Sizes| best.values().sum::<f64>() / all.len().max(1) as f64;
    Run {
        scenario: scenario.to_owned(),
        method,
        sbd: mean(&best_a, &a).min(mean(&best_b, &b)),
        found: a.len() as f64,
        truth: b.len() as f64,
        length: None,
        width: None,
    }
}

pub(crate) fn mean(values: impl Iterator<Item = f64>) -> Option<f64> {
    let (sum, count) = values.fold((0.0, 0.0), |(sum, count), x| (sum + x, count + 1.0));
    (count > 0.0).then(|| sum / count)
}

/// Writes `NAME.csv` and `NAME.md`.
pub(crate) fn write(folder: &Path, name: &str, runs: &[Run]) -> Result<(), Error> {
    let number = |x: Option<f64>| x.map(|x| format!("{x:.4}")).unwrap_or_default();
    let mut csv = "scenario,method,sbd,found,truth,length_error,width_error\n".to_owned();
    for run in runs {
        let (length, width) = (number(run.length), number(run.width));
        let Run { scenario, method, sbd, found, truth, .. } = run;
        let _ = writeln!(csv, "{scenario},\"{method}\",{sbd:.4},{found},{truth},{length},{width}");
    }
    let mut scenarios: Vec<&str> = Vec::new();
    for run in runs {
        if !scenarios.contains(&run.scenario.as_str()) {
            scenarios.push(&run.scenario);
        }
    }
    let mut text =
        "# Leaves\n\nSBD / DiC / |DiC| (shares of the true number) / length / width error.\n\n"
            .to_owned();
    for scenario in scenarios {
        let _ = writeln!(
            text,
            "## {scenario}\n\n| method | SBD | DiC | abs DiC | length | width |\n|---|---|---|---|---|---|"
        );
        for (method, _) in methods() {
            let mine = || runs.iter().filter(|r| r.scenario == scenario && r.method == method);
            let dic = |r: &Run| (r.found - r.truth) / r.truth;
            let percent =
                |x: Option<f64>| x.map(|x| format!("{:+.0} %", 100.0 * x)).unwrap_or_default();
            let _ = writeln!(
                text,
                "| {method} | {:.3} | {} | {} | {} | {} |",
                mean(mine().map(|r| r.sbd)).unwrap_or_default(),
                percent(mean(mine().map(dic))),
                percent(mean(mine().map(|r| dic(r).abs()))),
                percent(mean(mine().filter_map(|r| r.length))),
                percent(mean(mine().filter_map(|r| r.width))),
            );
        }
        text.push('\n');
    }
    output::write(&folder.join(format!("{name}.csv")), true, |out| out.write_all(csv.as_bytes()))?;
    output::write(&folder.join(format!("{name}.md")), true, |out| out.write_all(text.as_bytes()))?;
    Ok(())
}
