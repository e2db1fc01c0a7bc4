#!/usr/bin/env bash
# The same sweep by this machine alone and by a Slurm cluster of two nodes on loopback, one of which is
# killed in the middle: the results have to be the same bytes.
#
#   experiments/slurm/loopback.sh PROGRAM SPEC
#
# PROGRAM is the built `experiments`; what else is needed says cluster.sh. Exit code 77 with the reason where it cannot run here.
set -euo pipefail

program=$(realpath "${1:?the experiments program}")
spec=$(realpath "${2:?a spec}")
shards=4

. "$(dirname "${BASH_SOURCE[0]}")/cluster.sh"

# The same plan twice: here, and on the cluster.
"$program" run "$spec" --small --out "$work/local" --jobs 2 >/dev/null
"$program" plan "$spec" --small --out "$work/run" >/dev/null
"$program" submit "$work/run" --engine slurm --shards "$shards" >"$work/submitted"
printf 'slurm: %s\n' "$(cat "$work/submitted")"

# Node n1 dies when the shard that runs there has finished a task and has another under way: daemon, step
# and work.
dying=
shard_of_n1() {
    dying=$(squeue --noheader --array --states=R --nodelist=n1 --format=%K | head -n 1)
    [[ -n $dying ]]
}
await 120 'a shard on node n1' shard_of_n1
record_of_n1() { compgen -G "$work/run/tasks/task-*.$dying-of-$shards.json"; }
await 120 'the first finished task on node n1' record_of_n1
kill_n1
done_before=$("$program" status "$work/run")
printf 'slurm: node n1 killed with shard %s under way; %s\n' "$dying" "$done_before"
await 90 'node n1 found down' n1_is_lost

await 300 'the end of all jobs' no_jobs_left
grep -q -i 'requeue' "$work/slurmctld.log" || fail 'no job was requeued'
printf 'slurm: %s\n' "$(grep -i -m1 'requeue' "$work/slurmctld.log")"

[[ -f $work/run/runs.csv ]] || fail 'the merge left no runs.csv'
for file in runs.csv runs.parquet; do
    cmp "$work/local/$file" "$work/run/$file" || fail "$file differs"
done
if [[ -d $work/local/traces ]]; then diff -r "$work/local/traces" "$work/run/traces" || fail 'traces differ'; fi
printf 'slurm: identical to the local run after a killed node: %s\n' \
    "$(sha256sum <"$work/run/runs.csv" | cut -c1-16)"
