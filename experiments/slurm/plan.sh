#!/usr/bin/env bash
# The same season by this machine alone and as a plan on a Slurm cluster of two nodes on loopback, one of which is killed in the middle:
# what was lost is done again, and the results have to be the same bytes.
#
#   experiments/slurm/plan.sh PROGRAM
#
# PROGRAM is the built `rowgram`. Needs Snakemake 9 with snakemake-executor-plugin-slurm on the path; what else is needed says cluster.sh.
# Exit code 77 with the reason where it cannot run here.
set -euo pipefail

program=$(realpath "${1:?the rowgram program}")

plugin() { snakemake --help 2>/dev/null | grep -q -- --slurm-status-command; }
if ! plugin; then
    printf 'slurm: skipped: no Snakemake with snakemake-executor-plugin-slurm\n'
    exit 77
fi
. "$(dirname "${BASH_SOURCE[0]}")/cluster.sh"

# The same season twice: here, and on the cluster, its long steps in parts.
"$program" synth season --preset tiny --output "$work/here" --quiet
cp -r "$work/here" "$work/there"
"$program" season "$work/here/season.toml" --threads 2 --quiet >"$work/here.txt"
printf 'slurm: the season is done here\n'
"$program" plan "$work/there/season.toml" --output "$work/plan" --photos-per-task 4 --quiet >/dev/null
# Snakemake hides the variables of Slurm from its jobs, and this cluster is no machine's own.
mkdir "$work/bin"
printf '#!/bin/sh\nSLURM_CONF=%q exec %q "$@"\n' "$SLURM_CONF" "$(command -v srun)" >"$work/bin/srun"
chmod +x "$work/bin/srun"
export PATH=$work/bin:$PATH
# No accounts and no accounting here, and nothing of Slurm's own between the first job and the last.
(cd "$work/plan" && exec snakemake --snakefile Snakefile --profile profiles/slurm --config "program=$program" threads=1 \
    --default-resources mem_mb=1000 runtime=60 --jobs 4 --latency-wait 5 --slurm-no-account --slurm-status-command squeue \
    --slurm-init-seconds-before-status-checks 2 --seconds-between-status-checks 2) >"$work/snakemake.log" 2>&1 &
workflow=$!
daemons+=("$workflow")

# Node n1 dies when tasks have been finished and it has one under way.
under_way() {
    [[ $(grep -c '^Finished jobid' "$work/snakemake.log") -gt 3 ]] &&
        [[ -n $(squeue --noheader --states=R --nodelist=n1) ]] && pgrep -f "^$program .*--threads 1 --quiet" >/dev/null
}
await 240 'a task on node n1 after others' under_way
kill_n1
printf 'slurm: node n1 killed after %s tasks\n' "$(grep -c '^Finished jobid' "$work/snakemake.log")"
await 90 'node n1 found down' n1_is_lost

wait "$workflow" || fail 'the workflow failed'
await 60 'the end of all jobs' no_jobs_left
grep -q -i 'requeue' "$work/slurmctld.log" || fail 'no job was requeued'
printf 'slurm: %s\n' "$(grep -i -m1 'requeue' "$work/slurmctld.log")"

# Tables, clouds and rasters: all that has no path in it.
compared=0
while IFS= read -r file; do
    cmp "$work/here/$file" "$work/there/$file" || fail "$file differs"
    compared=$((compared + 1))
done < <(cd "$work/here" && find . -path '*/rowgram/*' -not -path '*/cache/*' -type f \
    \( -name '*.csv' -o -name '*.tif' -o -name '*.laz' -o -name '*.geojson' \) | sort)
[[ $compared -gt 20 ]] || fail "only $compared files to compare"
printf 'slurm: %d files identical to those of this machine after a killed node\n' "$compared"
