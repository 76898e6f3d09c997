"""The merit function of a lens with states: all of them together are one least-squares problem.

Each state is a merit function of the lens in that state.  A parameter that states share has columns
in the rows of each, a state's own in that state's rows alone; the linear models of the states are
made apart, over the parameters that each has, and joined in the variables.
"""

import math
from collections.abc import Mapping, Sequence
from dataclasses import dataclass

import torch
from torch import Tensor

from dolens.errors import InputError
from dolens.optics.autograd import jacobian_of
from dolens.optics.lens import Lens
from dolens.optics.lens_states import state_temperature, values_there
from dolens.optics.parameter_names import STATES, names_of_state, split_state, values_in_state
from dolens.optimize.image_quality import ImageQuality, QualityValues
from dolens.optimize.linear_least_squares import LinearModel
from dolens.optimize.merit import MeritFunction, OperandValue
from dolens.optimize.variables import DesignVariables


class VariablesInState:
    """Gives the design variables of a lens as the lens in one of its states has them.

    Args:
        variables: of the lens.
        lens: with its states.
        state: name of one.
    """

    def __init__(self, variables: DesignVariables, lens: Lens, state: str) -> None:
        self.variables, self.lens, self.state = variables, lens, state
        self.heated = state_temperature(lens, state) is not None
        own = f"{STATES}.{state}.sensor_distance"
        self.best_focus = own in variables.focused
        if self.best_focus and self.heated:
            raise InputError(
                f"variable '{own}': a best focus goes with no state that has a temperature; vary it"
            )

    @property
    def scaled(self) -> torch.nn.Parameter:
        """Return u, the variables of the whole lens."""
        return self.variables.scaled

    def __call__(self) -> dict[str, Tensor]:
        """Return the parameters by the names that the lens in this state has for them."""
        return values_there(self.lens, self.state, self.variables())

    def derivatives(self) -> tuple[list[str], Tensor]:
        """Return names of parameters of the lens in this state that change, in its own order, and
        ∂θ/∂u (Q, P); see `DesignVariables.derivatives`.
        """
        if self.heated:
            return self._through_expansion()
        names, matrix = self.variables.derivatives()
        sizes = [p.numel() for p in self.lens.variables(names).values()]
        rows = dict(zip(names, matrix.split(sizes), strict=True))
        there = values_in_state(self.lens, self.state, rows)
        ordered = list(self.lens.in_state(self.state).variables(list(there)))
        if not ordered:
            return [], matrix[:0]
        return ordered, torch.cat([there[name] for name in ordered])

    def _through_expansion(self) -> tuple[list[str], Tensor]:
        with torch.enable_grad():
            values = self()
            varied = [name for name, value in values.items() if value.requires_grad]
            names = list(self.lens.in_state(self.state).variables(varied))
            flat = torch.cat([values[name].reshape(-1) for name in names])
            matrix = jacobian_of(flat, [self.scaled]).double()
        # The stored parameters, which the values also depend on, are no variables.
        return names, matrix

    @torch.no_grad()
    def write_to(self, lens: Lens) -> None:
        """Store the current values in a lens that is in this state."""
        values = self()
        for name, parameter in lens.variables(list(values)).items():
            parameter.copy_(values[name])


class StatesMerit:
    """Sums the merit functions of states of a lens; `DampedLeastSquares` takes it as closure.

    Args:
        lens: the lens with its states.
        variables: of it.
        parts: name of a state → the merit function of the lens in that state.

    Raises:
        InputError: a best focus is asked for of a sensor that the states share, or a parameter
            varies that every state replaces by its own.
    """

    def __init__(
        self, lens: Lens, variables: DesignVariables, parts: Mapping[str, MeritFunction]
    ) -> None:
        self.lens, self.variables, self.parts = lens, variables, dict(parts)
        if variables.best_focus:
            raise InputError(
                "variable 'sensor_distance': solve 'best_focus' of a sensor that all states share; "
                "vary sensor_distance, or solve states.<name>.sensor_distance"
            )
        followed = {name for d in variables.dependents for name in getattr(d, "sources", ())}
        for name in variables.names:
            state, base = split_state(name)
            if state is not None and state not in self.parts:
                raise InputError(
                    f"variable '{name}': its state is none of merit.states "
                    f"({', '.join(self.parts)})"
                )
            if (
                state is None
                and name not in followed
                and all(f"{STATES}.{s}.{name}" in names_of_state(lens, s) for s in self.parts)
            ):
                raise InputError(
                    f"variable '{name}': every state has its own; vary states.*.{base}"
                )
        self._last: tuple[Tensor, StatesValue] | None = None

    @property
    def qualities(self) -> dict[str | None, ImageQuality]:
        """Return the rays' terms by state, of those that have one."""
        found = {name: part.quality for name, part in self.parts.items()}
        return {name: quality for name, quality in found.items() if quality is not None}

    def __call__(self) -> "StatesValue":
        """Return the merit at the variables' values."""
        point = self.variables.scaled.detach()
        if self._last is None or not torch.equal(self._last[0], point):
            self._last = point.clone(), StatesValue(self)
        return self._last[1]


@dataclass
class StatesValue:
    """Evaluates a merit function of states at its variables; see `MeritValue`."""

    merit: StatesMerit

    def __post_init__(self) -> None:
        self._values = {name: part() for name, part in self.merit.parts.items()}

    @property
    def qualities(self) -> dict[str | None, QualityValues]:
        """Return the values of the rays by state."""
        found = {name: value.quality for name, value in self._values.items()}
        return {name: quality for name, quality in found.items() if quality is not None}

    @property
    def operands(self) -> list[OperandValue] | None:
        """Return the values of the operands, labelled by state; None where one cannot be had."""
        found = []
        for name, value in self._values.items():
            if value.operands is None:
                return None
            found += [item.in_state(name) for item in value.operands]
        return found

    def sum_of_squares(self) -> float:
        """Return the merit; `inf` where rays fail in any state."""
        return math.fsum(value.sum_of_squares() for value in self._values.values())

    def loss(self) -> Tensor:
        """Return the merit with a graph to the variables."""
        return torch.stack([value.loss() for value in self._values.values()]).sum()

    def linear_model(self) -> LinearModel:
        """Return R and b in the variables u, of all states together."""
        return LinearModel.join([value.linear_model() for value in self._values.values()])

    def operand_derivatives(self) -> Tensor:
        """Return the derivatives (n, P) of the operands in their order."""
        return torch.cat([value.operand_derivatives() for value in self._values.values()])

    def write_to(self, lens: Lens) -> None:
        """Store the variables, what follows from them, and the foci in a lens."""
        self.merit.variables.write_to(lens)
        write_foci(lens, self.foci())

    def foci(self) -> dict[str, float]:
        """Return the sensor's distance (mm) in every state that keeps its best focus, by name of
        the parameter.
        """
        return {
            f"{STATES}.{name}.sensor_distance": value.sensor_distance
            for name, value in self._values.items()
            if self.merit.parts[name].variables.best_focus
        }


@torch.no_grad()
def write_foci(lens: Lens, foci: Mapping[str, float]) -> None:
    """Store distances of the sensor (mm), by the names of their parameters."""
    for name, distance in foci.items():
        lens.get_parameter(name).fill_(distance)


def weights_of_states(states: Sequence[str], given: Sequence[float] | None) -> dict[str, float]:
    """Return the weight of every state; they sum to one.

    Raises:
        InputError: there are not as many weights, or one is negative, or all are zero.
    """
    weights = [1.0] * len(states) if given is None else [float(w) for w in given]
    if len(weights) != len(states) or min(weights) < 0.0 or not sum(weights) > 0.0:
        raise InputError(
            f"merit.state_weights: give {len(states)} numbers that are not negative, not all zero"
        )
    return {name: w / sum(weights) for name, w in zip(states, weights, strict=True)}
