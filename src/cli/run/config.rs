//! `rowgram.toml`: what a run does, every default in one place.
//!
//! The file, then the environment (`ROWGRAM_SECTION_KEY`), then `--set section.key=value`; what came of it is
//! saved beside the results.

use crate::{error::Error, io::FileError};
use serde::{Deserialize, Serialize};
use std::path::{Path, PathBuf};
use toml::{Table, Value};

/// The file that `rowgram init` writes: every key with its default and what it means.
pub(super) const TEMPLATE: &str = include_str!("rowgram.toml");
/// Its name.
pub(super) const NAME: &str = "rowgram.toml";

macro_rules! section {
    ($(#[$doc:meta])* $name:ident { $($key:ident: $kind:ty = $default:expr,)* }) => {
        $(#[$doc])*
        #[derive(Debug, Clone, PartialEq, Serialize, Deserialize)]
        #[serde(deny_unknown_fields, default)]
        pub(super) struct $name {
            $(
                #[serde(skip_serializing_if = "unset")]
                pub(super) $key: $kind,
            )*
        }
        impl Default for $name {
            fn default() -> $name {
                $name { $($key: $default,)* }
            }
        }
    };
}

/// Whether a value is a `None`, which TOML has no word for.
fn unset(value: &impl Serialize) -> bool {
    matches!(serde_json::to_value(value), Ok(serde_json::Value::Null))
}

section! {
    /// What the folder holds.
    Project {
        name: Option<String> = None,
        ortho: Option<PathBuf> = None,
        crs: Option<String> = None,
        control: Option<PathBuf> = None,
        marks: Option<PathBuf> = None,
        geolocation: Option<PathBuf> = None,
        camera: Option<PathBuf> = None,
        plots: Option<PathBuf> = None,
        regions: Option<PathBuf> = None,
        truth: Option<PathBuf> = None,
    }
}
section! {
    /// Which stages are done.
    Stages { skip: Vec<String> = Vec::new(), }
}
section! {
    /// The camera from photos of a board.
    Calibrate {
        images: PathBuf = "calibration".into(),
        board: Option<String> = None,
        square_m: Option<f64> = None,
    }
}
section! {
    /// From photos to a block.
    Align {
        lens: String = "auto".into(),
        solver: String = "auto".into(),
        max_features: usize = 6000,
        tolerance_px: f64 = 4.0,
        use_positions: bool = true,
        rolling_shutter: String = "auto".into(),
        check: Vec<String> = Vec::new(),
        seed: u64 = 1,
    }
}
section! {
    /// The surface.
    Dem { cell_m: Option<f64> = None, outlier: f64 = 5.0, }
}
section! {
    /// The orthomosaic.
    Ortho {
        above: OrAuto<f64> = OrAuto::default(),
        gsd_m: Option<f64> = None,
        balance: bool = false,
        feather_m: Option<f64> = None,
    }
}
section! {
    /// Leaf pixels.
    Segment {
        tau: OrAuto<[u16; 4]> = OrAuto::default(),
        min_pixels: usize = 0,
        fill_holes: usize = 0,
    }
}
section! {
    /// Local density.
    Density { window_px: usize = 41, }
}
section! {
    /// Leaves by area.
    Count { rho_px: Option<f64> = None, }
}
section! {
    /// Plants.
    Locate { plants: OrAuto<usize> = OrAuto::default(), method: String = "full".into(), }
}
section! {
    /// Single leaves.
    Leaves { min_pixels: usize = 1, }
}
section! {
    /// Plots.
    Plots { rows_per_plot: Option<usize> = None, alley_m: Option<f64> = None, }
}
section! {
    /// Against the truth.
    Evaluate { radii_m: Vec<f64> = vec![0.05, 0.1], }
}
section! {
    /// Traffic lights.
    Report { check_yellow_gsd: f64 = 2.0, check_red_gsd: f64 = 4.0, }
}
section! {
    /// All of it.
    Config {
        project: Project = Project::default(),
        stages: Stages = Stages::default(),
        calibrate: Calibrate = Calibrate::default(),
        align: Align = Align::default(),
        dem: Dem = Dem::default(),
        ortho: Ortho = Ortho::default(),
        segment: Segment = Segment::default(),
        density: Density = Density::default(),
        count: Count = Count::default(),
        locate: Locate = Locate::default(),
        leaves: Leaves = Leaves::default(),
        plots: Plots = Plots::default(),
        evaluate: Evaluate = Evaluate::default(),
        report: Report = Report::default(),
    }
}

/// A number, or `"auto"`.
#[derive(Debug, Clone, PartialEq, Serialize, Deserialize)]
#[serde(untagged, expecting = "expected numbers, or \"auto\"")]
pub(super) enum OrAuto<T> {
    /// This.
    Given(T),
    /// `auto`.
    Word(Word),
}

/// The word that leaves a number to the program.
#[derive(Debug, Clone, Copy, PartialEq, Eq, Serialize, Deserialize)]
#[serde(rename_all = "lowercase")]
pub(super) enum Word {
    /// `auto`.
    Auto,
}

impl<T> Default for OrAuto<T> {
    fn default() -> OrAuto<T> {
        OrAuto::Word(Word::Auto)
    }
}

impl<T: std::fmt::Display> std::fmt::Display for OrAuto<T> {
    fn fmt(&self, f: &mut std::fmt::Formatter<'_>) -> std::fmt::Result {
        match self {
            OrAuto::Given(value) => write!(f, "{value}"),
            OrAuto::Word(Word::Auto) => f.write_str("auto"),
        }
    }
}

impl Config {
    /// The file of the folder where there is one, then the environment, then `settings` (`section.key=value`).
    ///
    /// # Errors
    /// A file that is no such TOML, a key or value that does not belong here.
    pub(super) fn read(
        root: &Path,
        environment: impl Fn(&str) -> Option<String>,
        settings: &[String],
    ) -> Result<Config, Error> {
        let path = root.join(NAME);
        let mut table = match std::fs::read_to_string(&path) {
            Ok(text) => {
                let table = text.parse::<Table>().map_err(|e| located(&path, &text, &e))?;
                // What the file says alone first, so that its own mistakes are told as its own.
                toml::from_str::<Config>(&text).map_err(|e| located(&path, &text, &e))?;
                table
            }
            Err(e) if e.kind() == std::io::ErrorKind::NotFound => Table::new(),
            Err(e) => return Err(FileError::read(&path, e).into()),
        };
        for (section, key) in keys() {
            let name = format!("ROWGRAM_{section}_{key}").to_uppercase();
            if let Some(text) = environment(&name) {
                set(&mut table, &section, &key, &text);
                check(&table, &name, &text)?;
            }
        }
        for setting in settings {
            let expected = || {
                Error::Argument(format!(
                    "--set {setting}: expected section.key=value with a key of rowgram.toml, as in --set align.seed=2"
                ))
            };
            let (name, text) = setting.split_once('=').ok_or_else(expected)?;
            let (section, key) = name.split_once('.').ok_or_else(expected)?;
            let (section, key) = (section.trim(), key.trim());
            if !keys().iter().any(|(s, k)| s == section && k == key) {
                return Err(expected());
            }
            set(&mut table, section, key, text.trim());
            check(&table, &format!("--set {name}"), text)?;
        }
        Value::Table(table).try_into().map_err(|e: toml::de::Error| Error::Argument(e.to_string()))
    }
}

fn located(path: &Path, text: &str, error: &toml::de::Error) -> Error {
    let line = error.span().map(|span| 1 + text[..span.start].matches('\n').count());
    FileError::malformed(path, line, error.message()).into()
}

fn check(table: &Table, name: &str, text: &str) -> Result<(), Error> {
    let result: Result<Config, toml::de::Error> = Value::Table(table.clone()).try_into();
    result.map(drop).map_err(|e| Error::Argument(format!("{name}={text}: {}", e.message())))
}

fn set(table: &mut Table, section: &str, key: &str, text: &str) {
    // A value as TOML spells it; anything else is a word.
    let value = format!("x = {text}")
        .parse::<Table>()
        .ok()
        .and_then(|mut one| one.remove("x"))
        .unwrap_or_else(|| Value::String(text.to_owned()));
    let entry = table.entry(section).or_insert_with(|| Value::Table(Table::new()));
    if let Value::Table(section) = entry {
        section.insert(key.to_owned(), value);
    }
}

/// Every key that there is, as the template has it, set or not.
fn keys() -> Vec<(String, String)> {
    let mut section = String::new();
    let mut found = Vec::new();
    for line in TEMPLATE.lines() {
        if let Some(name) = line.strip_prefix('[').and_then(|rest| rest.strip_suffix(']')) {
            section = name.to_owned();
        } else if let Some((key, _)) = line.trim_start_matches("# ").split_once(" = ")
            && !key.contains(' ')
            && !section.is_empty()
        {
            found.push((section.clone(), key.to_owned()));
        }
    }
    found
}

#[cfg(test)]
mod tests {
    use super::*;

    fn nothing(_: &str) -> Option<String> {
        None
    }

    #[test]
    fn the_template_says_every_default() {
        let written: Config = toml::from_str(TEMPLATE).unwrap();
        assert_eq!(written, Config::default());
        // Keys that are not set are in it too: set, they are all known.
        let set: String = TEMPLATE
            .lines()
            .map(|line| match line.strip_prefix("# ") {
                Some(rest) if rest.split_once(" = ").is_some_and(|(k, _)| !k.contains(' ')) => rest,
                _ => line,
            })
            .map(|line| format!("{line}\n"))
            .collect();
        let set: Config = toml::from_str(&set).unwrap();
        let count = |config: &Config| {
            let table = Table::try_from(config).unwrap();
            table.values().map(|section| section.as_table().unwrap().len()).sum::<usize>()
        };
        assert_eq!(count(&set), keys().len());
        assert!(count(&set) > count(&Config::default()));
    }

    #[test]
    fn file_then_environment_then_options() {
        let folder = tempfile::tempdir().unwrap();
        let file = "[align]\nseed = 2\nlens = \"smac\"\n[ortho]\ngsd_m = 0.5\nabove = 0\n";
        std::fs::write(folder.path().join(NAME), file).unwrap();
        let environment = |name: &str| match name {
            "ROWGRAM_ALIGN_SEED" => Some("3".to_owned()),
            "ROWGRAM_ORTHO_GSD_M" => Some("0.25".to_owned()),
            _ => None,
        };
        let settings = ["align.seed=4".to_owned(), "project.crs=EPSG:32616".to_owned()];
        let config = Config::read(folder.path(), environment, &settings).unwrap();
        assert_eq!((config.align.seed, config.align.lens.as_str()), (4, "smac"));
        assert_eq!(config.ortho.gsd_m, Some(0.25));
        assert_eq!(config.ortho.above, OrAuto::Given(0.0));
        assert_eq!(config.project.crs.as_deref(), Some("EPSG:32616"));
        let text = toml::to_string(&config).unwrap();
        assert_eq!(toml::from_str::<Config>(&text).unwrap(), config);
    }

    #[test]
    fn mistakes_are_named() {
        let folder = tempfile::tempdir().unwrap();
        for (file, expected) in [
            ("[align]\nsede = 2\n", "line 2"),
            ("[align]\nseed = \"two\"\n", "line 2"),
            ("[align\n", "line 1"),
            ("[ortho]\nabove = \"top\"\n", "\"auto\""),
        ] {
            std::fs::write(folder.path().join(NAME), file).unwrap();
            let error = Config::read(folder.path(), nothing, &[]).unwrap_err().to_string();
            assert!(error.contains(expected) && error.contains(NAME), "{error}");
        }
        std::fs::remove_file(folder.path().join(NAME)).unwrap();
        for setting in ["seed=1", "align.sede=1", "align.seed", "align.seed=two"] {
            let error = Config::read(folder.path(), nothing, &[setting.to_owned()])
                .unwrap_err()
                .to_string();
            assert!(error.contains("--set align.se") || error.contains("--set seed"), "{error}");
        }
        let environment = |name: &str| (name == "ROWGRAM_ALIGN_SEED").then(|| "two".to_owned());
        let error = Config::read(folder.path(), environment, &[]).unwrap_err().to_string();
        assert!(error.contains("ROWGRAM_ALIGN_SEED"), "{error}");
    }
}
