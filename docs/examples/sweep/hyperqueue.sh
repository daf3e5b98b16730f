#!/bin/sh
# The tasks of a sweep on HyperQueue: sh docs/examples/sweep/hyperqueue.sh MANIFEST [OPTION OF hq submit ...]
# Tasks that are done end at once, and others go on where they were stopped, so the same command again does what is left.
set -eu
manifest=$1
shift
last=$(($(wc -l < "$manifest") - 1))
exec hq submit --name sweep --array="0-$last" --cpus=2 "$@" -- \
    sh -c 'exec train --task "$0" --index "$HQ_TASK_ID" --threads 2' "$manifest"
