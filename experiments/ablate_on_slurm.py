"""An ablation on a SLURM cluster: request workers with dask-jobqueue, then run ``lio-jax ablate`` on them.

    python experiments/ablate_on_slurm.py SPEC.yaml --out DIR --jobs 8 [--partition P] [--cores 2]
        [--memory 4GB] [--walltime 04:00:00] [--gpus 1] [--interface ib0] [--prologue LINE]
        [--report] [--retry-failed] [--print-script]

Each job is one worker. Run it on a machine that can submit jobs and that the jobs can reach (a login node, or
a job of its own). DIR and the recordings must be on a file system that all of them see. --print-script prints
the job's script and submits nothing. The output of the jobs is in DIR.jobs. Jobs that end at their walltime
are replaced, and a killed command continues where it was. Needs ``pip install 'lio-jax[cluster]'``.
"""

import argparse
import sys
from pathlib import Path
from typing import Any

from lio_jax.core.errors import LioJaxError


def main() -> int:
    """Submit the jobs and run the ablation."""
    options = _options()
    try:
        from dask_jobqueue import SLURMCluster
    except ImportError:
        print(
            "ablate_on_slurm: dask-jobqueue is not installed: pip install 'lio-jax[cluster]'.",
            file=sys.stderr,
        )
        return 1
    with SLURMCluster(**_job(options)) as cluster:
        if options.print_script:
            print(cluster.job_script())
            return 0
        # replaces jobs that have ended
        cluster.adapt(minimum=options.jobs, maximum=options.jobs)
        from lio_jax.commands.ablate import ablate

        try:
            ablate(options.spec, options.out, cluster.scheduler_address, options.report, options.retry_failed)
        except LioJaxError as error:
            print(f"ablate_on_slurm: {error}", file=sys.stderr)
            return 1
    return 0


def _job(options: argparse.Namespace) -> dict[str, Any]:
    """Return the arguments with which SLURMCluster writes a job's script."""
    return {
        "queue": options.partition,
        "cores": options.cores,
        # one worker with one thread per job: a run uses the cores by XLA's own threads, and one GPU
        "processes": 1,
        "worker_extra_args": ["--nthreads", "1", "--no-dashboard"],
        "memory": options.memory,
        "walltime": options.walltime,
        "interface": options.interface,
        "job_name": "lio-jax-ablate",
        "python": sys.executable,
        "job_extra_directives": [f"--gres=gpu:{options.gpus}"] * (options.gpus > 0),
        "job_script_prologue": options.prologue,
        "log_directory": f"{options.out}.jobs",
        "scheduler_options": {"dashboard_address": "127.0.0.1:0"},
    }


def _options() -> argparse.Namespace:
    parser = argparse.ArgumentParser(
        description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter
    )
    parser.add_argument("spec", type=Path)
    parser.add_argument("--out", type=Path, required=True)
    parser.add_argument("--jobs", type=int, default=4)
    parser.add_argument("--partition")
    parser.add_argument("--cores", type=int, default=2)
    parser.add_argument("--memory", default="4GB")
    parser.add_argument("--walltime", default="04:00:00")
    parser.add_argument("--gpus", type=int, default=0, help="per job")
    parser.add_argument("--interface", help="network interface that the jobs reach, such as ib0")
    parser.add_argument("--prologue", action="append", default=[], help="shell line before the worker starts")
    parser.add_argument("--report", action="store_true")
    parser.add_argument("--retry-failed", action="store_true")
    parser.add_argument("--print-script", action="store_true")
    return parser.parse_args()


if __name__ == "__main__":
    sys.exit(main())
