"""What a search has found so far: all designs, their forms, and the best of them as lenses."""

from dataclasses import dataclass

import torch
from torch import Tensor

from dolens.lens_search.arrangement import Arrangement
from dolens.lens_search.designed_lens import designed_lens
from dolens.lens_search.designs import Designs
from dolens.lens_search.form_coordinates import form_coordinates
from dolens.lens_search.forms import distinct, form_numbers
from dolens.lens_search.found import FoundLens
from dolens.lens_search.merit import SearchMerit
from dolens.lens_search.search import SearchPlan, Step, with_step
from dolens.lens_search.specification import Specification

_UM = 1e3


@dataclass(frozen=True)
class Course:
    """Times, merits and forms of all designs.

    Attributes:
        seconds: s, when each was known, (n,).
        merits: µm, (n,).
        forms: number of the form of each, (n,), from 0, the best.
        starts: number of the start of each, (n,).
    """

    seconds: Tensor
    merits: Tensor
    forms: Tensor
    starts: Tensor


class Finds:
    """Collects the steps of a search.

    Args:
        specification: of the search.
        plan: of the search.

    Attributes:
        found: the best forms as lenses, the best first; see `rank`.
        features: powers of the elements of every start, by the number of its batch's first start.
        iterations: of all lenses together.
    """

    def __init__(self, specification: Specification, plan: SearchPlan) -> None:
        self.specification, self.plan = specification, plan
        self.found: list[FoundLens] = []
        self.features: dict[int, Tensor] = {}
        self.iterations = 0
        self._pool: dict[Arrangement, Designs] = {}
        self._course: Course | None = None
        self._all: list[tuple[Designs, float]] = []

    def add(self, step: Step, seconds: float) -> None:
        """Add a step that was known at a time."""
        self.iterations += step.iterations
        self._course = None
        if len(step.features):
            self.features[step.first] = step.features
        self._all += [(designs, seconds) for designs in step.designs if len(designs.values)]
        self._pool = with_step(self._pool, step, self.specification, self.plan)

    @property
    def designs(self) -> int:
        """Return how many designs keep the specification."""
        return sum(len(designs.values) for designs, _ in self._all)

    @property
    def merits(self) -> Tensor:
        """Return the mean RMS spots of all forms, µm, the best first."""
        parts = [designs.merit for designs in self._pool.values()]
        return _UM * torch.cat(parts or [torch.zeros(0)]).sort().values

    @property
    def forms(self) -> int:
        """Return how many different forms there are."""
        return len(self.merits)

    def forms_within(self, share: float) -> int:
        """Return how many forms are worse than the best by a share at most."""
        merits = self.merits
        return int((merits <= (1.0 + share) * merits[:1]).sum())

    def report(self) -> str:
        """Return a line for the log."""
        if not self.forms:
            return f"{self.iterations} iterations, no lens yet"
        return (
            f"best mean RMS spot {float(self.merits[0]):.3f} µm; {self.designs} lenses of "
            f"{self.forms} forms, {self.forms_within(0.25)} within 25 % of the best"
        )

    def rank(self, count: int) -> None:
        """Make lenses of the best forms; lenses that differ in the place of the stop alone are one
        form.
        """
        ranked = sorted(
            (float(merit), arrangement.stop, arrangement.within, row, arrangement)
            for arrangement, designs in self._pool.items()
            for row, merit in enumerate(designs.merit)
        )
        lenses = []
        for merit, _, _, row, arrangement in ranked[: 2 * count]:
            designs = self._pool[arrangement]
            lens = designed_lens(
                arrangement, self.specification, designs.values[row], f"form {len(lenses) + 1}"
            )
            spots = tuple(_UM * float(spot) for spot in designs.spots[row])
            start = int(designs.starts[row])
            lenses.append(FoundLens(lens, _UM * merit, spots, start, designs.history[row]))
        self.found = [form.best for form in distinct(lenses)][:count]

    def course(self) -> Course:
        """Return when each design was found, and its form; it is worked out once for a step."""
        if self._course is None:
            self._course = self._whole_course()
        return self._course

    def _whole_course(self) -> Course:
        seconds, merits, starts, numbers = [], [], [], []
        first = 0
        for arrangement in self._pool:
            mine = [(d, s) for d, s in self._all if d.arrangement == arrangement]
            designs = Designs.joined([d for d, _ in mine])
            merit = SearchMerit.of(arrangement, self.specification, 1, 1)
            own = form_numbers(form_coordinates(designs.arrays(merit)), designs.merit)
            numbers.append(own + first)
            first += int(own.max()) + 1
            merits.append(_UM * designs.merit)
            starts.append(designs.starts)
            seconds += [torch.full((len(d.values),), s) for d, s in mine]
        merit_of_all, form = torch.cat(merits), torch.cat(numbers)
        best = torch.full((first,), torch.inf, dtype=torch.float64)
        best = best.scatter_reduce(0, form, merit_of_all, "amin")
        place = torch.empty(first, dtype=torch.int64)
        place[best.argsort(stable=True)] = torch.arange(first)
        return Course(torch.cat(seconds), merit_of_all, place[form], torch.cat(starts))
