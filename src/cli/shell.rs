//! `rowgram completions`: what shells and readers of manuals know of the program.

use super::{command, print};
use clap_complete::Shell;
use rowgram_base::error::Error;
use rowgram_optim::output::{self, FileError};
use std::path::{Path, PathBuf};

/// Print the completions of a shell, or the manual page
#[derive(Debug, clap::Args)]
#[command(after_help = "Examples:
  rowgram completions bash > ~/.local/share/bash-completion/completions/rowgram
  rowgram completions fish > ~/.config/fish/completions/rowgram.fish
  rowgram completions --man | man -l -
  rowgram completions --man -o ~/.local/share/man/man1")]
pub(super) struct Args {
    /// The shell.
    #[arg(value_enum, required_unless_present = "man", conflicts_with = "man")]
    shell: Option<Shell>,
    /// Print the manual page.
    #[arg(long)]
    man: bool,
    /// With --man: write the pages of all commands into this folder: rowgram.1, rowgram-align.1 and so on.
    #[arg(short, long, value_name = "DIR", requires = "man")]
    output: Option<PathBuf>,
    /// Replace pages that exist.
    #[arg(long, requires = "output")]
    force: bool,
}

impl Args {
    /// Runs the command.
    ///
    /// # Errors
    /// Where stdout is closed, or a page cannot be written.
    pub(super) fn run(&self) -> Result<(), Error> {
        let mut text = Vec::new();
        if let Some(shell) = self.shell {
            clap_complete::generate(shell, &mut command(), "rowgram", &mut text);
        } else if let Some(folder) = &self.output {
            output::make_folder(folder)?;
            // All pages are written together, so that one stands for them.
            output::check(&folder.join("rowgram.1"), self.force)?;
            return clap_mangen::generate_to(command(), folder)
                .map_err(|e| FileError::write(folder, e).into());
        } else {
            let page = clap_mangen::Man::new(command()).render(&mut text);
            page.map_err(|e| FileError::write(Path::new("stdout"), e))?;
        }
        print(&String::from_utf8_lossy(&text))
    }
}

#[cfg(test)]
mod tests {
    use super::*;
    use crate::cli::GROUPS;
    use clap::Command;

    /// Every command at the end of a chain of commands, with its name in full.
    fn leaves(command: &Command, name: &str, out: &mut Vec<(String, String)>) {
        if command.has_subcommands() {
            for command in command.get_subcommands().filter(|command| command.get_name() != "help")
            {
                leaves(command, &format!("{name} {}", command.get_name()), out);
            }
            // A command that also works by itself explains itself too.
            if command.get_arguments().next().is_none() || name == "rowgram" {
                return;
            }
        }
        out.push((name.to_owned(), command.clone().render_long_help().to_string()));
    }

    /// The command lines of a text: those that begin with the program, or run it with cargo.
    fn commands(text: &str) -> Vec<String> {
        let text = text.replace("\\\n", " ");
        let program = |line: &str| {
            let line = line.trim_start();
            let line = line.strip_prefix("Example: ").unwrap_or(line);
            let line = line.strip_prefix("cargo run --release -- ").map_or_else(
                || line.strip_prefix("rowgram ").map(str::to_owned),
                |rest| Some(rest.to_owned()),
            )?;
            let end = line.find([';', '|', '>', '#']).unwrap_or(line.len());
            Some(line[..end].trim().to_owned())
        };
        text.lines().flat_map(|line| line.split("&&")).filter_map(program).collect()
    }

    /// What is wrong with a command line.
    fn fault(place: &str, line: &str) -> Option<String> {
        let words = ["rowgram"].into_iter().chain(line.split_whitespace());
        let words = words.map(|word| word.trim_matches(['"', '\'']));
        let error = command().try_get_matches_from(words).err()?;
        error.use_stderr().then(|| format!("{place}: rowgram {line}\n{error}"))
    }

    #[test]
    fn help_shows_every_command_in_one_group() {
        let mut program = command();
        program.build();
        let mut known: Vec<&str> = program.get_subcommands().map(Command::get_name).collect();
        let mut shown: Vec<&str> = GROUPS.iter().flat_map(|(_, names)| *names).copied().collect();
        known.sort_unstable();
        shown.sort_unstable();
        assert_eq!(shown, known);
        assert!(known.len() <= 22, "21 commands and help at most: {known:?}");
        let help = command().render_help().to_string();
        for (heading, names) in GROUPS {
            assert!(help.contains(&format!("{heading}:")), "{help}");
            for name in names {
                let line = help.lines().find(|line| line.trim_start().starts_with(name)).unwrap();
                assert!(line.len() > 30 && line.len() <= 110, "{line}");
            }
        }
    }

    #[test]
    fn every_command_shows_examples_that_are_commands() {
        let mut pages = Vec::new();
        leaves(&command(), "rowgram", &mut pages);
        assert!(pages.len() > 20, "{}", pages.len());
        let (mut without, mut faults) = (Vec::new(), Vec::new());
        for (name, help) in pages {
            // Before the examples there is prose, whose lines may begin with the program's name.
            let lines = commands(help.find("Example").map_or("", |at| &help[at..]));
            let own = |line: &String| format!("rowgram {line}").starts_with(&name);
            if !lines.iter().any(own) {
                without.push(name.clone());
            }
            faults.extend(lines.iter().filter_map(|line| fault(&name, line)));
        }
        assert!(faults.is_empty(), "{}", faults.join("\n"));
        assert!(without.is_empty(), "--help shows no example: {without:?}");
    }

    #[test]
    fn every_command_in_the_documents_is_one() {
        let root = Path::new(env!("CARGO_MANIFEST_DIR"));
        let mut files = vec![root.join("README.md"), root.join("CONTRIBUTING.md")];
        files.extend(std::fs::read_dir(root.join("docs")).unwrap().map(|e| e.unwrap().path()));
        let (mut seen, mut faults) = (0, Vec::new());
        for file in files.iter().filter(|file| file.extension().is_some_and(|e| e == "md")) {
            let text = std::fs::read_to_string(file).unwrap();
            let fenced = text.split("```").skip(1).step_by(2).collect::<Vec<_>>().join("\n");
            for line in commands(&fenced) {
                faults.extend(fault(&file.display().to_string(), &line));
                seen += 1;
            }
        }
        assert!(faults.is_empty(), "{}", faults.join("\n"));
        assert!(seen > 10, "{seen}");
    }
}
