"""The tasks of a sweep on HyperQueue, which is started on this machine for as long: python hyperqueue_local.py MANIFEST [CORES [THREADS]]

Needs the package `hyperqueue` and `train` on the path. Tasks that are done end at once, and others go on where they were stopped, so the
same command again does what is left.
"""

import json
import os
import signal
import sys
import tempfile
from pathlib import Path

from hyperqueue import Job, LocalCluster
from hyperqueue.cluster import WorkerConfig
from hyperqueue.ffi.protocol import ResourceRequest

manifest = Path(sys.argv[1]).resolve()
cores = int(sys.argv[2]) if len(sys.argv) > 2 else os.cpu_count()
threads = int(sys.argv[3]) if len(sys.argv) > 3 else 1
logs = manifest.parent / "logs"
logs.mkdir(exist_ok=True)

job = Job(name="sweep", max_fails=None)
task = 'exec train --task "$0" --index "$1" --threads "$2" 2>> "$3"'
for index, line in enumerate(manifest.read_text().splitlines()):
    log = logs / f"{json.loads(line)['id']}.txt"
    arguments = [str(manifest), str(index), str(threads), str(log)]
    job.program(["sh", "-c", task, *arguments], stdout=None, stderr=None, resources=ResourceRequest(cpus=threads))
# Stopped as by Ctrl-C, so that tasks save.
signal.signal(signal.SIGTERM, signal.default_int_handler)
with tempfile.TemporaryDirectory() as server, LocalCluster(server, WorkerConfig(cores=cores)) as cluster:
    client = cluster.client()
    done = client.wait_for_jobs([client.submit(job)], raise_on_error=False)
sys.exit(0 if done else 1)
