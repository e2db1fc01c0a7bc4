//! Arguments made from the definitions of options, so that nothing is defined twice.

use clap::{Arg, ArgMatches, Command};
use rowgram_base::{
    error::Error,
    options::{Auto, Field, Kind, Options},
};
use rowgram_project::Config;
use rowgram_raster::mask::Thresholds;
use std::marker::PhantomData;

/// Those options that the command line gives.
#[derive(Debug, Clone)]
pub(super) struct Given<T> {
    table: toml::Table,
    of: PhantomData<T>,
}

impl<T: Options> Given<T> {
    /// These options, with the ones that were given in their places.
    ///
    /// # Errors
    /// A value that the option cannot have: what was expected.
    pub(super) fn over(&self, base: &T) -> Result<T, Error> {
        base.with(&self.table).map_err(|why| Error::Argument(format!("--{}", dashed(&why))))
    }

    /// Defaults, with the options that were given in their places.
    ///
    /// # Errors
    /// As [`Given::over`].
    pub(super) fn over_defaults(&self) -> Result<T, Error> {
        self.over(&T::default())
    }

    /// Whether an option was given.
    pub(super) fn has(&self, name: &str) -> bool {
        self.table.contains_key(name)
    }
}

/// `tolerance_px = -1: expected ...` as it was typed: `tolerance-px -1: expected ...`.
fn dashed(why: &str) -> String {
    match why.split_once(" = ") {
        Some((name, rest)) => format!("{} {rest}", name.replace('_', "-")),
        None => why.to_owned(),
    }
}

/// Endings of names that tell the unit; `--gsd` is understood as `--gsd-m`.
const UNIT_ENDINGS: [&str; 6] = ["-m-s", "-px", "-m", "-deg", "-s", "-rad"];

fn argument<T: Options>(field: &Field) -> Arg {
    let flag = field.flag();
    let mut help = field.paragraph();
    match (&field.default, &field.kind) {
        (_, Kind::Flag) | (None, _) => {}
        (Some(toml::Value::Array(values)), _) if values.is_empty() => {}
        (Some(value), _) => help += &format!(" [default: {}]", plain(value)),
    }
    let mut arg = Arg::new(field.name)
        .long(flag.clone())
        .help(help)
        .value_name(field.kind.placeholder(field.unit()))
        .allow_hyphen_values(true)
        .hide_short_help(is_for_experts::<T>(field))
        .help_heading(heading::<T>(field));
    if let Some(short) = UNIT_ENDINGS.iter().find_map(|ending| flag.strip_suffix(ending)) {
        arg = arg.alias(short.to_owned());
    }
    if field.kind == Kind::Flag {
        arg = arg.num_args(0..=1).require_equals(true).default_missing_value("true");
    }
    arg
}

fn is_section<T: Options>() -> bool {
    Config::sections().iter().any(|section| section.name == T::SECTION)
}

/// Only `--help` shows these, not `-h`.
fn is_for_experts<T: Options>(field: &Field) -> bool {
    is_section::<T>() && !field.is_main
}

fn heading<T: Options>(field: &Field) -> String {
    match (is_section::<T>(), field.is_main) {
        (false, _) => "Options".to_owned(),
        (true, true) => format!("Options of [{}] in rowgram.toml", T::SECTION),
        (true, false) => format!("Options of [{}] for experts", T::SECTION),
    }
}

fn plain(value: &toml::Value) -> String {
    match value {
        toml::Value::String(text) => text.clone(),
        toml::Value::Array(values) => values.iter().map(plain).collect::<Vec<_>>().join(","),
        other => other.to_string(),
    }
}

fn absolute(path: String) -> String {
    std::path::absolute(&path).map_or(path, |path| path.to_string_lossy().into_owned())
}

impl<T: Options> clap::Args for Given<T> {
    fn augment_args(command: Command) -> Command {
        T::fields().iter().fold(command, |command, field| command.arg(argument::<T>(field)))
    }

    fn augment_args_for_update(command: Command) -> Command {
        Given::<T>::augment_args(command)
    }
}

impl<T: Options> clap::FromArgMatches for Given<T> {
    fn from_arg_matches(matches: &ArgMatches) -> Result<Given<T>, clap::Error> {
        let mut given = Given { table: toml::Table::new(), of: PhantomData };
        given.update_from_arg_matches(matches)?;
        Ok(given)
    }

    fn update_from_arg_matches(&mut self, matches: &ArgMatches) -> Result<(), clap::Error> {
        for field in T::fields() {
            if let Some(text) = matches.get_one::<String>(field.name) {
                let value = match (&field.kind, field.kind.read(text)) {
                    // In a project's settings paths are relative to the project, here to where the command is typed.
                    (Kind::Path, toml::Value::String(path)) => toml::Value::String(absolute(path)),
                    (_, value) => value,
                };
                self.table.insert(field.name.to_owned(), value);
            }
        }
        Ok(())
    }
}

rowgram_base::options! {
    /// The option `hsv` of `segment`, for the commands that make the leaf mask of a photo themselves.
    pub(super) struct HsvOptions in "segment", main [hsv] {
        /// How leaf pixels are recognised: auto estimates vegetation from the picture itself, by NDVI where it has a near-infrared band; or thresholds in
        /// 8-bit HSV: hue from, hue to (0 to 180), minimum saturation, minimum value (0 to 255), as 30,79,30,163
        /// (the paper's, for June).
        pub hsv: Auto<Thresholds> = Auto::Auto, limits between(0.0, 255.0);
    }
}

#[cfg(test)]
mod tests {
    use super::*;
    use clap::{CommandFactory, FromArgMatches};
    use rowgram_project::{self as project, Task, stage};
    use std::process;

    /// Values of a kind that are awkward to write on a command line.
    fn values(kind: &Kind) -> Vec<toml::Value> {
        let text = |all: &[&str]| all.iter().map(|&text| text.into()).collect::<Vec<_>>();
        match kind {
            Kind::Flag => vec![true.into(), false.into()],
            Kind::Whole => [1, 2, 7, 101, 300].map(toml::Value::from).to_vec(),
            Kind::Number => [-2.5, 0.125, 0.5, 1.5, 33.0, 1e-7].map(toml::Value::from).to_vec(),
            Kind::Text | Kind::Path => text(&["it's, \"5\" $HOME", "'quoted'", "-x", "3", "true"]),
            Kind::Words(words) => words.iter().map(|word| word.as_str().into()).collect(),
            Kind::AutoOr(kind) => [text(&["auto"]), values(kind)].concat(),
            Kind::List(kind) => {
                let all = values(kind);
                let single = all.iter().map(|value| toml::Value::Array(vec![value.clone()]));
                single
                    .chain([toml::Value::Array(all.clone()), toml::Value::Array(vec![])])
                    .collect()
            }
            Kind::Several(kind, count) => {
                let all = values(kind);
                let rising: Vec<_> = all.iter().cycle().take(*count).cloned().collect();
                let same = all.iter().map(|value| vec![value.clone(); *count]);
                same.chain([rising]).map(toml::Value::Array).collect()
            }
        }
    }

    /// The words that a shell makes of a command.
    fn words(command: &str) -> Vec<String> {
        let script = format!("printf '%s\\0' {command}");
        let output = process::Command::new("sh").args(["-c", &script]).output().unwrap();
        let text = String::from_utf8(output.stdout).unwrap();
        text.split_terminator('\0').map(str::to_owned).collect()
    }

    fn every_option_comes_back<T: Task>() {
        let mut checked = 0;
        for field in T::Options::fields() {
            for value in values(&field.kind) {
                let table = toml::Table::from_iter([(field.name.to_owned(), value)]);
                let Ok(options) = T::Options::default().with(&table) else { continue };
                let command = stage::command::<T>(&options);
                let matches = super::super::Cli::command().try_get_matches_from(words(&command));
                let matches = matches.unwrap_or_else(|e| panic!("{command}: {e}"));
                let (mut names, mut matches) = (Vec::new(), &matches);
                while let Some((name, own)) = matches.subcommand() {
                    names.push(name);
                    matches = own;
                }
                assert_eq!(names.join(" "), T::STAGE.command());
                let given = Given::<T::Options>::from_arg_matches(matches).unwrap();
                // Paths are made absolute, for a project is worked on from anywhere.
                if field.kind != Kind::Path {
                    assert!(given.over_defaults().unwrap() == options, "{command}");
                }
                checked += 1;
            }
        }
        assert!(checked > 0 || T::Options::fields().is_empty(), "{}", T::STAGE);
    }

    #[test]
    #[cfg(unix)]
    fn the_commands_of_reports_and_plans_are_understood() {
        every_option_comes_back::<project::calibrate::Calibrate>();
        every_option_comes_back::<project::align::AlignTask>();
        every_option_comes_back::<project::dem::DemTask>();
        every_option_comes_back::<project::surface::SurfaceTask>();
        every_option_comes_back::<project::ortho::OrthoTask>();
        every_option_comes_back::<project::segment::Segment>();
        every_option_comes_back::<project::leaf_density::LeafDensity>();
        every_option_comes_back::<project::leaf_count::LeafCountStage>();
        every_option_comes_back::<project::locate::Locate>();
        every_option_comes_back::<project::leaves::LeavesStage>();
        every_option_comes_back::<project::plots::Plots>();
        every_option_comes_back::<project::evaluate::Evaluate>();
    }
}
