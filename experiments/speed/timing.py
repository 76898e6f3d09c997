"""Times of contenders that take turns, and the memory that they need."""

import gc
import statistics
import time
from collections.abc import Callable, Mapping

import torch
from torch.profiler import ProfilerActivity, profile


def by_turns(
    calls: Mapping[str, Callable[[], object]], seconds: float, rounds: int = 3
) -> dict[str, float]:
    """Return the median time of each call, s.

    Calls run by turns, so that a phase in which the machine is slow meets all of them, each at
    least `rounds` times and on until `seconds` are spent.  A first turn is not counted.
    """
    times: dict[str, list[float]] = {name: [] for name in calls}
    for call in calls.values():
        call()
    began, turn = time.perf_counter(), 0
    while turn < rounds or time.perf_counter() - began < seconds:
        for name, call in calls.items():
            started = time.perf_counter()
            call()
            times[name].append(time.perf_counter() - started)
        turn += 1
    return {name: statistics.median(values) for name, values in times.items()}


def peak_megabytes(call: Callable[[], object]) -> float:
    """Return the peak memory of the CPU tensors of a call, MB.

    Added up from the allocator's own events; what a kernel keeps to itself is not among them.
    """
    gc.collect()
    with profile(activities=[ProfilerActivity.CPU], profile_memory=True) as run:
        call()
    held = most = 0
    for event in run.profiler.kineto_results.events():
        if event.name() == "[memory]" and event.device_type() == torch.autograd.DeviceType.CPU:
            held += event.nbytes()
            most = max(most, held)
    return most / 1e6
