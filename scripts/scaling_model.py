"""A model of the seconds of a training step: what was measured, spread over cores and GPUs."""

from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from typing import Any

PARTS = ("optics", "network", "optimizer", "data", "rest")

# None of these was measured: no GPU could be had.  They are of one H100 and of common networks.
ASSUMED: dict[str, tuple[float, str]] = {
    "gpu-flops": (67e12, "a GPU's peak in float32, FLOP/s"),
    "gpu-share": (0.3, "share of it that convolutions reach"),
    "gpu-launch": (8e-6, "seconds a PyTorch operator takes at least on a GPU"),
    "gpu-link": (300e9, "bytes a second between GPUs"),
    "cpu-link": (5e9, "bytes a second between processes of a machine"),
    "workers": (8.0, "data workers of a GPU"),
    "trials": (100.0, "trials of a search"),
    "overhead": (2.0, "seconds that a sampler and a launcher add to a trial"),
}


@dataclass(frozen=True)
class Experiment:
    """What was measured of an experiment.

    Attributes:
        name: of the experiment.
        one: seconds of each part of a step on one thread.
        two: likewise on two threads; None where they were not measured.
        at_once: likewise of two processes at once, on one thread each; or None.
        spread: quartiles' distance of a step over its median, of the worse of both measurements.
        start: seconds from the start of the training to its first step.
        flops: of the network in a step, floating-point operations.
        operators: that PyTorch runs in a step.
        parameters: of the network.
        batch: crops in a step.
    """

    name: str
    one: Mapping[str, float]
    two: Mapping[str, float] | None
    at_once: Mapping[str, float] | None
    spread: float
    start: float
    flops: float
    operators: float
    parameters: float
    batch: int

    @classmethod
    def of(cls, name: str, found: Mapping[str, Any]) -> "Experiment":
        """Take an experiment from what `scaling.py measure` wrote."""
        return cls(
            name,
            found["seconds"],
            found.get("seconds_two_threads"),
            found.get("seconds_of_two_at_once"),
            max(found["spread"], found.get("spread_two_threads", 0.0)),
            found["start_s"],
            found["flops"],
            found["operators"],
            found["parameters"],
            found["batch"],
        )

    def serial(self, part: str) -> float:
        """Return the seconds of a part that more threads do not shorten, by Amdahl's law; all of it
        where two threads were not measured.
        """
        one, two = self.one[part], (self.two or self.one)[part]
        return min(max(2.0 * two - one, 0.0), one)

    def on_threads(self, threads: int) -> dict[str, float]:
        """Return the seconds of each part of a step of one process with so many threads."""
        found = {}
        for part in PARTS:
            serial = self.serial(part)
            found[part] = serial + (self.one[part] - serial) / threads
        return found

    def crowding(self) -> float:
        """Return how many times longer a step takes where every core has a process of its own."""
        return max(sum((self.at_once or self.one).values()) / sum(self.one.values()), 1.0)

    def on_processes(self, processes: int, assumed: Mapping[str, float]) -> dict[str, float]:
        """Return the parts of a step of processes of one thread, which share their gradients."""
        found = {part: self.crowding() * seconds for part, seconds in self.one.items()}
        return {**found, "gradients": self._exchange(processes, assumed["cpu-link"])}

    def on_gpus(self, gpus: int, assumed: Mapping[str, float]) -> dict[str, float]:
        """Return the parts of a step of one process for each GPU.

        Operators run one after another, each for its launch at least: those of the optics and the
        network take that long together, or the network takes its arithmetic.
        """
        arithmetic = self.flops / (assumed["gpu-share"] * assumed["gpu-flops"])
        launches = self.operators * assumed["gpu-launch"]
        computed = max(arithmetic, launches)
        cut = self.one["data"] / max(assumed["workers"], 1.0)
        return {
            "launches" if launches > arithmetic else "network": computed,
            "data": max(cut - computed, 0.0),  # workers cut while the GPU computes
            "rest": self.one["rest"],
            "gradients": self._exchange(gpus, assumed["gpu-link"]),
        }

    def _exchange(self, processes: int, bytes_a_second: float) -> float:
        """Return the seconds in which processes in a ring sum their gradients."""
        share = 2.0 * (processes - 1) / processes
        return share * 4.0 * self.parameters / bytes_a_second


def measured_lines(experiments: Sequence[Experiment]) -> list[str]:
    """Return the table of what was measured, milliseconds of a step."""
    lines = [
        f"| measured | {' | '.join(f'{part}, ms' for part in PARTS)} | step, ms | crops/s |",
        f"|---|{'---|' * (len(PARTS) + 2)}",
    ]
    for e in experiments:
        for what, parts in (("1 thread", e.one), ("2 threads", e.two), ("2 at once", e.at_once)):
            if parts is None:
                continue
            total = sum(parts.values())
            crops = (2 if what == "2 at once" else 1) * e.batch / total
            numbers = " | ".join(f"{1e3 * parts[part]:.1f}" for part in PARTS)
            lines.append(f"| {e.name}, {what} | {numbers} | {1e3 * total:.0f} | {crops:.1f} |")
    return lines


def machine_lines(experiments: Sequence[Experiment], assumed: Mapping[str, float]) -> list[str]:
    """Return the table of trainings on machines."""
    lines = [
        "| computed | step, ms | crops/s | hours for 10⁶ crops | longest part |",
        "|---|---|---|---|---|",
    ]
    for e in experiments:
        for what, processes, parts in (
            ("2 cores, 1 process", 1, e.on_threads(2)),
            ("64 cores, 1 process", 1, e.on_threads(64)),
            ("64 cores, 64 processes", 64, e.on_processes(64, assumed)),
            ("1 GPU (assumed)", 1, e.on_gpus(1, assumed)),
            ("8 GPUs (assumed)", 8, e.on_gpus(8, assumed)),
        ):
            if "1 process" in what and e.two is None:
                continue
            total = sum(parts.values())
            crops = processes * e.batch / total
            longest = max(parts, key=parts.__getitem__)
            lines.append(
                f"| {e.name}, {what} | {1e3 * total:.0f} | {crops:.1f} "
                f"| {_hours(1e6 / crops / 3600)} "
                f"| {longest}, {100 * parts[longest] / total:.0f} % |"
            )
    return lines


def search_lines(experiments: Sequence[Experiment], assumed: Mapping[str, float]) -> list[str]:
    """Return the table of searches, each trial 1000 steps on one thread or one GPU."""
    trials = assumed["trials"]
    lines = [
        f"| search: {trials:.0f} trials of 1000 steps | at once | hours | speed-up |",
        "|---|---|---|---|",
    ]
    for e in experiments:
        alone = sum(e.one.values())
        crowded = alone * e.crowding()
        base = 0.0
        for what, at_once, step in (
            ("1 core", 1, alone),
            ("2 cores", 2, crowded),
            ("64 cores", 64, crowded),
            ("1 GPU (assumed)", 1, sum(e.on_gpus(1, assumed).values())),
            ("8 GPUs (assumed)", 8, sum(e.on_gpus(1, assumed).values())),
        ):
            rounds = -(-trials // at_once)
            hours = rounds * (1000.0 * step + e.start + assumed["overhead"]) / 3600.0
            base = base or hours
            lines.append(f"| {e.name}, {what} | {at_once} | {_hours(hours)} | {base / hours:.3g} |")
    return lines


def _hours(hours: float) -> str:
    """Return hours with two digits, and all digits before the point."""
    return f"{hours:.0f}" if hours >= 10.0 else f"{hours:.2g}"
