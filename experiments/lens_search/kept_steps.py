"""Steps of a search are kept on disk, so that one that was stopped goes on where it was."""

import hashlib
import json
import time
from collections.abc import Callable, Iterator, Sequence
from dataclasses import asdict
from pathlib import Path
from typing import Any

import torch

from dolens.errors import InputError
from dolens.files import written_whole
from dolens.lens_search.arrangement import Arrangement
from dolens.lens_search.designs import Designs
from dolens.lens_search.glass.choice import chosen_glasses
from dolens.lens_search.search import SearchPlan, Step
from dolens.lens_search.specification import Specification
from dolens.tasks import TaskMap


class KeptSteps:
    """Reads the steps of earlier tries from a folder, and writes those of this one.

    Args:
        folder: of the steps.
        specification: of the search.
        plan: of the search; a folder of another search is refused.

    Attributes:
        seconds_before: wall time that earlier tries took to find what is read.

    Raises:
        InputError: the folder holds the steps of another search.
    """

    def __init__(self, folder: Path, specification: Specification, plan: SearchPlan) -> None:
        self.folder = folder
        self.seconds_before = 0.0
        self._number = 0
        choice = specification.glass_choice
        # Glasses are kept by their numbers: a catalogue that has changed has others.
        names = choice and chosen_glasses(choice, tuple(specification.wavelengths)).names
        text = json.dumps([asdict(specification), asdict(plan), names], sort_keys=True)
        self._digest = hashlib.sha256(text.encode()).hexdigest()
        self._started = time.perf_counter()

    def map(self, map_tasks: TaskMap) -> TaskMap:
        """Return a map that leaves out tasks whose results are there."""

        def mapped(
            function: Callable[[Any], Any], tasks: Sequence[Any], name: str
        ) -> Iterator[Any]:
            done = []
            for _ in tasks:
                path = self._path(self._number + len(done))
                if not path.is_file():
                    break
                done.append(self._read(path))
            for step in done:
                self._number += 1
                yield step
            for step in map_tasks(function, tasks[len(done) :], name):
                self._write(self._path(self._number), step)
                self._number += 1
                yield step

        return mapped

    def _path(self, number: int) -> Path:
        return self.folder / f"step_{number:05d}.pt"

    def _write(self, path: Path, step: Step) -> None:
        self.folder.mkdir(parents=True, exist_ok=True)
        plain = {
            "digest": self._digest,
            "seconds": self.seconds_before + time.perf_counter() - self._started,
            "features": step.features,
            "first": step.first,
            "iterations": step.iterations,
            "continuous": step.continuous,
            "designs": [
                {
                    "groups": list(designs.arrangement.groups),
                    "stop": designs.arrangement.stop,
                    "within": designs.arrangement.within,
                    "terms": list(designs.arrangement.terms),
                    "values": designs.values,
                    "spots": designs.spots,
                    "violation": designs.violation,
                    "starts": designs.starts,
                    "history": [list(words) for words in designs.history],
                }
                for designs in step.designs
            ],
        }
        with written_whole(path) as aside:
            torch.save(plain, aside)

    def _read(self, path: Path) -> Step:
        plain = torch.load(path, weights_only=True)
        if plain["digest"] != self._digest:
            raise InputError(
                f"{path.parent}: holds steps of a search with another specification or plan, or "
                "with other glasses; remove the folder, or choose another run folder"
            )
        self.seconds_before = max(self.seconds_before, float(plain["seconds"]))
        designs = tuple(
            Designs(
                Arrangement(
                    tuple(part["groups"]), part["stop"], part["within"], tuple(part["terms"])
                ),
                part["values"],
                part["spots"],
                part["violation"],
                part["starts"],
                tuple(tuple(words) for words in part["history"]),
            )
            for part in plain["designs"]
        )
        return Step(
            designs, plain["features"], plain["first"], plain["iterations"], plain["continuous"]
        )
