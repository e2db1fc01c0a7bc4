//! The kinds of values that options have.

use serde::{
    Deserialize, Deserializer, Serialize, Serializer,
    de::{DeserializeOwned, Error as _},
};
use std::{fmt, path::PathBuf};

/// A kind of value.
#[derive(Debug, Clone, PartialEq, Eq)]
pub enum Kind {
    /// `true` or `false`.
    Flag,
    /// A whole number from 0.
    Whole,
    /// A number.
    Number,
    /// A word or a sentence.
    Text,
    /// A file or folder.
    Path,
    /// One of these words.
    Words(Vec<String>),
    /// Any number of values of a kind.
    List(Box<Kind>),
    /// So many values of a kind.
    Several(Box<Kind>, usize),
    /// A word that leaves it to the program, or a value of a kind.
    AutoOr(Box<Kind>),
}

impl Kind {
    /// Whether a value is of this kind; limits are not looked at.
    pub fn holds(&self, value: &toml::Value) -> bool {
        match (self, value) {
            (Kind::Flag, toml::Value::Boolean(_))
            | (Kind::Number, toml::Value::Integer(_) | toml::Value::Float(_))
            | (Kind::Text | Kind::Path, toml::Value::String(_)) => true,
            (Kind::Whole, toml::Value::Integer(number)) => *number >= 0,
            (Kind::Words(words), toml::Value::String(text)) => words.contains(text),
            (Kind::List(kind), toml::Value::Array(values)) => values.iter().all(|v| kind.holds(v)),
            (Kind::Several(kind, count), toml::Value::Array(values)) => {
                values.len() == *count && values.iter().all(|value| kind.holds(value))
            }
            (Kind::AutoOr(kind), value) => value.as_str() == Some(AUTO) || kind.holds(value),
            _ => false,
        }
    }

    /// Whether numbers of this kind are whole.
    pub(super) fn is_whole(&self) -> bool {
        match self {
            Kind::Whole => true,
            Kind::List(kind) | Kind::Several(kind, _) | Kind::AutoOr(kind) => kind.is_whole(),
            _ => false,
        }
    }

    /// A value from the words of a command line or of the environment: a list is separated by commas.
    pub fn read(&self, text: &str) -> toml::Value {
        let text = text.trim();
        let word = || toml::Value::String(text.to_owned());
        match self {
            Kind::Text | Kind::Path | Kind::Words(_) => match spelled(text) {
                Some(value @ toml::Value::String(_)) => value,
                _ => word(),
            },
            Kind::AutoOr(_) if text == AUTO => word(),
            Kind::AutoOr(kind) => kind.read(text),
            Kind::List(kind) | Kind::Several(kind, _) => match spelled(text) {
                Some(value @ toml::Value::Array(_)) => value,
                _ if text.is_empty() => toml::Value::Array(Vec::new()),
                _ => toml::Value::Array(text.split(',').map(|part| kind.read(part)).collect()),
            },
            Kind::Flag | Kind::Whole | Kind::Number => spelled(text).unwrap_or_else(word),
        }
    }

    /// What stands for a value in `--help`.
    pub fn placeholder(&self, unit: Option<&str>) -> String {
        let plain = |name: &str| unit.map_or(name.to_owned(), placeholder_of);
        match self {
            Kind::Flag => "true|false".to_owned(),
            Kind::Whole => plain("N"),
            Kind::Number => plain("X"),
            Kind::Text => "TEXT".to_owned(),
            Kind::Path => "PATH".to_owned(),
            Kind::Words(words) => words.join("|"),
            Kind::List(kind) => format!("{},...", kind.placeholder(unit)),
            Kind::Several(kind, count) => vec![kind.placeholder(unit); *count].join(","),
            Kind::AutoOr(kind) => format!("auto|{}", kind.placeholder(unit)),
        }
    }
}

fn placeholder_of(unit: &str) -> String {
    match unit {
        "pixels" => "PX",
        "metres" => "M",
        "degrees" => "DEG",
        "seconds" => "S",
        _ => "X",
    }
    .to_owned()
}

/// A value as TOML spells it.
fn spelled(text: &str) -> Option<toml::Value> {
    format!("x = {text}").parse::<toml::Table>().ok().and_then(|mut one| one.remove("x"))
}

/// What an option can hold.
pub trait Value: Serialize + DeserializeOwned {
    /// Its kind.
    fn kind() -> Kind;

    /// Whether there is no value, which TOML has no word for.
    fn is_unset(&self) -> bool {
        false
    }

    /// As TOML spells it; `None` where there is no value.
    fn written(&self) -> Option<toml::Value> {
        if self.is_unset() { None } else { toml::Value::try_from(self).ok() }
    }
}

macro_rules! plain {
    ($($name:ty => $kind:ident),*) => {
        $(impl Value for $name {
            fn kind() -> Kind {
                Kind::$kind
            }
        })*
    };
}

plain!(bool => Flag, u16 => Whole, u32 => Whole, u64 => Whole, usize => Whole, f64 => Number, String => Text, PathBuf => Path);

impl<T: Value> Value for Option<T> {
    fn kind() -> Kind {
        T::kind()
    }

    fn is_unset(&self) -> bool {
        self.is_none()
    }
}

impl<T: Value> Value for Vec<T> {
    fn kind() -> Kind {
        Kind::List(Box::new(T::kind()))
    }
}

impl<T: Value, const N: usize> Value for [T; N]
where
    [T; N]: Serialize + DeserializeOwned,
{
    fn kind() -> Kind {
        Kind::Several(Box::new(T::kind()), N)
    }
}

/// The word that leaves a value to the program.
const AUTO: &str = "auto";

/// A value, or `"auto"`: the program finds one.
#[derive(Debug, Clone, Copy, PartialEq, Eq, Default)]
pub enum Auto<T> {
    /// The program finds a value.
    #[default]
    Auto,
    /// This value.
    Given(T),
}

impl<T: Copy> Auto<T> {
    /// The value, if there is one.
    pub fn given(self) -> Option<T> {
        match self {
            Auto::Auto => None,
            Auto::Given(value) => Some(value),
        }
    }
}

impl<T> From<Option<T>> for Auto<T> {
    fn from(value: Option<T>) -> Auto<T> {
        value.map_or(Auto::Auto, Auto::Given)
    }
}

impl<T: fmt::Display> fmt::Display for Auto<T> {
    fn fmt(&self, f: &mut fmt::Formatter<'_>) -> fmt::Result {
        match self {
            Auto::Auto => f.write_str(AUTO),
            Auto::Given(value) => value.fmt(f),
        }
    }
}

impl<T: Value + Clone> Value for Auto<T> {
    fn kind() -> Kind {
        Kind::AutoOr(Box::new(T::kind()))
    }
}

impl<T: Serialize> Serialize for Auto<T> {
    fn serialize<S: Serializer>(&self, serializer: S) -> Result<S::Ok, S::Error> {
        match self {
            Auto::Auto => serializer.serialize_str(AUTO),
            Auto::Given(value) => value.serialize(serializer),
        }
    }
}

impl<'de, T: DeserializeOwned> Deserialize<'de> for Auto<T> {
    fn deserialize<D: Deserializer<'de>>(deserializer: D) -> Result<Auto<T>, D::Error> {
        let value = toml::Value::deserialize(deserializer)?;
        if value.as_str() == Some(AUTO) {
            return Ok(Auto::Auto);
        }
        // What is wrong with a value is what its own type says of it.
        let given = value.try_into().map_err(|e: toml::de::Error| D::Error::custom(e.message()))?;
        Ok(Auto::Given(given))
    }
}

/// An enum without data, whose words are those of serde; see [`choices!`](crate::choices!).
pub trait Choice: Serialize + DeserializeOwned {
    /// Every variant.
    fn all() -> Vec<Self>;

    /// The word of a variant.
    fn word(&self) -> String {
        match serde_json::to_value(self) {
            Ok(serde_json::Value::String(word)) => word,
            _ => String::new(),
        }
    }

    /// The variant of a word.
    ///
    /// # Errors
    /// The words that there are.
    fn read(text: &str) -> Result<Self, String> {
        Self::all().into_iter().find(|one| one.word() == text).ok_or_else(|| {
            let words: Vec<String> = Self::all().iter().map(Choice::word).collect();
            format!("expected one of: {}", words.join(", "))
        })
    }
}
