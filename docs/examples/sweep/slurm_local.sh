#!/bin/sh
# Slurm on this machine alone, for as long as a command runs: sh docs/examples/sweep/slurm_local.sh COMMAND [ARGUMENT ...]
# Needs slurmctld, slurmd, munged and the commands of Slurm (on Debian the package slurm-wlm), but neither root, nor systemd, nor cgroups.
set -eu
dir=$(mktemp -d "${TMPDIR:-/tmp}/slurm.XXXXXX")
host=$(hostname -s)
PATH=$PATH:/usr/sbin

stop() {
    trap - EXIT
    [ -z "${command:-}" ] || kill "$command" 2> /dev/null || true
    scancel --user="$(id -un)" 2> /dev/null || true
    for daemon in slurmd slurmctld munged; do
        pid=$(cat "$dir/$daemon.pid" 2> /dev/null) || continue
        kill "$pid" && while kill -0 "$pid" 2> /dev/null; do sleep 0.1; done
    done
    rm -rf "$dir"
}
trap stop EXIT
trap 'exit 130' INT TERM

chmod 711 "$dir"
dd if=/dev/urandom of="$dir/key" bs=1 count=128 2> /dev/null
chmod 600 "$dir/key"
cat > "$dir/slurm.conf" << END
ClusterName=local
SlurmctldHost=$host(127.0.0.1)
SlurmctldPort=16817
SlurmdPort=16818
SlurmUser=$(id -un)
SlurmdUser=$(id -un)
AuthInfo=socket=$dir/munge.socket,cred_expire=10
StateSaveLocation=$dir/state
SlurmdSpoolDir=$dir/spool
SlurmctldPidFile=$dir/slurmctld.pid
SlurmdPidFile=$dir/slurmd.pid
SlurmctldLogFile=$dir/slurmctld.log
SlurmdLogFile=$dir/slurmd.log
ProctrackType=proctrack/linuxproc
TaskPlugin=task/none
JobAcctGatherType=jobacct_gather/none
AccountingStorageType=accounting_storage/none
MpiDefault=none
SelectType=select/cons_tres
SelectTypeParameters=CR_Core
SchedulerParameters=batch_sched_delay=0
MinJobAge=3600
NodeName=$host NodeAddr=127.0.0.1 CPUs=$(nproc)
PartitionName=all Nodes=ALL Default=YES
END
mkdir "$dir/state" "$dir/spool"
export SLURM_CONF="$dir/slurm.conf"
munged --key-file="$dir/key" --socket="$dir/munge.socket" --pid-file="$dir/munged.pid" --log-file="$dir/munged.log" \
    --seed-file="$dir/munged.seed"
slurmctld
slurmd
tries=0
until [ "$(sinfo --noheader --format=%T 2> /dev/null)" = idle ]; do
    tries=$((tries + 1))
    if [ $tries -gt 100 ]; then
        tail -n 5 "$dir"/*.log >&2
        exit 1
    fi
    sleep 0.2
done
"$@" <&0 &
command=$!
wait "$command"
