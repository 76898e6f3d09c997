"""These settings describe the measurements that tell what limits a pose fit."""

from collections.abc import Mapping, Sequence
from dataclasses import dataclass, field
from typing import Any

from dolens.errors import InputError
from dolens.experiments.checks import check_count, check_not_negative, check_positive
from dolens.sensor.pixels import Sensor


@dataclass(frozen=True)
class ComparedImages:
    """Gives settings of the images that a pose is compared by.

    Attributes:
        imagers: name → settings of `SpotImager`; the first is used where rays are not the question.
        slopes: settings that differ from the first imager's for derivatives.
        centroid_weight: μ of S21, 1/mm².

    Raises:
        InputError: there is no imager.
    """

    imagers: Mapping[str, Mapping[str, Any]]
    slopes: Mapping[str, Any] = field(default_factory=dict)
    centroid_weight: float = 1.0

    def __post_init__(self) -> None:
        if not self.imagers:
            raise InputError("imagers: give at least one")
        check_not_negative("centroid_weight", self.centroid_weight)


@dataclass(frozen=True)
class PhotonLevels:
    """Describes measurements with more and more light.

    Attributes:
        levels: photons of a source.
        measurements: with other photons, of each level.

    Raises:
        InputError: fewer than 2 measurements.
    """

    levels: Sequence[float]
    measurements: int = 20

    def __post_init__(self) -> None:
        object.__setattr__(self, "levels", tuple(int(level) for level in self.levels))
        for level in self.levels:
            check_count("levels", level)
        if self.measurements < 2:
            raise InputError(f"measurements: {self.measurements}; allowed: 2 or more")


@dataclass(frozen=True)
class RayCounts:
    """Describes images by more and more rays.

    Attributes:
        counts: rays of a source.
        patterns: of rays, of each count.
        reference_photons: of the measurement that errors by rays are judged by.

    Raises:
        InputError: no pattern.
    """

    counts: Sequence[float]
    patterns: int = 4
    reference_photons: float = 200_000_000

    def __post_init__(self) -> None:
        object.__setattr__(self, "counts", tuple(int(count) for count in self.counts))
        object.__setattr__(self, "reference_photons", int(self.reference_photons))
        check_count("patterns", self.patterns)
        check_count("reference_photons", self.reference_photons)
        for count in self.counts:
            check_count("counts", count)


@dataclass(frozen=True)
class BasinSettings:
    """Describes fits by the same stages from starts whose errors in two variables make a grid.

    Attributes:
        along: two variables' names → errors of their starts, degrees or mm; the first is drawn
            across, the second upwards.
        stages: settings of `Stage`, in turn.
        centroid_weights: μ of S21, 1/mm²; a grid of fits for each.
        sensor: the pixels; None: the experiment's.
        imager: settings of `SpotImager`.
        photons: of each source.
    """

    along: Mapping[str, Sequence[float]]
    stages: Sequence[Mapping[str, Any]]
    centroid_weights: Sequence[float] = (1.0,)
    sensor: Sensor | None = None
    imager: Mapping[str, Any] = field(default_factory=dict)
    photons: float = 1_000_000

    def __post_init__(self) -> None:
        check_positive("photons", self.photons)
        for weight in self.centroid_weights:
            check_not_negative("basin.centroid_weights", weight)
