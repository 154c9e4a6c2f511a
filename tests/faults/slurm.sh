#!/usr/bin/env bash
# A Slurm of one node on this machine, for the tests and for whoever wants to try hydra/launcher=slurm. As root:
#   tests/faults/slurm.sh start FOLDER   everything it writes is in FOLDER; then: export SLURM_CONF=FOLDER/slurm.conf
#   tests/faults/slurm.sh node FOLDER    starts the node's daemon again
#   tests/faults/slurm.sh stop FOLDER
# It installs, where they are missing and apt-get is there, Debian's packages slurm-wlm and munge. Their own services are
# not started, and nothing in /etc is changed. The node has the processors of this machine, and at least two.
set -euo pipefail
what=$1 folder=$(realpath -m "$2")
export SLURM_CONF=$folder/slurm.conf

installed() { command -v slurmctld slurmd munged sbatch > /dev/null; }

node() { slurmd -N node1; }

start() {
  test "$(id -u)" = 0 || { echo "root alone may start Slurm's daemons" >&2; exit 3; }
  export PATH=$PATH:/usr/sbin:/sbin
  if ! installed; then
    command -v apt-get > /dev/null || { echo "Slurm is not installed, and there is no apt-get" >&2; exit 3; }
    policy=/usr/sbin/policy-rc.d # which keeps services down while packages are installed
    test -e $policy && policy=/dev/null || { printf '#!/bin/sh\nexit 101\n' > $policy; chmod +x $policy; }
    { apt-get update && DEBIAN_FRONTEND=noninteractive apt-get install -y --no-install-recommends slurm-wlm munge; } \
      > "$folder.apt" 2>&1 || true
    test $policy = /dev/null || rm $policy
    installed || { echo "apt-get did not install slurm-wlm and munge" >&2; exit 3; }
  fi
  mkdir -p "$folder"/{state,spool,munge}
  chmod 755 "$folder" "$folder/munge"
  head -c 1024 /dev/urandom > "$folder/munge/key"
  chmod 400 "$folder/munge/key"
  munged --force --key-file="$folder/munge/key" --socket="$folder/munge/socket" --pid-file="$folder/munge/pid" \
    --log-file="$folder/munge/log" --seed-file="$folder/munge/seed"
  read -r controller daemon < <(python3 - <<'PORTS'
import socket
ends = [socket.create_server(("127.0.0.1", 0)) for _ in range(2)]
print(*(end.getsockname()[1] for end in ends))
PORTS
)
  cpus=$(nproc)
  cat > "$SLURM_CONF" <<CONF
ClusterName=bench
SlurmctldHost=$(hostname -s)(127.0.0.1)
SlurmctldPort=$controller
SlurmUser=root
SlurmdUser=root
AuthType=auth/munge
AuthInfo=socket=$folder/munge/socket,cred_expire=5
StateSaveLocation=$folder/state
SlurmdSpoolDir=$folder/spool
SlurmctldPidFile=$folder/slurmctld.pid
SlurmdPidFile=$folder/slurmd.pid
SlurmctldLogFile=$folder/slurmctld.log
SlurmdLogFile=$folder/slurmd.log
ProctrackType=proctrack/linuxproc
TaskPlugin=task/none
MpiDefault=none
SelectType=select/cons_tres
SelectTypeParameters=CR_Core
SchedulerParameters=sched_interval=1,batch_sched_delay=1,sched_min_interval=100000
ReturnToService=2
SlurmdTimeout=10
KillWait=10
MinJobAge=60
AccountingStorageType=accounting_storage/none
JobAcctGatherType=jobacct_gather/none
NodeName=node1 NodeHostname=$(hostname -s) NodeAddr=127.0.0.1 Port=$daemon CPUs=$((cpus < 2 ? 2 : cpus)) State=UNKNOWN
PartitionName=main Nodes=node1 Default=YES MaxTime=60 State=UP
CONF
  slurmctld
  node
  for _ in $(seq 60); do
    sinfo --noheader --format=%T 2> /dev/null | grep -q idle && exit 0
    sleep 0.5
  done
  tail -n 5 "$folder"/slurmctld.log "$folder"/slurmd.log >&2
  exit 1
}

stop() {
  scancel --me --quiet 2> /dev/null || true
  for _ in $(seq 40); do
    test -z "$(squeue --noheader 2> /dev/null)" && break
    sleep 0.5
  done
  for name in slurmd slurmctld munged slurmstepd; do
    for pid in $(pgrep -x "$name"); do # those of this folder alone
      if tr '\0' '\n' < "/proc/$pid/environ" | grep -qx "SLURM_CONF=$SLURM_CONF"; then kill -9 "$pid"; fi
    done
  done
}

"$what"
