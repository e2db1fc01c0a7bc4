//! The `rowgram` program; everything it does is in [`rowgram::cli`].

fn main() -> std::process::ExitCode {
    rowgram::cli::main()
}
