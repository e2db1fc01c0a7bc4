//! Sends the shards of a plan to be worked on: to this machine, one process after the other, or to Slurm
//! as a job array with a merge that waits for it.

use crate::{fail::Fail, merge, plan::Planned, work};
use rowgram::io::output;
use std::{path::Path, process::Command};

/// Who works.
#[derive(Debug, Clone, Copy, PartialEq, Eq, clap::ValueEnum)]
pub(crate) enum Engine {
    /// This machine.
    Local,
    /// The cluster whose `sbatch` is on the path.
    Slurm,
}

/// Submits `shards` shards; `options` go to `sbatch` as they are.
pub(crate) fn submit(
    planned: &Planned,
    engine: Engine,
    shards: usize,
    options: &[String],
) -> Result<String, Fail> {
    let shards = shards.clamp(1, planned.count().max(1));
    match engine {
        Engine::Local => {
            for index in 1..=shards {
                work::run(planned, work::Shard { index, count: shards }, 0)?;
            }
            merge::merge(planned)?;
            Ok(format!("{shards} shards done and merged"))
        }
        Engine::Slurm => slurm(planned, shards, options),
    }
}

/// The script of the array: one shard each, started again where its node is lost.
fn array_script(program: &Path, folder: &Path, name: &str, shards: usize) -> String {
    format!(
        "#!/bin/bash\n\
         #SBATCH --job-name={name}\n\
         #SBATCH --array=1-{shards}\n\
         #SBATCH --requeue\n\
         #SBATCH --open-mode=append\n\
         #SBATCH --output={log}\n\
         exec {program} run {folder} --shard \"$SLURM_ARRAY_TASK_ID/{shards}\" --jobs \
         \"${{SLURM_CPUS_PER_TASK:-1}}\"\n",
        log = quoted(&folder.join("slurm-%a.log")),
        program = quoted(program),
        folder = quoted(folder),
    )
}

fn merge_script(program: &Path, folder: &Path, name: &str) -> String {
    format!(
        "#!/bin/bash\n\
         #SBATCH --job-name={name}-merge\n\
         #SBATCH --open-mode=append\n\
         #SBATCH --output={log}\n\
         exec {program} merge {folder}\n",
        log = quoted(&folder.join("slurm-merge.log")),
        program = quoted(program),
        folder = quoted(folder),
    )
}

fn quoted(path: &Path) -> String {
    format!("'{}'", path.to_string_lossy().replace('\'', "'\\''"))
}

fn slurm(planned: &Planned, shards: usize, options: &[String]) -> Result<String, Fail> {
    let folder = planned.folder.canonicalize().map_err(|e| Fail::io(&planned.folder, &e))?;
    let program = std::env::current_exe().map_err(|e| Fail::Failed(e.to_string()))?;
    let name = &planned.plan.spec.name;
    let scripts = [
        ("array.sbatch", array_script(&program, &folder, name, shards)),
        ("merge.sbatch", merge_script(&program, &folder, name)),
    ];
    for (file, text) in &scripts {
        output::write(&folder.join(file), true, |out| out.write_all(text.as_bytes()))?;
    }
    let array = sbatch(&folder.join("array.sbatch"), options, &[])?;
    // Whatever became of the shards: the merge itself says what is missing.
    let dependency = format!("--dependency=afterany:{array}");
    let merge = sbatch(&folder.join("merge.sbatch"), options, &[dependency])?;
    Ok(format!("array {array} of {shards} shards, merge {merge}"))
}

fn sbatch(script: &Path, options: &[String], more: &[String]) -> Result<String, Fail> {
    let ran = Command::new("sbatch")
        .arg("--parsable")
        .args(options)
        .args(more)
        .arg(script)
        .output()
        .map_err(|e| Fail::Failed(format!("sbatch could not be started: {e}; is Slurm here?")))?;
    if !ran.status.success() {
        let said = String::from_utf8_lossy(&ran.stderr);
        return Err(Fail::Failed(format!("sbatch {}: {}", script.display(), said.trim())));
    }
    let said = String::from_utf8_lossy(&ran.stdout);
    // `JOB` or `JOB;CLUSTER`.
    Ok(said.trim().split(';').next().unwrap_or_default().to_owned())
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn scripts_quote_paths_and_requeue() {
        let script = array_script(Path::new("/a b/exe"), Path::new("/it's"), "x", 4);
        assert!(script.contains("#SBATCH --array=1-4\n#SBATCH --requeue\n"), "{script}");
        assert!(script.contains("exec '/a b/exe' run '/it'\\''s' --shard"), "{script}");
    }
}
