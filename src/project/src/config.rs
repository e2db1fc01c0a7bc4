//! The settings of a project: `rowgram.toml`, then the environment, then arguments.
//!
//! Every section is a set of [`Options`], so the file, its template, the environment (`ROWGRAM_ALIGN_SEED`) and the
//! arguments (`--set align.seed=2`) have the same names, limits and defaults. What nobody knows, and what cannot be, is
//! refused where it stands.

use super::{
    align::AlignOptions,
    calibrate::CalibrateOptions,
    checks::ChecksOptions,
    crops::CropsOptions,
    dem::DemOptions,
    evaluate::EvaluateOptions,
    leaf_count::LeafCountOptions,
    leaf_density::LeafDensityOptions,
    leaves::LeavesOptions,
    locate::LocateOptions,
    ortho::OrthoOptions,
    plots::{PlotsOptions, layout::LayoutOptions},
    segment::SegmentOptions,
    stage::Stage,
    surface::SurfaceOptions,
    targets::TargetsOptions,
};
use rowgram_base::{
    error::Error,
    options::{Field, Options, Section, nearest},
};
use rowgram_optim::output::{self, FileError};
use rowgram_raster::spectral::Band;
use serde::{Deserialize, Serialize};
use std::{collections::BTreeMap, fmt::Write as _, path::Path, path::PathBuf};
use toml::{Spanned, Table, Value};

/// The name of the file.
pub const NAME: &str = "rowgram.toml";

/// What the names of environment variables that set something begin with.
const PREFIX: &str = "ROWGRAM_";
/// Variables with that beginning that are no settings: where tests and benches find their data and tools.
const OTHER_VARIABLES: [&str; 5] =
    ["ROWGRAM_DATA", "ROWGRAM_TEST_DATA", "ROWGRAM_TEST_TOOLS", "ROWGRAM_BAL", "ROWGRAM_BUILD"];

rowgram_base::options! {
    /// What the folder holds.
    pub struct ProjectOptions in "project", main [ortho, crs, control, marks, positions, camera, plots] {
        /// Name in the report; that of the folder where not set.
        pub name: Option<String> = None, example "\"My field\"";
        /// An existing orthomosaic. Where it is set, or the folder holds no photos but one GeoTIFF, alignment is
        /// skipped and traits come from it.
        pub ortho: Option<PathBuf> = None, example "\"ortho.tif\"";
        /// What the bands of that orthomosaic show, in their order, where the file does not say so or says it wrongly.
        pub bands: Vec<Band> = Vec::new(), example "[\"blue\", \"green\", \"red\", \"red-edge\", \"nir\"]";
        /// The sample value of that orthomosaic that stands for a reflectance of 1. Where not set: its tags say so, else its kind of
        /// samples and the brightest of them (255; 10000, 32768 or 65535; 1 or 100).
        pub reflectance_scale: Option<f64> = None, limits POSITIVE, example "10000.0";
        /// Coordinate reference system of control and results: `EPSG:CODE` or a PROJ string. That of the control where not
        /// set.
        pub crs: Option<String> = None, example "\"EPSG:32616\"";
        /// Ground control points and check points. Where not set: gcps.csv, gcp_list.txt or ground_control_points.json.
        pub control: Option<PathBuf> = None, example "\"gcps.csv\"";
        /// Image measurements of the ground points (marks). Where not set: marks.csv.
        pub marks: Option<PathBuf> = None, example "\"marks.csv\"";
        /// Camera positions. Where not set: geolocation.csv, geo.txt, an image log (.MRK), else those in EXIF and XMP.
        pub positions: Option<PathBuf> = None, example "\"geolocation.csv\"";
        /// A calibrated camera. Where not set: camera.toml, else calibration from the photos in `[calibrate] images`, else
        /// self-calibration.
        pub camera: Option<PathBuf> = None, example "\"camera.toml\"";
        /// Polygons of the plots. Where not set: plots.geojson, plots.gpkg or plots.shp.
        pub plots: Option<PathBuf> = None, example "\"plots.geojson\"";
        /// The property of the plots that has their names. Where not set: the first of plot, PlotID, name, id and the like in which
        /// all plots differ.
        pub plot_key: Option<String> = None, example "\"PlotID\"";
        /// Regions in which leaves were counted by hand: polygons with a property "leaves". Where not set:
        /// regions.geojson, regions.gpkg or regions.shp.
        pub regions: Option<PathBuf> = None, example "\"regions.geojson\"";
        /// True plants to compare with: CSV with easting_m and northing_m (or _ft), longitude_deg and latitude_deg, or x and y, in
        /// the mapping frame.
        pub truth: Option<PathBuf> = None, example "\"truth/plants.csv\"";
    }
}

impl ProjectOptions {
    /// Whether the files that are named are there.
    fn check_files(&self, root: &Path) -> Result<(), Error> {
        let named = [
            ("ortho", &self.ortho),
            ("control", &self.control),
            ("marks", &self.marks),
            ("positions", &self.positions),
            ("camera", &self.camera),
            ("plots", &self.plots),
            ("regions", &self.regions),
            ("truth", &self.truth),
        ];
        let missing = named.into_iter().find_map(|(key, path)| {
            path.as_ref().filter(|path| !root.join(path).is_file()).map(|path| (key, path))
        });
        match missing {
            None => self.check_crs(),
            Some((key, path)) => Err(Error::Argument(format!(
                "[project] {key} = {:?}: there is no such file in {}",
                path.display().to_string(),
                root.display()
            ))),
        }
    }
}

impl ProjectOptions {
    /// Whether the coordinate reference system is one that is known.
    fn check_crs(&self) -> Result<(), Error> {
        let Some(words) = &self.crs else { return Ok(()) };
        match rowgram_raster::crs::Crs::from_words(words) {
            Ok(_) => Ok(()),
            Err(why) => Err(Error::Argument(format!("[project] crs = {words:?}: {why}"))),
        }
    }
}

rowgram_base::options! {
    /// Which stages are done.
    pub struct StagesOptions in "stages", main [skip] {
        /// Stages to leave out.
        pub skip: Vec<Stage> = Vec::new();
    }
}

macro_rules! config {
    ($($name:ident: $kind:ty,)*) => {
        /// All settings of a project.
        #[derive(Debug, Clone, PartialEq, Default, Serialize, Deserialize)]
        #[serde(deny_unknown_fields, default)]
        pub struct Config {
            $(
                #[doc = concat!("The section `", stringify!($name), "`.")]
                pub $name: $kind,
            )*
        }

        /// The variables of the environment that may set something: those whose names begin with `ROWGRAM_`. What else is there is
/// nobody's business here and need not be text.
///
/// # Errors
/// One of these that is not UTF-8: its name.
pub fn environment() -> Result<Vec<(String, String)>, Error> {
    let own = std::env::vars_os()
        .filter(|(name, _)| name.as_encoded_bytes().starts_with(PREFIX.as_bytes()));
    own.map(|(name, value)| {
        let text = |text: &std::ffi::OsString| text.to_str().map(str::to_owned);
        text(&name).zip(text(&value)).ok_or_else(|| {
            let name = name.to_string_lossy().into_owned();
            Error::Argument(format!("environment variable {name}: it is not UTF-8 text"))
        })
    })
    .collect()
}

impl Config {
            /// The definitions of all sections in their order.
            pub fn sections() -> Vec<Section> {
                vec![$(<$kind>::section()),*]
            }

            /// Whether all values are within their limits and go together.
            ///
            /// # Errors
            /// The first section and value that does not, and what was expected.
            pub fn validate(&self) -> Result<(), Error> {
                $(
                    self.$name.validate().map_err(|why| {
                        Error::Argument(format!("[{}] {why}", <$kind as Options>::SECTION))
                    })?;
                )*
                Ok(())
            }
        }
    };
}

config! {
    project: ProjectOptions,
    stages: StagesOptions,
    calibrate: CalibrateOptions,
    align: AlignOptions,
    targets: TargetsOptions,
    dem: DemOptions,
    surface: SurfaceOptions,
    ortho: OrthoOptions,
    segment: SegmentOptions,
    leaf_density: LeafDensityOptions,
    leaf_count: LeafCountOptions,
    locate: LocateOptions,
    leaves: LeavesOptions,
    layout: LayoutOptions,
    plots: PlotsOptions,
    crops: CropsOptions,
    evaluate: EvaluateOptions,
    checks: ChecksOptions,
}

type Entries = BTreeMap<Spanned<String>, BTreeMap<Spanned<String>, Spanned<Value>>>;

impl Config {
    /// The settings of a folder: its `rowgram.toml` where there is one, defaults elsewhere.
    ///
    /// # Errors
    /// As [`Config::read`].
    pub fn of_folder(root: &Path) -> Result<Config, Error> {
        Config::read(root, std::iter::empty(), &[])
    }

    /// The file of the folder where there is one, then the environment, then `settings` (`section.key=value`).
    ///
    /// # Errors
    /// A file that is no TOML; a section, key or value that does not belong there, with line or name, and what was
    /// expected.
    pub fn read(
        root: &Path,
        environment: impl Iterator<Item = (String, String)>,
        settings: &[String],
    ) -> Result<Config, Error> {
        let sections = Config::sections();
        let mut table = from_file(&root.join(NAME), &sections)?;
        let mut variables: Vec<(String, String)> = environment
            .filter(|(name, _)| name.starts_with(PREFIX))
            .filter(|(name, _)| !OTHER_VARIABLES.contains(&name.as_str()))
            .collect();
        variables.sort();
        for (name, text) in variables {
            let (section, key) = of_variable(&name, &sections)?;
            set(&mut table, &sections, (&section, &key), &text)
                .map_err(|why| Error::Argument(format!("environment variable {name}: {why}")))?;
        }
        for setting in settings {
            let (name, text) = setting.split_once('=').ok_or_else(|| {
                Error::Argument(format!(
                    "--set {setting}: expected section.key=value, as in --set align.seed=2"
                ))
            })?;
            let (section, key) = name.trim().split_once('.').ok_or_else(|| {
                Error::Argument(format!(
                    "--set {setting}: expected section.key=value, as in --set align.seed=2"
                ))
            })?;
            set(&mut table, &sections, (section.trim(), key.trim()), text)
                .map_err(|why| Error::Argument(format!("--set {setting}: {why}")))?;
        }
        let config: Config = Value::Table(table)
            .try_into()
            .map_err(|e: toml::de::Error| Error::Argument(e.to_string()))?;
        config.validate()?;
        config.project.check_files(root)?;
        Ok(config)
    }

    /// The settings as a file, every key that is set.
    pub fn to_toml(&self) -> String {
        toml::to_string(self).unwrap_or_default()
    }

    /// The file that `rowgram init` writes: the main options, or with `for_experts` all of them, each with its default, its
    /// limits and what it means.
    pub fn template(for_experts: bool) -> String {
        let mut text = commented(&format!(
            "Settings of rowgram: {}, each with its default; one behind \"# \" is not set. Paths are relative to this folder. \
             The same names come from the environment (ROWGRAM_ALIGN_SEED=2) and from arguments (--set align.seed=2); \
             arguments come before the environment, the environment before this file.",
            if for_experts {
                "all options"
            } else {
                "the main options (rowgram init --experts writes all)"
            }
        ));
        for section in Config::sections() {
            let fields = section.by_rank(for_experts);
            for (name, about, table) in headings(&section) {
                let own = fields.iter().filter(|field| field.table == table);
                let own: Vec<&Field> = own.copied().collect();
                if !own.is_empty() {
                    let _ = write!(text, "\n{}[{name}]\n", commented(&one_line(about)));
                    own.into_iter().for_each(|field| entry(&mut text, field));
                }
            }
        }
        text
    }
}

/// The tables of a section in the file: their names, what they are about, and which of the nested tables each is.
pub(super) fn headings(section: &Section) -> Vec<(String, &'static str, Option<&'static str>)> {
    let nested = section.tables.iter();
    let nested =
        nested.map(|(table, about)| (format!("{}.{table}", section.name), *about, Some(*table)));
    [(section.name.to_owned(), section.about, None)].into_iter().chain(nested).collect()
}

/// An option as the template has it.
fn entry(text: &mut String, field: &Field) {
    let rank = if field.is_main { "" } else { "For experts: " };
    let what = format!("{rank}{} Expected: {}.", field.paragraph(), field.expected());
    *text += &commented(&what);
    let _ = match (&field.default, field.example) {
        (Some(value), _) => writeln!(text, "{} = {value}", field.name),
        (None, Some(example)) => writeln!(text, "# {} = {example}", field.name),
        (None, None) => writeln!(text, "# {} =", field.name),
    };
}

pub(super) fn one_line(text: &str) -> String {
    text.split_whitespace().collect::<Vec<_>>().join(" ")
}

/// Lines of a comment, at most 110 characters each.
fn commented(text: &str) -> String {
    const WIDTH: usize = 110;
    let mut lines = vec!["#".to_owned()];
    for word in text.split_whitespace() {
        if lines.last().is_some_and(|line| line.len() + 1 + word.len() > WIDTH) {
            lines.push("#".to_owned());
        }
        if let Some(line) = lines.last_mut() {
            *line += " ";
            *line += word;
        }
    }
    lines.join("\n") + "\n"
}

/// What a settings file says, each entry checked; nothing where there is no file.
fn from_file(path: &Path, sections: &[Section]) -> Result<Table, Error> {
    let text = match std::fs::read(path) {
        Ok(bytes) => rowgram_files::decode(bytes),
        Err(e) if e.kind() == std::io::ErrorKind::NotFound => return Ok(Table::new()),
        Err(e) if e.kind() == std::io::ErrorKind::NotADirectory => {
            let message = "it is a file, expected the folder of a project";
            return Err(FileError::malformed(output::folder_of(path), None, message).into());
        }
        Err(e) => return Err(FileError::read(path, e).into()),
    };
    let at = |span: std::ops::Range<usize>| 1 + text[..span.start].matches('\n').count();
    let entries: Entries = toml::from_str(&text).map_err(|e| {
        let line = e.span().map(at);
        // A key above all sections has no section that could take it.
        let top: Table = text.parse().unwrap_or_default();
        let loose = top.into_iter().find(|(_, value)| !value.is_table());
        let of_line = line.and_then(|line| text.lines().nth(line - 1)).unwrap_or_default();
        let is_path = of_line.contains('\\') && of_line.contains('"');
        let remedy = if is_path { "; write paths with / or in single quotes" } else { "" };
        let message = loose.map_or_else(
            || format!("{}{remedy}", e.message()),
            |(key, _)| {
                format!("{key}: expected a section such as [align] or [plots] above the keys")
            },
        );
        FileError::malformed(path, line, message)
    })?;
    let mut table = Table::new();
    for (name, keys) in entries {
        let refused = |why: String| FileError::malformed(path, at(name.span()), why);
        let section = find(sections, name.get_ref()).map_err(refused)?;
        let mut known = Table::new();
        for (key, value) in keys {
            let refused = |why: String| FileError::malformed(path, at(key.span()), why);
            let (name, value) = (key.get_ref(), value.into_inner());
            section.check_entry(name, &value).map_err(refused)?;
            section.check_table(name, None).map_err(refused)?;
            section.insert(&mut known, name, value);
        }
        table.insert(section.name.to_owned(), Value::Table(known));
    }
    Ok(table)
}

fn find<'a>(sections: &'a [Section], name: &str) -> Result<&'a Section, String> {
    let names: Vec<&str> = sections.iter().map(|section| section.name).collect();
    sections.iter().find(|section| section.name == name).ok_or_else(|| {
        match nearest(name, &names) {
            Some(near) => format!("[{name}]: there is no such section; did you mean [{near}]?"),
            None => format!("[{name}]: there is no such section; there are {}", names.join(", ")),
        }
    })
}

/// Sets a value from the words of a command line.
fn set(
    table: &mut Table,
    sections: &[Section],
    (name, key): (&str, &str),
    text: &str,
) -> Result<(), String> {
    let section = find(sections, name)?;
    let within = |table: &str| key.strip_prefix(table).and_then(|key| key.strip_prefix('.'));
    let in_table = section.tables.iter().find_map(|(table, _)| Some((*table, within(table)?)));
    let (table_of, key) = in_table.map_or((None, key), |(table, key)| (Some(table), key));
    let value = match section.field(key) {
        Some(field) => field.kind.read(text),
        None => Value::String(text.to_owned()),
    };
    section.check_entry(key, &value)?;
    section.check_table(key, table_of)?;
    let entry = table.entry(name).or_insert_with(|| Value::Table(Table::new()));
    if let Value::Table(entry) = entry {
        section.insert(entry, key, value);
    }
    Ok(())
}

/// Section and key of an environment variable.
fn of_variable(name: &str, sections: &[Section]) -> Result<(String, String), Error> {
    let known: Vec<(String, &Section, String)> = sections
        .iter()
        .flat_map(|section| {
            section.fields.iter().map(move |field| {
                let key = match field.table {
                    Some(table) => format!("{table}.{}", field.name),
                    None => field.name.to_owned(),
                };
                let variable = format!("{PREFIX}{}_{}", section.name, key.replace('.', "_"));
                (variable.to_uppercase(), section, key)
            })
        })
        .collect();
    if let Some((_, section, key)) = known.iter().find(|(variable, ..)| variable == name) {
        return Ok((section.name.to_owned(), key.clone()));
    }
    // All begin alike, which makes none of them likelier.
    let own = |name: &'_ str| name.strip_prefix(PREFIX).unwrap_or_default().to_owned();
    let names: Vec<String> = known.iter().map(|(variable, ..)| own(variable)).collect();
    let names: Vec<&str> = names.iter().map(String::as_str).collect();
    let near = nearest(&own(name), &names);
    let hint = near.map_or_else(String::new, |near| format!("; did you mean {PREFIX}{near}?"));
    Err(Error::Argument(format!("environment variable {name}: there is no such setting{hint}")))
}

#[cfg(test)]
mod tests {
    use super::*;
    use rowgram_base::options::Kind;

    #[test]
    fn the_reference_page_is_what_is_defined() {
        let path = Path::new(env!("CARGO_MANIFEST_DIR")).join("../../docs/options.md");
        let page = std::fs::read_to_string(path).unwrap_or_default();
        assert_eq!(
            page,
            super::super::options_page::reference_page(),
            "cargo run -p experiments -- pages"
        );
    }

    fn read(file: &str, variables: &[(&str, &str)], settings: &[&str]) -> Result<Config, String> {
        let folder = tempfile::tempdir().unwrap();
        std::fs::write(folder.path().join(NAME), file).unwrap();
        // The files that the examples name.
        std::fs::create_dir(folder.path().join("truth")).unwrap();
        for field in ProjectOptions::fields().iter().filter(|field| field.kind == Kind::Path) {
            let path = field.example.unwrap().trim_matches('"');
            std::fs::write(folder.path().join(path), "").unwrap();
        }
        let variables = variables.iter().map(|(a, b)| ((*a).to_owned(), (*b).to_owned()));
        let settings: Vec<String> = settings.iter().map(|text| (*text).to_owned()).collect();
        Config::read(folder.path(), variables, &settings).map_err(|error| error.to_string())
    }

    #[test]
    fn the_template_says_every_default_and_every_key() {
        let template = Config::template(true);
        assert_eq!(read(&template, &[], &[]).unwrap(), Config::default());
        // Keys that are not set are known too, and their examples are within their limits.
        let set: String = template
            .lines()
            .map(|line| match line.strip_prefix("# ") {
                Some(rest) if rest.split_once(" = ").is_some_and(|(k, _)| !k.contains(' ')) => rest,
                _ => line,
            })
            .map(|line| format!("{line}\n"))
            .collect();
        let table: Table = set.parse().unwrap();
        for section in Config::sections() {
            for field in &section.fields {
                let own = &table[section.name];
                let written = field.table.map_or(own, |table| &own[table]).get(field.name);
                let written = written.unwrap_or_else(|| panic!("{} lacks an example", field.name));
                section.check_entry(field.name, written).unwrap();
            }
        }
        assert!(template.lines().all(|line| line.chars().count() <= 110));
        let short = Config::template(false);
        assert_eq!(read(&short, &[], &[]).unwrap(), Config::default());
        let fields = Config::sections().into_iter().flat_map(|section| section.fields);
        let main = fields.filter(|field| field.is_main).count();
        assert!((20..=40).contains(&main), "{main} main options");
        assert_eq!(short.matches("Expected: ").count(), main);
    }

    #[test]
    fn a_file_is_no_project() {
        let folder = tempfile::tempdir().unwrap();
        let path = folder.path().join("ortho.tif");
        std::fs::write(&path, "").unwrap();
        let error = Config::of_folder(&path).unwrap_err().to_string();
        assert!(error.contains("ortho.tif: it is a file, expected the folder"), "{error}");
    }

    #[test]
    fn file_then_environment_then_arguments() {
        let file = "[align]\nseed = 2\n[ortho]\ngsd_m = 0.5\ncanopy_height_m = 0\n";
        let variables =
            [("ROWGRAM_ALIGN_SEED", "3"), ("ROWGRAM_ORTHO_GSD_M", "0.25"), ("PATH", "")];
        let settings = [
            "align.seed=4",
            "project.crs=EPSG:32616",
            "align.check=T3,T7",
            "locate.method=descent",
            "locate.paper.starts=3",
        ];
        let config = read(file, &variables, &settings).unwrap();
        assert_eq!(config.align.seed, 4);
        assert_eq!(config.align.check, ["T3", "T7"]);
        assert_eq!(config.locate.paper.starts, 3);
        assert_eq!(config.ortho.gsd_m, Some(0.25));
        assert_eq!(config.ortho.canopy_height_m, rowgram_base::options::Auto::Given(0.0));
        assert_eq!(config.project.crs.as_deref(), Some("EPSG:32616"));
        assert_eq!(toml::from_str::<Config>(&config.to_toml()).unwrap(), config);
    }

    #[test]
    fn nonsense_is_refused_where_it_stands() {
        for (file, expected) in [
            ("[align]\nsede = 2\n", "line 2: sede: there is no such option; did you mean seed?"),
            ("[align]\nseed = \"two\"\n", "line 2: seed = \"two\": expected a whole number"),
            ("[align\n", "line 1"),
            ("plants = 3\n", "line 1: plants: expected a section"),
            (
                "[algin]\nseed = 2\n",
                "line 1: [algin]: there is no such section; did you mean [align]?",
            ),
            ("[ortho]\ngsd_m = -0.01\n", "line 2: gsd_m = -0.01: expected a number greater than 0"),
            (
                "[locate]\nmethod = \"magic\"\n",
                "line 2: method = \"magic\": expected one of: row-model",
            ),
            ("[locate]\nprior = \"rows\"\n", "line 2: prior: it belongs into [locate.paper]"),
            (
                "[locate.paper]\nprier = \"rows\"\n",
                "line 1: prier: there is no such option; did you mean prior?",
            ),
            (
                "[stages]\nskip = [\"grow\"]\n",
                "line 2: skip = [\"grow\"]: expected a list of: calibrate",
            ),
        ] {
            let error = read(file, &[], &[]).unwrap_err();
            assert!(error.contains(expected) && error.contains(NAME), "{error}");
        }
        for (settings, expected) in [
            ("seed=1", "--set seed=1: expected section.key=value"),
            ("align.seed", "--set align.seed: expected section.key=value"),
            ("align.sede=1", "did you mean seed?"),
            ("align.seed=two", "--set align.seed=two: seed = \"two\": expected a whole number"),
        ] {
            let error = read("", &[], &[settings]).unwrap_err();
            assert!(error.contains(expected), "{error}");
        }
        let error = read("", &[("ROWGRAM_ALIGN_SEEED", "2")], &[]).unwrap_err();
        assert!(error.contains("did you mean ROWGRAM_ALIGN_SEED?"), "{error}");
        let error = read("", &[("ROWGRAM_FOO", "2")], &[]).unwrap_err();
        assert!(!error.contains("did you mean"), "{error}");
        for (file, expected) in [
            ("[plots]\nrows_per_plot = 4\n", "[plots] alley_m is not set"),
            (
                "[checks]\ncheck_points_yellow_gsd = 9\n",
                "[checks] check_points_yellow_gsd = 9: expected at most",
            ),
            (
                "[project]\ntruth = \"a.csv\"\n",
                "[project] truth = \"a.csv\": there is no such file",
            ),
        ] {
            let error = read(file, &[], &[]).unwrap_err();
            assert!(error.contains(expected), "{error}");
        }
        let error = read("", &[("ROWGRAM_ALIGN_SEED", "two")], &[]).unwrap_err();
        assert!(error.contains("environment variable ROWGRAM_ALIGN_SEED: seed"), "{error}");
    }
}
