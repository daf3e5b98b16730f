#!/bin/sh
# The tasks of a sweep as a Slurm array: sh docs/examples/sweep/slurm.sh MANIFEST [OPTION OF sbatch ...]
# Tasks that are done end at once, and others go on where they were stopped, so the same command again does what is left.
#SBATCH --job-name=sweep
#SBATCH --cpus-per-task=2
#SBATCH --requeue
set -eu
if [ -n "${SLURM_ARRAY_TASK_ID:-}" ]; then
    exec train --task "$1" --index "$SLURM_ARRAY_TASK_ID" --threads "${SLURM_CPUS_PER_TASK:-1}"
fi
manifest=$1
shift
last=$(($(wc -l < "$manifest") - 1))
logs=$(dirname "$manifest")/logs
mkdir -p "$logs"
exec sbatch --array="0-$last" --output="$logs/slurm-%A_%a.txt" --open-mode=append "$@" "$0" "$manifest"
