#!/usr/bin/env bash
# SLURM with one node on this machine, a sweep through it, and what became of every job. For root on Debian or Ubuntu:
#     apt-get install -y --no-install-recommends slurmctld slurmd slurm-client munge
#     tests/launchers/slurm_single_node.sh [python]
# Its state lies in a temporary folder; every daemon that it started ends with it. Results of one run: docs/scaling.md.
set -euo pipefail

PYTHON=$(realpath -s "${1:-python}")
ROOT=$(cd "$(dirname "$0")/../.." && pwd)
STATE=$(mktemp -d)
HOST=$(hostname -s)
CORES=$(nproc)
MEMORY=$(awk '/MemTotal/ {print int($2 / 1024 * 0.9)}' /proc/meminfo)
chmod 755 "$STATE"

finish() {
    scancel --partition=all 2>/dev/null || true
    for _ in $(seq 20); do
        [ -z "$(squeue --noheader 2>/dev/null)" ] && break
        sleep 1
    done
    for name in slurmd slurmctld munged; do
        [ -f "$STATE/$name.pid" ] && kill "$(cat "$STATE/$name.pid")" 2>/dev/null || true
    done
    sleep 2
    rm -rf "$STATE"
}
trap finish EXIT

# munge, which signs what the daemons tell each other. It wants folders of its own user that nobody else can write to.
mkdir -p "$STATE/munge"
dd if=/dev/urandom bs=1 count=1024 of="$STATE/munge/munge.key" status=none
chmod 400 "$STATE/munge/munge.key"
chmod 755 "$STATE/munge"
munged --key-file="$STATE/munge/munge.key" --socket="$STATE/munge/socket" --pid-file="$STATE/munged.pid" \
    --log-file="$STATE/munge/log" --seed-file="$STATE/munge/seed" --force

# No accounting and no cgroups: daemons and jobs are plain processes. A requeued job waits for cred_expire (120 s by default).
cat > "$STATE/slurm.conf" <<CONF
ClusterName=single
SlurmctldHost=$HOST(127.0.0.1)
SlurmUser=root
AuthType=auth/munge
AuthInfo=socket=$STATE/munge/socket,cred_expire=20
CredType=cred/munge
MpiDefault=none
ProctrackType=proctrack/linuxproc
TaskPlugin=task/none
JobAcctGatherType=jobacct_gather/none
AccountingStorageType=accounting_storage/none
SchedulerType=sched/backfill
SchedulerParameters=sched_interval=5
SelectType=select/cons_tres
SelectTypeParameters=CR_Core_Memory
ReturnToService=2
KillWait=10
MinJobAge=60
StateSaveLocation=$STATE/ctld
SlurmdSpoolDir=$STATE/spool
SlurmctldPidFile=$STATE/slurmctld.pid
SlurmdPidFile=$STATE/slurmd.pid
SlurmctldLogFile=$STATE/slurmctld.log
SlurmdLogFile=$STATE/slurmd.log
NodeName=$HOST NodeAddr=127.0.0.1 CPUs=$CORES RealMemory=$MEMORY State=UNKNOWN
PartitionName=all Nodes=ALL Default=YES MaxTime=INFINITE DefMemPerCPU=$((MEMORY / CORES)) State=UP
CONF
mkdir -p "$STATE/ctld" "$STATE/spool"
export SLURM_CONF="$STATE/slurm.conf"
slurmctld
slurmd
for _ in $(seq 30); do
    sinfo --noheader --format=%T | grep -q idle && break
    sleep 1
done
sinfo --version
sinfo

# Besides those of single_node.sh, a job whose time is over after step 4 (SIGUSR2, which SLURM sends before the limit) and one
# that runs into a real limit of two minutes.
. "$ROOT/tests/launchers/single_node.sh"
LAUNCHER=(launcher=slurm hydra.launcher.gpus_per_node=null hydra.launcher.cpus_per_task=1 hydra.launcher.array_parallelism=2
    hydra.launcher.timeout_min=2 hydra.launcher.signal_delay_s=30 hydra.launcher.max_num_timeout=10)
ROWS="preempted:{set:['$SPY','+callbacks.spy.step=4','+callbacks.spy.name=SIGUSR2']},\
long:{set:['$SPY','+callbacks.spy.pause_s=1.5','max_steps=60']},"
preemptions() {
    grep -h -E 'timed-out|preempted|Requeued' "$STATE"/sweep/.submitit/*/*.out | sed 's/.*\(Caught\|Requeued\)/\1/' || true
}

# What the queue looks like meanwhile.
( for _ in $(seq 4); do sleep 45; squeue --array --format='%.8i %.10T %.6M %.9l'; done ) &
sweep_through "the sweep"
wait
preemptions
report
sweep_through "the same command once more"
report
