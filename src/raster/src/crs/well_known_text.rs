//! What well-known text says of the registry of reference systems.

/// Of the text of a compound system the part that is in plan.
pub(super) fn in_plan(text: &str) -> &str {
    if !text.trim_start().to_ascii_uppercase().starts_with("COMP") {
        return text;
    }
    let begin =
        ["PROJCS[", "PROJCRS[", "GEOGCS[", "GEOGCRS["].iter().find_map(|key| text.find(key));
    let text = begin.map_or(text, |begin| &text[begin..]);
    let mut depth = 0;
    let is_end = |c: char| {
        depth += i32::from(c == '[') - i32::from(c == ']');
        c == ']' && depth == 0
    };
    text.find(is_end).map_or(text, |end| &text[..=end])
}

/// The code that well-known text gives itself: the last one, where it stands in no part of the text.
pub(super) fn code(text: &str) -> Option<u32> {
    let at = text.rfind("AUTHORITY[").max(text.rfind("ID["))?;
    let depth = text[..at].chars().fold(0, |depth, c| match c {
        '[' => depth + 1,
        ']' => depth - 1,
        _ => depth,
    });
    let mut words = text[at..].split(['[', ',', ']']).map(|word| word.trim().trim_matches('"'));
    let _keyword = words.next();
    let is_epsg = words.next().is_some_and(|who| who.eq_ignore_ascii_case("EPSG"));
    if depth != 1 || !is_epsg {
        return None;
    }
    words.next()?.parse().ok()
}
