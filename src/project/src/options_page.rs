//! The page of all options, `docs/options.md`.

use super::config::{Config, headings, one_line};
use rowgram_base::options::Field;
use std::fmt::Write;

/// The reference of all settings as a page; `docs/options.md` is this text, and a test compares the two.
pub fn reference_page() -> String {
    let mut page = String::from(
        "# Options\n\n\
         The options of a project by section of `rowgram.toml`: first those that most projects need, then [those for experts](#for-experts).\n\
         An option `name` of a section `stage` can be given\n\n\
         - as `name = value` in the section of the file,\n\
         - in the environment as `ROWGRAM_STAGE_NAME`,\n\
         - on the command line as `--set stage.name=value` of `rowgram run`, or as `--name value` (with hyphens) of the command of that stage,\n\
         - from Python as a keyword of `project.stage()`.\n\n\
         The command line comes before the environment, the environment before the file. This page is made from the definitions in the library.\n",
    );
    let sections = Config::sections();
    for section in &sections {
        let fields: Vec<_> = section.fields.iter().filter(|field| field.is_main).collect();
        describe(&mut page, ("##", section.name), Some(section.about), &fields);
    }
    page += "\n## For experts\n\nTheir defaults suit most projects.\n";
    for section in &sections {
        for (name, about, table) in headings(section) {
            let fields =
                section.fields.iter().filter(|field| !field.is_main && field.table == table);
            let fields: Vec<_> = fields.collect();
            let is_new = table.is_some() || section.fields.iter().all(|field| !field.is_main);
            describe(&mut page, ("###", &format!("[{name}]")), is_new.then_some(about), &fields);
        }
    }
    page
}

/// A table of options under a heading; nothing where there are none.
fn describe(
    page: &mut String,
    (level, name): (&str, &str),
    about: Option<&str>,
    fields: &[&Field],
) {
    if fields.is_empty() {
        return;
    }
    let about = about.map_or(String::new(), |about| one_line(about) + "\n\n");
    let _ = write!(
        page,
        "\n{level} {name}\n\n{about}| option | default | expected | what it does |\n|---|---|---|---|\n"
    );
    for field in fields {
        let cell = |text: &str| text.replace('|', "\\|");
        let default = match &field.default {
            Some(value) => format!("`{}`", cell(&value.to_string())),
            None => "not set".to_owned(),
        };
        let _ = writeln!(
            page,
            "| `{}` | {default} | {} | {} |",
            field.name,
            cell(&field.expected()),
            cell(&field.paragraph())
        );
    }
}
