//! Options, each defined once: name, documentation, kind of value, limits and default in one place.
//!
//! [`options!`](crate::options!) defines a serde struct. From its definition come the section of `rowgram.toml`, the
//! `--help` and the arguments of the program, and the checks: a name that does not exist is refused with the nearest
//! one, a value that cannot be is refused with what was expected. A name carries its unit (`gsd_m`, `tolerance_px`).

mod engines;
mod field;
mod value;

pub use field::{Field, Limits, Section, nearest};
pub use value::{Auto, Choice, Kind, Value};

use serde::{Serialize, de::DeserializeOwned};

/// A set of options with defaults.
pub trait Options: Default + Clone + PartialEq + Serialize + DeserializeOwned {
    /// Name of its section in `rowgram.toml`.
    const SECTION: &'static str;
    /// What the section is about, one or more sentences.
    const ABOUT: &'static str;

    /// The options in their order.
    fn fields() -> Vec<Field>;

    /// Its nested tables with what they are about.
    fn tables() -> Vec<(&'static str, &'static str)> {
        Vec::new()
    }

    /// The definition for listings and checks.
    fn section() -> Section {
        Section {
            name: Self::SECTION,
            about: Self::ABOUT,
            fields: Self::fields(),
            tables: Self::tables(),
            check: |table| {
                let parsed: Result<Self, toml::de::Error> =
                    toml::Value::Table(table.clone()).try_into();
                parsed.map(drop).map_err(|error| error.message().to_owned())
            },
        }
    }

    /// These options with some of them replaced.
    ///
    /// # Errors
    /// A name that does not exist, and a value that the option cannot have: what was expected.
    fn with(&self, given: &toml::Table) -> Result<Self, String> {
        let section = Self::section();
        for (name, value) in given {
            section.check_entry(name, value)?;
        }
        let mut table = toml::Table::try_from(self).map_err(|error| error.to_string())?;
        for (name, value) in given {
            section.insert(&mut table, name, value.clone());
        }
        toml::Value::Table(table).try_into().map_err(|e: toml::de::Error| e.message().to_owned())
    }

    /// Whether every value is within its limits, and all of them go together.
    ///
    /// # Errors
    /// The first option that is not, and what was expected.
    fn validate(&self) -> Result<(), String> {
        let table = toml::Table::try_from(self).map_err(|error| error.to_string())?;
        let section = Self::section();
        table.iter().try_for_each(|(name, value)| section.check_entry(name, value))?;
        self.check_together()
    }

    /// Whether values go together that are within their limits one by one.
    ///
    /// # Errors
    /// Which do not, and what was expected.
    fn check_together(&self) -> Result<(), String> {
        Ok(())
    }

    /// The options that differ from their defaults, as `(name, value)`.
    fn changed(&self) -> Vec<(String, toml::Value)> {
        let flat = |options: &Self| {
            let table = toml::Table::try_from(options).unwrap_or_default();
            let mut flat = toml::Table::new();
            for (name, value) in table {
                match value {
                    toml::Value::Table(nested) => flat.extend(nested),
                    value => drop(flat.insert(name, value)),
                }
            }
            flat
        };
        let (own, usual) = (flat(self), flat(&Self::default()));
        own.into_iter().filter(|(name, value)| usual.get(name) != Some(value)).collect()
    }
}

/// Defines a set of [`Options`](crate::options::Options). `main [cell_m]` names those that most people need to know; the others are
/// for experts, and listed after them. Where values have to go together (both or neither, the first
/// not above the second), `in "dem", together checked` names a function `fn(&DemOptions) -> Result<(), String>`.
///
/// `in "dem" with { points: PointOptions, }` adds the options of another set to the same section: one list in the file
/// and on the command line, a field of its own in the struct.
///
/// ```
/// rowgram_base::options! {
///     /// The surface.
///     pub struct DemOptions in "dem", main [cell_m] {
///         /// Side of a cell; half the median distance of neighbouring points where not set.
///         pub cell_m: Option<f64> = None, limits POSITIVE, example "0.1";
///         /// Points farther from their neighbours' plane than this many usual distances are left out.
///         pub outlier_ratio: f64 = 5.0, limits POSITIVE;
///     }
/// }
/// use rowgram_base::options::Options;
/// let given: toml::Table = "cell_m = -1.0".parse().unwrap();
/// assert_eq!(
///     DemOptions::default().with(&given).unwrap_err(),
///     "cell_m = -1.0: expected a number greater than 0, in metres"
/// );
/// ```
#[macro_export]
macro_rules! options {
    (
        $(#[doc = $about:expr])*
        $vis:vis struct $name:ident in $section:literal
            $(with { $($(#[doc = $group_doc:expr])* $gvis:vis $group:ident: $group_kind:ty,)* })?
            $(nested { $($(#[doc = $nested_doc:expr])* $nvis:vis $nested:ident: $nested_kind:ty,)* })?
            $(, together $together:path)?
            $(, main [$($main:ident),* $(,)?])?
        {
            $(
                $(#[doc = $doc:expr])*
                $fvis:vis $key:ident: $kind:ty = $default:expr
                    $(, limits $limits:ident $(($($bound:expr),*))?)? $(, example $example:literal)?;
            )*
        }
    ) => {
        $(#[doc = $about])*
        #[derive(Debug, Clone, PartialEq, serde::Serialize, serde::Deserialize)]
        #[serde(deny_unknown_fields, default)]
        $vis struct $name {
            $(
                $(#[doc = $doc])*
                $fvis $key: $kind,
            )*
            $($(
                $(#[doc = $group_doc])*
                #[serde(flatten)]
                $gvis $group: $group_kind,
            )*)?
            $($(
                $(#[doc = $nested_doc])*
                $nvis $nested: $nested_kind,
            )*)?
        }

        $(
            // The main options are options.
            const _: fn(&$name) = |options| { $(let _ = &options.$main;)* };
        )?

        impl Default for $name {
            fn default() -> $name {
                $name {
                    $($key: $default,)*
                    $($($group: <$group_kind>::default(),)*)?
                    $($($nested: <$nested_kind>::default(),)*)?
                }
            }
        }

        impl $crate::options::Options for $name {
            const SECTION: &'static str = $section;
            const ABOUT: &'static str = concat!($($about, "\n"),*);

            fn fields() -> Vec<$crate::options::Field> {
                let defaults = $name::default();
                let main: &[&str] = &[$($(stringify!($main)),*)?];
                let own: Vec<$crate::options::Field> = vec![$(
                    $crate::options::Field {
                        name: stringify!($key),
                        doc: concat!($($doc, "\n"),*),
                        kind: <$kind as $crate::options::Value>::kind(),
                        limits: $crate::options!(@limits $($limits $(($($bound),*))?)?),
                        default: $crate::options::Value::written(&defaults.$key),
                        example: $crate::options!(@example $($example)?),
                        is_main: false,
                        table: None,
                    },
                )*];
                let groups: Vec<Vec<$crate::options::Field>> =
                    vec![$($(<$group_kind as $crate::options::Options>::fields(),)*)?];
                let marked = own.into_iter().map(|field| {
                    $crate::options::Field { is_main: main.contains(&field.name), ..field }
                });
                let nested: Vec<(&'static str, Vec<$crate::options::Field>)> = vec![$($(
                    (stringify!($nested), <$nested_kind as $crate::options::Options>::fields()),
                )*)?];
                let nested = nested.into_iter().flat_map(|(table, fields)| {
                    fields.into_iter().map(move |field| {
                        $crate::options::Field { table: Some(table), is_main: false, ..field }
                    })
                });
                marked.chain(groups.into_iter().flatten()).chain(nested).collect()
            }

            $(
                fn tables() -> Vec<(&'static str, &'static str)> {
                    vec![$((
                        stringify!($nested),
                        <$nested_kind as $crate::options::Options>::ABOUT,
                    )),*]
                }
            )?

            $(
                fn check_together(&self) -> Result<(), String> {
                    $together(self)
                }
            )?
        }
    };
    (@limits) => { $crate::options::Limits::NONE };
    (@limits $limits:ident) => { $crate::options::Limits::$limits };
    (@limits $limits:ident ($($bound:expr),*)) => { $crate::options::Limits::$limits($($bound),*) };
    (@example) => { None };
    (@example $example:literal) => { Some($example) };
}

/// Tells options the words of an enum that serde spells: `choices!(Solver: Auto, TwoPoint, FivePoint);`
#[macro_export]
macro_rules! choices {
    ($name:ty: $($variant:ident),* $(,)?) => {
        impl $crate::options::Choice for $name {
            fn all() -> Vec<Self> {
                vec![$(<$name>::$variant),*]
            }
        }
        $crate::option_value_of_choice!($name);
    };
}

/// The part of [`choices!`] that makes an enum a value.
#[doc(hidden)]
#[macro_export]
macro_rules! option_value_of_choice {
    ($name:ty) => {
        impl $crate::options::Value for $name {
            fn kind() -> $crate::options::Kind {
                $crate::options::Kind::Words(
                    <$name as $crate::options::Choice>::all()
                        .iter()
                        .map($crate::options::Choice::word)
                        .collect(),
                )
            }
        }
        impl std::fmt::Display for $name {
            fn fmt(&self, f: &mut std::fmt::Formatter<'_>) -> std::fmt::Result {
                f.write_str(&$crate::options::Choice::word(self))
            }
        }
        impl std::str::FromStr for $name {
            type Err = String;
            fn from_str(text: &str) -> Result<Self, String> {
                $crate::options::Choice::read(text)
            }
        }
    };
}

#[cfg(test)]
mod tests {
    use super::*;
    use serde::Deserialize;

    #[derive(Debug, Clone, Copy, PartialEq, Serialize, Deserialize)]
    #[serde(rename_all = "kebab-case")]
    enum Solver {
        Auto,
        TwoPoint,
    }
    choices!(Solver: Auto, TwoPoint);

    crate::options! {
        /// How the surface is cut.
        struct Cut in "trial" {
            /// Longest side.
            side_m: f64 = 2.0, limits POSITIVE;
            /// Solver of its own.
            cut_solver: Option<Solver> = None, example "\"auto\"";
        }
    }

    crate::options! {
        /// From photos to a block.
        struct Trial in "trial" with {
            /// The cut.
            cut: Cut,
        } {
            /// Seed of all random sampling.
            seed: u64 = 1;
            /// Minimal solver.
            solver: Solver = Solver::Auto;
            /// Distance from its point up to which a measurement is used.
            tolerance_px: f64 = 4.0, limits POSITIVE;
            /// Side of a cell.
            cell_m: Option<f64> = None, limits POSITIVE, example "0.1";
            /// Thresholds.
            hsv: Auto<[u16; 4]> = Auto::Auto, limits between(0.0, 255.0);
            /// Side of the neighbourhood.
            window_px: usize = 41, limits ODD;
            /// Names.
            check: Vec<String> = Vec::new(), example "[\"T3\"]";
            /// Blend.
            balance: bool = false;
        }
    }

    fn with(text: &str) -> Result<Trial, String> {
        Trial::default().with(&text.parse().unwrap())
    }

    #[test]
    fn values_replace_defaults() {
        let found =
            with("seed = 7\nsolver = \"two-point\"\nhsv = [30, 79, 30, 163]\ncheck = [\"a\"]");
        let found = found.unwrap();
        assert_eq!((found.seed, found.solver), (7, Solver::TwoPoint));
        assert_eq!(found.hsv, Auto::Given([30, 79, 30, 163]));
        let names: Vec<String> = found.changed().into_iter().map(|(name, _)| name).collect();
        assert_eq!(names, ["check", "hsv", "seed", "solver"]);
        assert_eq!(with("hsv = \"auto\"").unwrap(), Trial::default());
        assert_eq!(with("tolerance_px = 3").unwrap().tolerance_px, 3.0);
    }

    #[test]
    fn a_group_is_part_of_the_section() {
        let found = with("side_m = 3\nseed = 5\ncut_solver = \"two-point\"").unwrap();
        assert_eq!((found.cut.side_m, found.seed), (3.0, 5));
        assert_eq!(found.cut.cut_solver, Some(Solver::TwoPoint));
        let names: Vec<String> = found.changed().into_iter().map(|(name, _)| name).collect();
        assert_eq!(names, ["cut_solver", "seed", "side_m"]);
        let table = toml::Table::try_from(&found).unwrap();
        assert_eq!(table["side_m"].as_float(), Some(3.0));
        assert!(toml::from_str::<Trial>("nonsense = 1").is_err());
    }

    #[test]
    fn what_cannot_be_is_refused_with_what_was_expected() {
        for (text, expected) in [
            ("sede = 2", "sede: there is no such option; did you mean seed?"),
            ("xyzzy = 2", "xyzzy: there is no such option; the options are"),
            ("seed = \"two\"", "seed = \"two\": expected a whole number of at least 0"),
            ("seed = -2", "seed = -2: expected a whole number of at least 0"),
            ("solver = \"magic\"", "solver = \"magic\": expected one of: auto, two-point"),
            ("tolerance_px = 0", "tolerance_px = 0: expected a number greater than 0, in pixels"),
            ("tolerance_px = nan", "expected a number greater than 0"),
            ("cell_m = -0.01", "cell_m = -0.01: expected a number greater than 0, in metres"),
            ("hsv = [1, 2, 3]", "hsv = [1, 2, 3]: expected auto or 4 whole numbers from 0 to 255"),
            ("hsv = [1, 2, 3, 256]", "expected auto or 4 whole numbers from 0 to 255"),
            ("window_px = 40", "window_px = 40: expected an odd number of at least 1, in pixels"),
            ("balance = 1", "balance = 1: expected true or false"),
            ("check = 3", "check = 3: expected a list of words"),
            ("side_m = 0", "side_m = 0: expected a number greater than 0, in metres"),
            ("side = 1", "side: there is no such option; did you mean side_m?"),
        ] {
            let error = with(text).unwrap_err();
            assert!(error.contains(expected), "{text}: {error}");
        }
    }

    #[test]
    fn defaults_are_within_their_limits_and_documented() {
        Trial::default().validate().unwrap();
        for field in Trial::fields() {
            assert!(!field.doc.trim().is_empty());
        }
        let seed = &Trial::fields()[0];
        assert_eq!((seed.flag().as_str(), seed.unit()), ("seed", None));
        assert_eq!(Trial::fields()[2].flag(), "tolerance-px");
        assert_eq!(Trial::fields()[2].unit(), Some("pixels"));
    }
}
