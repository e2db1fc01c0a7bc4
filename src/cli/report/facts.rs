//! What the stages found, gathered from their records and files.

use super::{Sources, lights::Light};
use crate::{
    cli::run::{
        STAGES,
        record::{Record, Records},
    },
    error::Error,
    io::csv_table::CsvTable,
};
use serde_json::{Value, json};
use std::{
    collections::BTreeMap,
    fmt::Write,
    path::{Path, PathBuf},
};

/// All that the report tells.
pub(in crate::cli) struct Facts {
    pub(super) name: String,
    pub(super) results: PathBuf,
    pub(super) root: PathBuf,
    /// Records of the stages that were done, in their order.
    pub(super) records: Vec<Record>,
    pub(super) skipped: Vec<(String, String)>,
    /// The report of the adjustment.
    pub(super) adjustment: Value,
}

/// A number inside a value; `None` where there is none.
pub(super) fn number(value: &Value, path: &str) -> Option<f64> {
    value.pointer(path).and_then(Value::as_f64)
}

impl Facts {
    /// Reads the records, and the files that they name.
    ///
    /// # Errors
    /// A file that cannot be read.
    pub(super) fn gather(sources: &Sources<'_>) -> Result<Facts, Error> {
        let not_done = |name: &str| sources.skipped.iter().any(|(other, _)| other == name);
        let records = Records::of(sources.root, sources.results);
        let records: Vec<Record> =
            STAGES.iter().filter(|n| !not_done(n)).filter_map(|n| records.read(n)).collect();
        let adjustment = sources.results.join("align").join("report").join("report.json");
        let aligned = records.iter().any(|record| record.stage == "align");
        let adjustment = std::fs::read(adjustment)
            .ok()
            .filter(|_| aligned)
            .and_then(|bytes| serde_json::from_slice(&bytes).ok())
            .unwrap_or(Value::Null);
        let folder = sources.root.canonicalize().ok();
        let folder = folder.and_then(|p| Some(p.file_name()?.to_string_lossy().into_owned()));
        Ok(Facts {
            name: sources.name.clone().or(folder).unwrap_or_else(|| "field".to_owned()),
            results: sources.results.to_owned(),
            root: sources.root.to_owned(),
            records,
            skipped: sources.skipped.to_vec(),
            adjustment,
        })
    }

    /// What a stage says of its result; null where it was not done.
    pub(super) fn says(&self, stage: &str) -> &Value {
        self.records.iter().find(|r| r.stage == stage).map_or(&Value::Null, |r| &r.says)
    }

    /// Whether a stage was done.
    pub(super) fn done(&self, stage: &str) -> bool {
        self.records.iter().any(|record| record.stage == stage)
    }

    /// A file of a stage that was done.
    pub(super) fn file(&self, stage: &str, name: &str) -> Option<PathBuf> {
        let path = self.results.join(stage).join(name);
        (self.done(stage) && path.is_file()).then_some(path)
    }

    /// A table of a stage that was done.
    ///
    /// # Errors
    /// A table that is there and cannot be read.
    pub(super) fn table(&self, stage: &str, name: &str) -> Result<Option<CsvTable>, Error> {
        Ok(self.file(stage, name).map(|path| CsvTable::read(&path)).transpose()?)
    }

    /// The orthomosaic that traits come from: what segment read.
    pub(super) fn ortho(&self) -> Option<PathBuf> {
        let record = self.records.iter().find(|record| record.stage == "segment")?;
        let path: &Path = &record.inputs.first()?.path;
        let path = self.root.join(path);
        path.is_file().then_some(path)
    }

    /// Ground sampling distance of the map, metres.
    pub(super) fn gsd_m(&self) -> Option<f64> {
        number(self.says("ortho"), "/maps/0/gsd_m").or_else(|| {
            let source = crate::io::rasters::Source::open(&self.ortho()?).ok()?;
            source.georeference()?.gsd_m()
        })
    }

    /// All numbers, for machines.
    pub(super) fn stats(&self, lights: &[Light]) -> Value {
        let stages: BTreeMap<&str, &Value> =
            self.records.iter().map(|r| (r.stage.as_str(), &r.says)).collect();
        let timings: BTreeMap<&str, f64> =
            self.records.iter().map(|r| (r.stage.as_str(), r.seconds)).collect();
        let skipped: BTreeMap<&str, &str> =
            self.skipped.iter().map(|(a, b)| (a.as_str(), b.as_str())).collect();
        let commands: Vec<&str> = self.records.iter().map(|r| r.command.as_str()).collect();
        json!({
            "program": "rowgram",
            "version": env!("CARGO_PKG_VERSION"),
            "project": self.name,
            "lights": lights,
            "stages": stages,
            "adjustment": self.adjustment,
            "skipped": skipped,
            "commands": commands,
            "seconds": timings,
            "peak_memory_mb": self.records.iter().filter_map(|r| r.peak_memory_mb).fold(0.0, f64::max),
        })
    }

    /// What a terminal shows at the end.
    pub(super) fn headline(&self) -> String {
        let mut text = String::new();
        let align = self.says("align");
        // Writing to a string cannot fail.
        if let (Some(registered), Some(images)) =
            (number(align, "/registered"), number(align, "/images"))
        {
            let _ = write!(text, "block   {registered} of {images} photos oriented");
            if let Some(rms) = number(align, "/reprojection_rms_px") {
                let _ = write!(text, ", reprojection rms {rms:.2} px");
            }
            let checks = |axis: &str| number(align, &format!("/check_points/rmse_{axis}_m"));
            if let (Some(x), Some(y), Some(z)) = (checks("x"), checks("y"), checks("z")) {
                let _ = write!(
                    text,
                    "\n        check points: rmse {:.1} {:.1} {:.1} cm in X, Y, Z",
                    100.0 * x,
                    100.0 * y,
                    100.0 * z
                );
            }
            text.push('\n');
        }
        if let Some(gsd) = self.gsd_m() {
            let _ = writeln!(text, "map     {:.2} cm per pixel", 100.0 * gsd);
        }
        if let Some(share) = number(self.says("segment"), "/plant_share") {
            let _ = writeln!(text, "leaves  cover {:.1} % of the map", 100.0 * share);
        }
        if let Some(count) = number(self.says("count"), "/counts/0/leaves") {
            let _ = writeln!(text, "        {count:.0} leaves by area");
        }
        let locate = self.says("locate");
        if let Some(plants) = number(locate, "/plants") {
            let _ =
                write!(text, "plants  {plants} in {} rows", number(locate, "/rows").unwrap_or(0.0));
            if let Some(spacing) = number(locate, "/spacing_m") {
                let _ = write!(text, ", {:.1} cm apart", 100.0 * spacing);
            }
            text.push('\n');
        }
        let truth = self.says("evaluate");
        if let Some(plants) = number(truth, "/score/truth") {
            let _ = write!(text, "truth   {plants} plants on the map");
            let radii = truth.pointer("/score/radii").and_then(Value::as_array);
            let known = truth.pointer("/radii_m").and_then(Value::as_array);
            for (radius, score) in known.into_iter().flatten().zip(radii.into_iter().flatten()) {
                if let (Some(radius), Some(f1)) = (radius.as_f64(), number(score, "/f1")) {
                    let _ = write!(text, "; F1 {f1:.2} within {:.0} cm", 100.0 * radius);
                }
            }
            text.push('\n');
            let (counted, true_leaves) = self.leaves_against_truth();
            if true_leaves > 0.0 {
                let _ = writeln!(
                    text,
                    "        leaves of the plots not counted by hand: {counted:.0} by area, {true_leaves:.0} true ({:+.1} %)",
                    100.0 * (counted / true_leaves - 1.0)
                );
            }
        }
        for (stage, why) in self.skipped.iter().filter(|(_, why)| why.starts_with("failed")) {
            let _ = writeln!(text, "{stage:<8}{why}");
        }
        text.trim_end().to_owned()
    }

    /// Leaves by area and true ones, over the plots whose leaves were not counted by hand.
    pub(super) fn leaves_against_truth(&self) -> (f64, f64) {
        let by_hand: Vec<String> = std::fs::read_to_string(self.root.join("regions.geojson"))
            .ok()
            .and_then(|text| serde_json::from_str::<Value>(&text).ok())
            .and_then(|value| {
                let features = value.get("features")?.as_array()?.clone();
                let name = |f: &Value| f.pointer("/properties/name")?.as_str().map(str::to_owned);
                Some(features.iter().filter_map(name).collect())
            })
            .unwrap_or_default();
        let plots = self.says("evaluate").get("plots").and_then(Value::as_array);
        let mut sums = (0.0, 0.0);
        for plot in plots.into_iter().flatten() {
            let name = plot.get("plot").and_then(Value::as_str).unwrap_or_default();
            if by_hand.iter().any(|other| other == name) {
                continue;
            }
            if let (Some(counted), Some(leaves)) =
                (number(plot, "/leaves_by_area"), number(plot, "/true_leaves"))
            {
                sums.0 += counted;
                sums.1 += leaves;
            }
        }
        sums
    }
}
