//! Units of the columns of a table, as their titles state them.

use super::normal;

/// Units of length at the end of a title: `elevation_ft`, `sigma_xy_mm`.
const ENDINGS: [&str; 16] = [
    "mm",
    "cm",
    "dm",
    "km",
    "m",
    "meter",
    "meters",
    "metre",
    "metres",
    "us_survey_ft",
    "us_ft",
    "usft",
    "ftus",
    "ft",
    "feet",
    "foot",
];

/// What a name in metres, as it is compared, begins with, and the unit at its end.
pub(super) fn name_and_ending(name: &str) -> Option<(&str, &'static str)> {
    let cut =
        |ending: &&'static str| Some((name.strip_suffix(*ending)?.strip_suffix('_')?, *ending));
    ENDINGS.iter().find_map(cut)
}

/// The unit in brackets or at the end of a title, as a number of metres or degrees, or why it is refused; 1 where there is
/// none, or one of something else.
pub(super) fn unit(title: &str) -> Result<f64, &'static str> {
    let name = normal(title);
    let bracket = title.find(['(', '[']).map(|open| {
        let inside = &title[open + 1..];
        inside.split([')', ']']).next().unwrap_or(inside).trim().to_lowercase()
    });
    let ending = || name_and_ending(&name).map(|(_, ending)| ending.to_owned());
    let Some(word) = bracket.or_else(ending) else { return Ok(1.0) };
    let is_foot = |part: &str| {
        ["ft", "usft", "ftus", "sft", "ussft", "ift"].contains(&part)
            || ["feet", "foot"].iter().any(|foot| part.contains(foot))
    };
    if word.split(|c: char| !c.is_alphanumeric()).any(is_foot) {
        return Err("feet: there are two that differ, so convert to metres");
    }
    match word.as_str() {
        "mm" => Ok(0.001),
        "cm" => Ok(0.01),
        "dm" => Ok(0.1),
        "km" => Ok(1000.0),
        "rad" | "radian" | "radians" => Ok(1f64.to_degrees()),
        "gon" | "grad" | "gradian" | "gradians" => Ok(0.9),
        "yd" | "yard" | "yards" | "in" | "inch" | "inches" | "mi" | "mile" | "miles" | "nmi" => {
            Err("a unit that is not read: convert to metres")
        }
        "w" | "west" | "south" => {
            Err("numbers to the west or south: make them negative and take the letter away")
        }
        _ => Ok(1.0),
    }
}

/// Whether a field looks like degrees with minutes, or with the letter of a side: `40°28'18.7"N`, `40 deg 28' 18.7"`, `40 28 18.7`.
pub(super) fn has_minutes(field: &str) -> bool {
    let field = &field.replace("deg", "");
    let is_degrees = |c: char| c.is_ascii_digit() || " .,:-°º'\"′″’”NSEWnsew".contains(c);
    field.starts_with(|c: char| c.is_ascii_digit() || "-NSEW".contains(c))
        && field.chars().all(is_degrees)
        && field.contains([' ', ':', '°', 'º', '\'', '′', 'N', 'S', 'E', 'W'])
}
