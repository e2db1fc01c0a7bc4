//! All kept results as one document: Typst's markup, and a PDF where Typst is installed.

use crate::{data::Frame, fail::Fail, publish, spec::Spec, tables::TableSpec};
use rowgram::io::output;
use std::{
    fmt::Write as _,
    path::{Path, PathBuf},
    process::Command,
};

/// The font of the figures, so that their letters are in the document too.
static FONT: &[u8] = include_bytes!("../assets/DejaVuSans.ttf");

/// What Typst is called from where only its Python package is installed.
const PYTHON: &str =
    "import sys, typst; typst.compile(sys.argv[1], output=sys.argv[2], font_paths=[sys.argv[3]])";

/// Writes `paper.typ` with its figures into `folder`, and `paper.pdf`; gives the path of the PDF.
pub(crate) fn write(kept: &[(Spec, PathBuf)], folder: &Path) -> Result<PathBuf, Fail> {
    let fonts = folder.join("fonts");
    std::fs::create_dir_all(&fonts).map_err(|e| Fail::io(&fonts, &e))?;
    output::write(&fonts.join("DejaVuSans.ttf"), true, |out| out.write_all(FONT))?;
    let mut text = String::from(HEAD);
    for (spec, result) in kept {
        publish::draw(spec, result, &folder.join(&spec.name))?;
        text += &chapter(spec, result)?;
    }
    let source = folder.join("paper.typ");
    output::write(&source, true, |out| out.write_all(text.as_bytes()))?;
    compile(&source, &fonts)
}

const HEAD: &str = r##"#set document(title: "Experiments with rowgram")
#set page(paper: "a4", margin: 2cm, numbering: "1")
#set text(size: 10pt)
#set par(justify: true)
#show figure: set block(breakable: true)
#show figure.caption: set text(size: 9pt)
#align(center, text(size: 18pt)[Experiments with rowgram])
#outline(depth: 1)
"##;

fn chapter(spec: &Spec, result: &Path) -> Result<String, Fail> {
    let fail = |e: String| Fail::Failed(format!("{}: {e}", spec.name));
    let runs = Frame::read(&result.join("runs.csv"))?;
    let mut text = format!("\n= #{}\n\n", quoted(&spec.title));
    if let Some(finding) = &spec.finding {
        text += &format!("#{}\n\n", quoted(&finding.fill(&runs).map_err(fail)?));
    }
    let tests = publish::tests_sentence(spec, &runs)?;
    if !tests.is_empty() {
        text += &format!("#{}\n\n", quoted(&tests));
    }
    // Writing to a string does not fail.
    let _ = writeln!(
        text,
        "#raw({})\n",
        quoted(&format!("experiments run experiments/specs/{}.toml", spec.name))
    );
    for figure in publish::drawn(spec, result) {
        let _ = writeln!(
            text,
            "#figure(image({}, width: 90%), caption: {})\n",
            quoted(&format!("{}/{}.svg", spec.name, figure.name)),
            quoted(&figure.caption)
        );
    }
    for table in &spec.tables {
        text += &table_of(table, &runs).map_err(fail)?;
    }
    Ok(text)
}

fn table_of(table: &TableSpec, runs: &Frame) -> Result<String, String> {
    let rows = table.shown_rows(runs)?;
    let columns = rows.first().map_or(0, Vec::len);
    let size = if columns > 7 { 6 } else { 8 };
    let mut text = format!(
        "#figure(text(size: {size}pt, table(columns: {columns}, align: (x, _) => if x == 0 {{ left }} else {{ right }},\n"
    );
    for row in &rows {
        let cells: Vec<String> = row.iter().map(|cell| quoted(cell)).collect();
        text += &format!("  {},\n", cells.join(", "));
    }
    Ok(text + &format!(")), caption: {})\n\n", quoted(&table.caption_with_intervals())))
}

/// Text as a string of Typst, in which no letter is a command.
fn quoted(text: &str) -> String {
    format!("\"{}\"", text.replace('\\', "\\\\").replace('"', "\\\"").replace('\n', " "))
}

fn compile(source: &Path, fonts: &Path) -> Result<PathBuf, Fail> {
    let pdf = source.with_extension("pdf");
    let program =
        Command::new("typst").args(["compile", "--font-path"]).args([fonts, source, &pdf]).output();
    let done = match program {
        Err(error) if error.kind() == std::io::ErrorKind::NotFound => {
            Command::new("python3").args(["-c", PYTHON]).args([source, &pdf, fonts]).output()
        }
        done => done,
    };
    let told = |why: &str| {
        Fail::Failed(format!(
            "{} is written, but not the PDF: {}; install Typst (https://typst.app) or its Python package: pip install typst",
            source.display(),
            why.trim()
        ))
    };
    let done = done.map_err(|e| told(&e.to_string()))?;
    if done.status.success() { Ok(pdf) } else { Err(told(&String::from_utf8_lossy(&done.stderr))) }
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn a_chapter_has_finding_command_figures_and_tables() {
        let (spec, _) = Spec::parse(
            r#"
            name = "toy"
            title = "Toy # 1"
            stage = "arena"
            seeds = { count = 1 }
            [[axis]]
            key = "solver"
            values = ["dogleg", "lbfgs"]
            [[figure]]
            name = "bars"
            look = "bars"
            x = "solver"
            y = "solved"
            caption = "Say \"yes\"."
            [[table]]
            name = "numbers"
            rows = "solver"
            values = ["solved"]
            [finding]
            text = "Dogleg {mean solved @ solver=dogleg}."
            "#,
            false,
        )
        .unwrap();
        let folder = tempfile::tempdir().unwrap();
        let runs = "cell,solver,seed,status,reason,solved\n0,dogleg,1,ok,,1\n1,lbfgs,1,ok,,0\n";
        std::fs::write(folder.path().join("runs.csv"), runs).unwrap();
        let text = chapter(&spec, folder.path()).unwrap();
        for part in [
            "= #\"Toy # 1\"",
            "Dogleg 1.00.",
            "experiments run experiments/specs/toy.toml",
            "image(\"toy/bars.svg\"",
            "Say \\\"yes\\\".",
            "\"dogleg\", \"1.00\",",
        ] {
            assert!(text.contains(part), "{part}: {text}");
        }
    }
}
