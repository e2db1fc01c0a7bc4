//! Arguments made from the definitions of options, so that nothing is defined twice.

use clap::{Arg, ArgMatches, Command};
use rowgram_base::{
    error::Error,
    options::{Auto, Kind, Options},
};
use rowgram_project::{Config, segment::SegmentOptions};
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

fn argument<T: Options>(field: &rowgram_base::options::Field) -> Arg {
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
        .help_heading(heading::<T>());
    if let Some(short) = UNIT_ENDINGS.iter().find_map(|ending| flag.strip_suffix(ending)) {
        arg = arg.alias(short.to_owned());
    }
    if field.kind == Kind::Flag {
        arg = arg.num_args(0..=1).require_equals(true).default_missing_value("true");
    }
    arg
}

fn heading<T: Options>() -> String {
    let is_section = Config::sections().iter().any(|section| section.name == T::SECTION);
    if is_section {
        format!("Options of [{}] in rowgram.toml", T::SECTION)
    } else {
        "Options".to_owned()
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

/// The option `hsv` of `segment`, for the commands that make the leaf mask of a photo themselves.
#[derive(Debug, Clone)]
pub(super) struct HsvArgument(Given<SegmentOptions>);

/// Its name.
const HSV: &str = "hsv";

impl HsvArgument {
    /// Whether it was given.
    pub(super) fn is_given(&self) -> bool {
        self.0.has(HSV)
    }

    /// The thresholds.
    ///
    /// # Errors
    /// Thresholds that cannot be.
    pub(super) fn value(&self) -> Result<Auto<Thresholds>, Error> {
        Ok(self.0.over_defaults()?.hsv)
    }
}

impl clap::Args for HsvArgument {
    fn augment_args(command: Command) -> Command {
        let fields = SegmentOptions::fields();
        let hsv = fields.iter().filter(|field| field.name == HSV);
        hsv.fold(command, |command, field| command.arg(argument::<SegmentOptions>(field)))
    }

    fn augment_args_for_update(command: Command) -> Command {
        HsvArgument::augment_args(command)
    }
}

impl clap::FromArgMatches for HsvArgument {
    fn from_arg_matches(matches: &ArgMatches) -> Result<HsvArgument, clap::Error> {
        let mut given = Given { table: toml::Table::new(), of: PhantomData };
        if let Some(text) = matches.get_one::<String>(HSV) {
            let hsv = SegmentOptions::fields().into_iter().find(|field| field.name == HSV);
            given.table.extend(hsv.map(|field| (HSV.to_owned(), field.kind.read(text))));
        }
        Ok(HsvArgument(given))
    }

    fn update_from_arg_matches(&mut self, matches: &ArgMatches) -> Result<(), clap::Error> {
        *self = HsvArgument::from_arg_matches(matches)?;
        Ok(())
    }
}
