"""Jobs as tasks of a Ray cluster, or of one that is begun here for this sweep."""

import logging
import os
from collections.abc import Iterator, Sequence
from contextlib import AbstractContextManager
from types import ModuleType

from hydra.core.utils import JobReturn

from dolens.errors import one_line
from dolens.experiments.ray_cluster import joined_cluster, local_cluster
from dolens.experiments.sweeps.job import Elsewhere, SweepJob
from dolens.experiments.sweeps.shares import given_threads

logger = logging.getLogger(__name__)


def in_ray_tasks(
    jobs: Sequence[SweepJob],
    address: str | None = None,
    num_cpus: int | None = None,
    num_gpus: float = 0,
    max_retries: int = 1,
) -> Iterator[tuple[SweepJob, JobReturn]]:
    """Run jobs as tasks of Ray's.

    All nodes must see the folder of the sweep, and have the same packages.

    Args:
        jobs: to run.
        address: of a cluster; `auto`: the one that runs on this machine; None: RAY_ADDRESS, or else
            a cluster of this machine alone that ends with the sweep.
        num_cpus: cores, and so threads, of each job; None: its `threads`, or else the cluster's
            cores shared out among the jobs.
        num_gpus: of each job; several jobs share a GPU where this is a part of 1.
        max_retries: so often a job whose process or node was lost is repeated, from its last
            checkpoint.

    Raises:
        InputError: Ray is not installed, or there is no cluster at the address.
    """
    if not jobs:
        return
    with _cluster(address) as ray:
        share = num_cpus or given_threads(jobs) or _cores_of_a_job(ray, len(jobs))
        task = ray.remote(num_cpus=share, num_gpus=num_gpus, max_retries=max_retries)(_run)
        logger.info("%d tasks of Ray, of %d core%s each", len(jobs), share, "s"[: share > 1])
        running = {task.remote(Elsewhere(job)): job for job in jobs}
        while running:
            (ended, *_), _ = ray.wait(list(running), num_returns=1)
            job = running.pop(ended)
            try:
                result = ray.get(ended)
            except ray.exceptions.RayError as error:
                last = [line for line in str(error).splitlines() if line.strip()] or [""]
                lost = isinstance(error, ray.exceptions.WorkerCrashedError)
                reason = last[0] if lost else last[-1]
                result = job.failed(one_line(f"{type(error).__name__}: {reason}"))
            yield job, result


def _run(job: Elsewhere) -> JobReturn:
    return job()


def _cluster(address: str | None) -> AbstractContextManager[ModuleType]:
    address = address or os.environ.get("RAY_ADDRESS")
    if address is None or address == "local":
        return local_cluster("hydra/launcher=ray")
    return joined_cluster(f"hydra.launcher.address={address}", address)


def _cores_of_a_job(ray: ModuleType, jobs: int) -> int:
    """Return the cores of the cluster for each job, no more than one node has."""
    nodes = [int(node["Resources"].get("CPU", 0)) for node in ray.nodes() if node["Alive"]]
    return max(1, min(sum(nodes) // jobs, max(nodes, default=1)))
