//! Key paths into parameters: `locator.model.prior` names one value of nested tables.
//!
//! What may be set is what the defaults of a stage hold: a path that they do not have is refused with
//! the nearest one that they have, and a value must be of the kind of the default.

use toml::{Table, Value};

/// Every path to a value that is not a table, sorted.
pub(crate) fn paths(table: &Table) -> Vec<String> {
    let mut found = Vec::new();
    walk(table, "", &mut |path, _| found.push(path));
    found.sort();
    found
}

/// The values of nested tables by their paths, in the order of the paths.
pub(crate) fn flatten(table: &Table) -> Vec<(String, Value)> {
    let mut found = Vec::new();
    walk(table, "", &mut |path, value| found.push((path, value.clone())));
    found.sort_by(|a, b| a.0.cmp(&b.0));
    found
}

fn walk(table: &Table, prefix: &str, visit: &mut impl FnMut(String, &Value)) {
    for (key, value) in table {
        let path = if prefix.is_empty() { key.clone() } else { format!("{prefix}.{key}") };
        match value {
            Value::Table(inner) => walk(inner, &path, visit),
            other => visit(path, other),
        }
    }
}

/// Puts a value where the path leads.
///
/// # Errors
/// For a path that `table` does not have, and a value of another kind.
pub(crate) fn set(table: &mut Table, path: &str, value: &Value) -> Result<(), String> {
    let known = paths(table);
    if !known.iter().any(|key| key == path) {
        return Err(unknown("key", path, known.iter().map(String::as_str)));
    }
    let mut at = table;
    let mut parts = path.split('.').peekable();
    while let Some(part) = parts.next() {
        let Some(slot) = at.get_mut(part) else { break };
        if parts.peek().is_some() {
            let Value::Table(inner) = slot else { break };
            at = inner;
            continue;
        }
        let value = match (&*slot, value) {
            (Value::Float(_), &Value::Integer(whole)) => Value::Float(whole as f64),
            (_, value) => value.clone(),
        };
        if std::mem::discriminant(slot) != std::mem::discriminant(&value) {
            return Err(format!(
                "{path} = {value}: expected a {}, such as the default {slot}",
                slot.type_str()
            ));
        }
        *slot = value;
        return Ok(());
    }
    Err(format!("{path} leads nowhere"))
}

/// Puts the values of one table over those of another.
pub(crate) fn merge(into: &mut Table, from: &Table) {
    for (key, value) in from {
        match (into.get_mut(key), value) {
            (Some(Value::Table(inner)), Value::Table(other)) => merge(inner, other),
            _ => drop(into.insert(key.clone(), value.clone())),
        }
    }
}

/// Takes a path out, so that it can no longer be set.
pub(crate) fn remove(table: &mut Table, path: &str) {
    match path.split_once('.') {
        None => drop(table.remove(path)),
        Some((first, rest)) => {
            if let Some(Value::Table(inner)) = table.get_mut(first) {
                remove(inner, rest);
            }
        }
    }
}

/// "unknown key `x`; did you mean `y`?"
pub(crate) fn unknown<'a>(
    what: &str,
    found: &str,
    known: impl Iterator<Item = &'a str> + Clone,
) -> String {
    match nearest(found, known.clone()) {
        Some(near) => format!("unknown {what} `{found}`; did you mean `{near}`?"),
        None => {
            let known: Vec<&str> = known.collect();
            format!("unknown {what} `{found}`; expected one of: {}", known.join(", "))
        }
    }
}

/// The known word most like `found`; a path's last part counts on its own, for most mistakes leave
/// a part out.
fn nearest<'a>(found: &str, known: impl Iterator<Item = &'a str>) -> Option<&'a str> {
    let last = |path: &'a str| path.rsplit('.').next().unwrap_or(path);
    let own = found.rsplit('.').next().unwrap_or(found);
    known
        .map(|word| {
            let whole = strsim::normalized_damerau_levenshtein(found, word);
            let part = 0.9 * strsim::normalized_damerau_levenshtein(own, last(word));
            (whole.max(part), word)
        })
        .max_by(|a, b| a.0.total_cmp(&b.0))
        .map(|(_, word)| word)
}

/// The message of a parser, with the nearest word where it refuses one and lists those it knows.
pub(crate) fn with_nearest(message: &str) -> String {
    let quoted: Vec<&str> = message.split('`').skip(1).step_by(2).collect();
    let refuses =
        ["unknown field `", "unknown variant `"].iter().any(|part| message.contains(part));
    match (refuses, quoted.split_first()) {
        (true, Some((found, known))) if !known.is_empty() => {
            match nearest(found, known.iter().copied()) {
                Some(near) => format!("{}; did you mean `{near}`?", message.trim_end()),
                None => message.to_owned(),
            }
        }
        _ => message.to_owned(),
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    fn table(text: &str) -> Table {
        text.parse().unwrap()
    }

    #[test]
    fn what_is_set_is_there_and_keeps_its_kind() {
        let mut at = table("a = 1.5\n[b.c]\nd = 'word'\ne = [1, 2]");
        set(&mut at, "a", &Value::Integer(2)).unwrap();
        set(&mut at, "b.c.d", &Value::from("other")).unwrap();
        assert_eq!(at, table("a = 2.0\n[b.c]\nd = 'other'\ne = [1, 2]"));
        let error = set(&mut at, "b.c.d", &Value::Integer(3)).unwrap_err();
        assert!(error.contains("expected a string"), "{error}");
        assert_eq!(paths(&at), ["a", "b.c.d", "b.c.e"]);
        remove(&mut at, "b.c.e");
        assert_eq!(paths(&at), ["a", "b.c.d"]);
    }

    #[test]
    fn a_wrong_key_is_answered_with_the_nearest() {
        let mut at =
            table("[field]\nspacing_m = 1.0\nrow_length_m = 5.0\n[locator]\nprior = 'none'");
        for (wrong, right) in [
            ("field.spacing", "field.spacing_m"),
            ("spacing_m", "field.spacing_m"),
            ("locater.prior", "locator.prior"),
            ("field.row_lenght_m", "field.row_length_m"),
        ] {
            let error = set(&mut at, wrong, &Value::Integer(1)).unwrap_err();
            assert!(error.contains(&format!("did you mean `{right}`")), "{error}");
        }
        let message = "unknown field `sed`, expected one of `seed`, `stage`";
        assert!(with_nearest(message).ends_with("did you mean `seed`?"));
    }
}
