//! One option, and the section that it belongs to.

use super::Kind;
use std::fmt;

/// Which numbers an option can have.
#[derive(Debug, Clone, Copy, PartialEq)]
pub struct Limits {
    low: f64,
    high: f64,
    /// Whether the lower limit itself is excluded.
    open: bool,
    odd: bool,
}

impl Limits {
    /// Any number.
    pub const NONE: Limits =
        Limits { low: f64::NEG_INFINITY, high: f64::INFINITY, open: false, odd: false };
    /// Greater than 0.
    pub const POSITIVE: Limits = Limits { low: 0.0, open: true, ..Limits::NONE };
    /// 0 or greater.
    pub const NON_NEGATIVE: Limits = Limits { low: 0.0, ..Limits::NONE };
    /// A share: greater than 0, at most 1.
    pub const SHARE: Limits = Limits { high: 1.0, ..Limits::POSITIVE };
    /// A ground sampling distance of pictures of plants, metres per pixel: from a microscope to a satellite.
    pub const GSD_M: Limits = Limits::between(0.00001, 100.0);
    /// 1, 3, 5, ...
    pub const ODD: Limits = Limits { low: 1.0, odd: true, ..Limits::NONE };

    /// From `low` to `high`, both included.
    pub const fn between(low: f64, high: f64) -> Limits {
        Limits { low, high, ..Limits::NONE }
    }

    /// `low` or greater.
    pub const fn at_least(low: f64) -> Limits {
        Limits { low, ..Limits::NONE }
    }

    /// Whether a number is within.
    pub fn hold(&self, number: f64) -> bool {
        let above = if self.open { number > self.low } else { number >= self.low };
        above
            && number <= self.high
            && number.is_finite()
            && (!self.odd || number.rem_euclid(2.0) == 1.0)
    }

    fn describe(&self, kind: &Kind) -> String {
        let noun = |count: &str| match (self.odd, kind.is_whole(), count.is_empty()) {
            (true, _, true) => "an odd number".to_owned(),
            (true, _, false) => format!("{count} odd numbers"),
            (false, true, true) => "a whole number".to_owned(),
            (false, true, false) => format!("{count} whole numbers"),
            (false, false, true) => "a number".to_owned(),
            (false, false, false) => format!("{count} numbers"),
        };
        // Counts begin at 0 without anybody saying so.
        let low = if kind.is_whole() { self.low.max(0.0) } else { self.low };
        let range = match (low.is_finite(), self.high.is_finite(), self.open) {
            (true, true, false) => format!(" from {low} to {}", self.high),
            (true, true, true) => format!(" greater than {low} and at most {}", self.high),
            (true, false, false) => format!(" of at least {low}"),
            (true, false, true) => format!(" greater than {low}"),
            (false, true, _) => format!(" of at most {}", self.high),
            (false, false, _) => String::new(),
        };
        match kind {
            Kind::Flag => "true or false".to_owned(),
            Kind::Whole | Kind::Number => noun("") + &range,
            Kind::Text => "a word".to_owned(),
            Kind::Path => "a path".to_owned(),
            Kind::Words(words) => format!("one of: {}", words.join(", ")),
            Kind::List(of) => match **of {
                Kind::Whole | Kind::Number => {
                    format!("a list of {}{range}", noun("").replacen("a ", "", 1) + "s")
                }
                Kind::Words(ref words) => format!("a list of: {}", words.join(", ")),
                _ => "a list of words".to_owned(),
            },
            Kind::Several(of, count) => match **of {
                Kind::Whole | Kind::Number => noun(&count.to_string()) + &range,
                _ => format!("{count} words"),
            },
            Kind::AutoOr(of) => format!("auto or {}", self.describe(of)),
        }
    }
}

/// One option.
#[derive(Debug, Clone, PartialEq)]
pub struct Field {
    /// Its name, with its unit: `tolerance_px`.
    pub name: &'static str,
    /// What it does, in one or more sentences, a line each as in the source.
    pub doc: &'static str,
    /// What kind of value it has.
    pub kind: Kind,
    /// Which numbers it can have.
    pub limits: Limits,
    /// Its default; `None` where it is not set.
    pub default: Option<toml::Value>,
    /// A value to show where there is no default, as TOML spells it.
    pub example: Option<&'static str>,
    /// Whether most people need to know it; the others are for experts.
    pub is_main: bool,
    /// The table within its section that it stands in, where it has one: `paper` of `[locate.paper]`.
    pub table: Option<&'static str>,
}

impl Field {
    /// Its name on the command line, without the dashes: `tolerance-px`.
    pub fn flag(&self) -> String {
        self.name.replace('_', "-")
    }

    /// The unit that its name carries.
    pub fn unit(&self) -> Option<&'static str> {
        const UNITS: [(&str, &str); 8] = [
            ("_m_s", "metres per second"),
            ("_px", "pixels"),
            ("_m", "metres"),
            ("_rad", "radians"),
            ("_deg", "degrees"),
            ("_s", "seconds"),
            ("_gsd", "ground sampling distances"),
            ("_mb", "megabytes"),
        ];
        UNITS.iter().find(|(ending, _)| self.name.ends_with(ending)).map(|(_, unit)| *unit)
    }

    /// What a value has to be, for a person: "a number greater than 0, in pixels".
    pub fn expected(&self) -> String {
        let unit = self.unit().map_or(String::new(), |unit| format!(", in {unit}"));
        self.limits.describe(&self.kind) + &unit
    }

    /// Whether the option can have a value.
    pub fn accepts(&self, value: &toml::Value) -> bool {
        fn within(limits: &Limits, value: &toml::Value) -> bool {
            match value {
                toml::Value::Integer(number) => limits.hold(*number as f64),
                toml::Value::Float(number) => limits.hold(*number),
                toml::Value::Array(values) => values.iter().all(|value| within(limits, value)),
                _ => true,
            }
        }
        self.kind.holds(value) && within(&self.limits, value)
    }

    /// The documentation as one paragraph.
    pub fn paragraph(&self) -> String {
        self.doc.split_whitespace().collect::<Vec<_>>().join(" ")
    }
}

/// A set of options by name.
#[derive(Debug, Clone)]
pub struct Section {
    /// Its name.
    pub name: &'static str,
    /// What it is about.
    pub about: &'static str,
    /// Its options.
    pub fields: Vec<Field>,
    /// Its nested tables with what they are about.
    pub tables: Vec<(&'static str, &'static str)>,
    /// Whether serde takes the values, which knows more than their kinds.
    pub(super) check: fn(&toml::Table) -> Result<(), String>,
}

impl Section {
    /// An option by its name.
    pub fn field(&self, name: &str) -> Option<&Field> {
        self.fields.iter().find(|field| field.name == name)
    }

    /// Puts a value into a table of this section, into the nested table that its option stands in.
    pub fn insert(&self, table: &mut toml::Table, name: &str, value: toml::Value) {
        let nested = match (self.field(name).and_then(|field| field.table), &value) {
            (Some(nested), _) => nested,
            (None, toml::Value::Table(values)) => {
                for (name, value) in values {
                    self.insert(table, name, value.clone());
                }
                return;
            }
            (None, _) => {
                table.insert(name.to_owned(), value);
                return;
            }
        };
        let entry = table.entry(nested).or_insert_with(|| toml::Table::new().into());
        if let toml::Value::Table(entry) = entry {
            entry.insert(name.to_owned(), value);
        }
    }

    /// The main options, and after them the others where these are wanted too.
    pub fn by_rank(&self, for_experts: bool) -> Vec<&Field> {
        let of = |is_main: bool| self.fields.iter().filter(move |field| field.is_main == is_main);
        of(true).chain(of(false).filter(|_| for_experts)).collect()
    }

    /// Whether an option was given in its own table, `None` for the section itself; what is no option passes.
    ///
    /// # Errors
    /// Where it belongs.
    pub fn check_table(&self, name: &str, table: Option<&str>) -> Result<(), String> {
        match self.field(name).map(|field| field.table) {
            Some(Some(own)) if table != Some(own) => {
                Err(format!("{name}: it belongs into [{}.{own}]", self.name))
            }
            Some(None) if table.is_some() => {
                Err(format!("{name}: it belongs into [{}]", self.name))
            }
            _ => Ok(()),
        }
    }

    /// Whether there is such an option and it can have the value.
    ///
    /// # Errors
    /// What was expected.
    pub fn check_entry(&self, name: &str, value: &toml::Value) -> Result<(), String> {
        if let toml::Value::Table(nested) = value
            && self.tables.iter().any(|(table, _)| *table == name)
        {
            return nested.iter().try_for_each(|(key, value)| {
                self.check_table(key, Some(name))?;
                self.check_entry(key, value)
            });
        }
        let Some(field) = self.field(name) else {
            let names: Vec<&str> = self.fields.iter().map(|field| field.name).collect();
            return Err(match nearest(name, &names) {
                Some(near) => format!("{name}: there is no such option; did you mean {near}?"),
                None => {
                    format!("{name}: there is no such option; the options are {}", names.join(", "))
                }
            });
        };
        let refused = |why: &dyn fmt::Display| format!("{name} = {}: expected {why}", shown(value));
        if !field.accepts(value) {
            return Err(refused(&field.expected()));
        }
        if has_extreme(value) {
            return Err(refused(&"0, or a number from 1e-15 to 1e15 in size"));
        }
        let mut one = toml::Table::new();
        self.insert(&mut one, name, value.clone());
        (self.check)(&one).map_err(|why| format!("{name} = {}: {why}", shown(value)))
    }
}

/// Sizes of numbers that squares and quotients of them can be computed with, whatever an option means.
const SIZES: std::ops::RangeInclusive<f64> = 1e-15..=1e15;

fn has_extreme(value: &toml::Value) -> bool {
    match value {
        toml::Value::Float(number) => *number != 0.0 && !SIZES.contains(&number.abs()),
        toml::Value::Array(values) => values.iter().any(has_extreme),
        _ => false,
    }
}

/// A value as TOML spells it, floats with their point; in powers of ten where it would be long.
fn shown(value: &toml::Value) -> String {
    match value {
        toml::Value::Float(number) if number.is_finite() && has_extreme(value) => {
            format!("{number:e}")
        }
        _ => value.to_string().trim().to_owned(),
    }
}

/// The name that is nearly the one given, if any is.
pub fn nearest<'a>(name: &str, known: &[&'a str]) -> Option<&'a str> {
    let near = |other: &str| strsim::jaro_winkler(name, other);
    let best = known.iter().copied().max_by(|a, b| near(a).total_cmp(&near(b)))?;
    (near(best) > 0.8).then_some(best)
}
