# A Slurm cluster of two nodes, n1 and n2, on loopback, for the scripts beside this file, which source it: it starts one in the folder $work,
# ends it with the script, and has the functions by which a node is killed.
#
# Needs Debian's packages slurm-wlm and munge, and root (to start the daemons under a configuration of their own; nothing outside a
# temporary folder is touched). With INSTALL=1 packages that are missing are installed with apt-get, which is the only lasting
# change. Exit code 77 with the reason where it cannot run here.

skip() {
    printf 'slurm: skipped: %s\n' "$*"
    exit 77
}

[[ $(id -u) == 0 ]] || skip 'the daemons need root'
PATH=$PATH:/usr/sbin
absent() {
    local tool
    for tool in munged slurmctld slurmd sbatch scontrol squeue sinfo; do
        command -v "$tool" >/dev/null || printf '%s ' "$tool"
    done
}
if [[ -n $(absent) && -n ${INSTALL:-} ]] && command -v apt-get >/dev/null; then
    printf 'slurm: apt-get install slurm-wlm munge\n'
    export DEBIAN_FRONTEND=noninteractive
    log=$(mktemp)
    {
        apt-get update -qq &&
            timeout 300 apt-get install -y -qq --no-install-recommends slurm-wlm munge
    } >"$log" 2>&1 || skip "apt-get failed: $(grep -m1 '^E:' "$log" || tail -n 1 "$log")"
    rm -f "$log"
fi
[[ -z $(absent) ]] || skip "not installed: $(absent)(Debian: apt-get install slurm-wlm munge, or INSTALL=1)"

work=$(mktemp -d /tmp/rowgram-slurm-XXXXXX)
daemons=()
clean() {
    local pid
    for pid in "${daemons[@]}"; do
        disown "$pid" 2>/dev/null || true
        kill -9 "$pid" 2>/dev/null || true
    done
    if [[ -n ${KEEP:-} ]]; then printf 'slurm: kept %s\n' "$work"; else rm -rf "$work" 2>/dev/null || true; fi
}
trap clean EXIT

fail() {
    printf 'slurm: %s\n' "$*" >&2
    tail -n 20 "$work"/*.log "$work"/run/slurm-*.log >&2 2>/dev/null || true
    exit 1
}

# Waits until a command succeeds.
await() {
    local seconds=$1 what=$2
    shift 2
    for ((k = 0; k < 10 * seconds; k++)); do
        if "$@" >/dev/null 2>&1; then return; fi
        sleep 0.1
    done
    fail "$what did not happen within $seconds s"
}

# A free port each, so that several of these and a real cluster can live side by side.
port() {
    local try
    while :; do
        try=$((20000 + RANDOM % 12000))
        if ! (exec 3<>"/dev/tcp/127.0.0.1/$try") 2>/dev/null; then break; fi
    done
    printf '%d\n' "$try"
}

# Munge of our own: key, socket and log in the folder.
chmod 0755 "$work"
mkdir -m 0755 "$work/munge" "$work/state" "$work/spool-n1" "$work/spool-n2"
dd if=/dev/urandom of="$work/munge/key" bs=1024 count=1 status=none
chmod 0400 "$work/munge/key"
munged --force --foreground --key-file="$work/munge/key" --socket="$work/munge/socket" \
    --pid-file="$work/munge/pid" --log-file="$work/munge/log" --seed-file="$work/munge/seed" \
    >"$work/munged.log" 2>&1 &
daemons+=($!)
await 20 'the start of munge' test -S "$work/munge/socket"

host=$(hostname -s)
cat >"$work/slurm.conf" <<CONF
ClusterName=rowgram
SlurmctldHost=$host(127.0.0.1)
SlurmctldPort=$(port)
AuthType=auth/munge
AuthInfo=socket=$work/munge/socket,cred_expire=5
CredType=cred/munge
SlurmUser=root
SlurmdUser=root
StateSaveLocation=$work/state
SlurmdSpoolDir=$work/spool-%n
SlurmctldPidFile=$work/slurmctld.pid
SlurmdPidFile=$work/slurmd-%n.pid
SlurmctldLogFile=$work/slurmctld.log
SlurmdLogFile=$work/slurmd-%n.log
ProctrackType=proctrack/linuxproc
TaskPlugin=task/none
SwitchType=switch/none
MpiDefault=none
ReturnToService=2
SlurmctldTimeout=10
SlurmdTimeout=10
MessageTimeout=5
InactiveLimit=0
KillWait=2
SchedulerType=sched/backfill
SchedulerParameters=sched_interval=2,batch_sched_delay=0,requeue_delay=0
SelectType=select/cons_tres
SelectTypeParameters=CR_CPU
SlurmdParameters=config_overrides
JobRequeue=1
JobAcctGatherType=jobacct_gather/none
AccountingStorageType=accounting_storage/none
NodeName=n1 NodeHostname=$host NodeAddr=127.0.0.1 Port=$(port) CPUs=1 RealMemory=4000 State=UNKNOWN
NodeName=n2 NodeHostname=$host NodeAddr=127.0.0.1 Port=$(port) CPUs=1 RealMemory=4000 State=UNKNOWN
PartitionName=main Nodes=n1,n2 Default=YES MaxTime=INFINITE State=UP
CONF
# Nothing here needs control groups. Slurm 23.02 and later can do without; before, the first version's plugin
# does nothing until it is asked to.
version=$(slurmctld -V | sed 's/[^0-9.]*//')
if [[ $(printf '%s\n23.02\n' "$version" | sort -V | head -n 1) == 23.02 ]]; then
    echo 'CgroupPlugin=disabled' >"$work/cgroup.conf"
else
    echo 'CgroupPlugin=cgroup/v1' >"$work/cgroup.conf"
fi
export SLURM_CONF=$work/slurm.conf

slurmctld -D -c >"$work/ctld.out.log" 2>&1 &
daemons+=($!)
declare -A node
for name in n1 n2; do
    slurmd -D -N "$name" >"$work/$name.out.log" 2>&1 &
    node[$name]=$!
    daemons+=($!)
done
idle() { [[ $(sinfo --noheader --format=%T --nodes="$1") == idle ]]; }
await 25 'node n1 idle' idle n1
await 60 'node n2 idle' idle n2
printf 'slurm: %s, two nodes\n' "$(slurmctld -V)"

# Node n1 dies, and with it what runs there: daemon, step and work.
kill_n1() {
    local victims child step killed
    # The work on that node is known by its environment, which names the node and the folder; its step daemon is the parent. It stands still before
    # anything is killed, so that it cannot be over first.
    mapfile -t victims < <(
        cd /proc && grep -lz '^SLURMD_NODENAME=n1$' [0-9]*/environ 2>/dev/null |
            xargs --no-run-if-empty grep -lz "$work/" 2>/dev/null | cut -d/ -f1
    )
    for child in "${victims[@]}"; do
        [[ $(cat "/proc/$child/comm" 2>/dev/null) == slurmstepd ]] || kill -STOP "$child" 2>/dev/null || true
    done
    disown "${node[n1]}"
    kill -9 "${node[n1]}"
    # The daemon first, so that it cannot report its child's death as a failure of the job.
    killed=0
    for child in "${victims[@]}"; do
        [[ $(cat "/proc/$child/comm" 2>/dev/null) != slurmstepd ]] || continue
        step=$(awk '/^PPid:/ { print $2 }' "/proc/$child/status" 2>/dev/null || true)
        if [[ -n $step && $(cat "/proc/$step/comm" 2>/dev/null) == slurmstepd ]]; then
            kill -9 "$step" 2>/dev/null || true
        fi
        kill -9 "$child" 2>/dev/null && killed=$((killed + 1))
    done
    [[ $killed -gt 0 ]] || fail 'the work of node n1 was over before it could be killed'
}

n1_is_lost() { sinfo --noheader --format=%T --nodes=n1 | grep -q down; }

no_jobs_left() { [[ -z $(squeue --noheader) ]]; }
