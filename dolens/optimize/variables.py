"""Design variables are parameters of a lens, scaled, bounded and named for an optimizer; their
number decides which optimizer a design takes.
"""

import math
from collections.abc import Callable, Iterable, Mapping
from typing import Any

import torch
from torch import Tensor, nn

from dolens.errors import InputError, check_keys
from dolens.optics.autograd import jacobian_of
from dolens.optics.lens import Lens
from dolens.optics.metasurface import width_limits
from dolens.optics.parameter_names import to_file_units, to_lens_units, unit_factors, unit_of
from dolens.optimize.pickups_and_solves import Dependent, dependent, of_each_state
from dolens.typed_values import check_type

_VARIABLE_KEYS = ("scale", "initial", "lower", "upper")


class DesignVariables(nn.Module):
    """Holds chosen lens parameters θ as u = θ/scale, so that optimizers see numbers near one.

    A parameter that is an array (the coefficients of a B-spline) counts as many variables, with
    one scale and the same bounds for all its elements.

    A parameter may also follow from others: a pickup or a solve (see `dependents`).  Patterns leave
    such parameters out.

    Settings are in the units of files, degrees for tilts (see `dolens.optics.parameter_names`); θ
    is in the lens's own units, radians and mm.  Widths of a metasurface's cells are also within the
    limits of their table.

    Args:
        lens: where the parameters live; it is not changed.
        variables: name or pattern → settings: `scale` (default 1), `initial` (default: the
            lens's own value), `lower` and `upper` (default: none), all in the unit of files;
            or name → `pickup` or `solve` with their settings.

    Rarely needed:
        others: numbers besides the lens's parameters that may be varied, by their exact names,
            in their own units.

    Attributes:
        names: of the parameters that are varied.
        scaled: u, P numbers.
        scale: (P,), θ/u, in the lens's own units.
        units: (P,), the lens's own unit in one of files: radians in a degree, or 1.
        dependents: the parameters that follow from others, in the order of their settings.
        focused: names of the distances of the sensor, the lens's or a state's, which a merit
            function is to keep at the best focus.

    Raises:
        InputError: an unknown parameter or setting, a scale that is not positive, or an initial
            value outside its bounds.
    """

    scale: Tensor
    lower: Tensor
    upper: Tensor
    units: Tensor

    def __init__(
        self,
        lens: Lens,
        variables: Mapping[str, Mapping[str, Any] | None],
        others: Mapping[str, Tensor] | None = None,
    ) -> None:
        super().__init__()
        check_type(variables, Mapping[str, Mapping[str, Any] | None], "variables")
        self.names: list[str] = []
        # In a tuple, so that the lens's parameters are not this module's too.
        self._of = (lens,)
        further = dict(others or {})
        self._others = frozenset(further)
        self._shapes: list[torch.Size] = []
        variables = of_each_state(variables, lens.state_names)
        self.dependents, self.focused = _dependents(lens, variables)
        following = {parameter.name for parameter in self.dependents} | self.focused
        scaled, scale, lower, upper = [], [], [], []
        limits = width_limits(lens)
        for pattern, settings in variables.items():
            settings = dict(settings or {})
            if pattern in following:
                continue
            check_keys(settings, _VARIABLE_KEYS, f"variable '{pattern}'")
            found = {pattern: further[pattern]} if pattern in further else None
            for name, parameter in (found or lens.variables([pattern])).items():
                if name in following:
                    continue
                if name in self.names:
                    raise InputError(f"variable '{name}' is named twice (by '{pattern}' too)")
                s = _setting(settings, "scale", 1.0, pattern)
                own = parameter.detach().double().flatten().tolist()
                starts = [
                    _setting(settings, "initial", to_file_units(name, value), pattern)
                    for value in own
                ]
                low = _setting(settings, "lower", -math.inf, pattern)
                high = _setting(settings, "upper", math.inf, pattern)
                least, most = limits.get(name, (-math.inf, math.inf))
                low, high = max(low, least), min(high, most)
                if not 0.0 < s < math.inf:
                    raise InputError(f"variable '{name}': scale must be positive, not {s:g}")
                for start in starts:
                    if not low <= start <= high:
                        raise InputError(
                            f"variable '{name}': initial value {start:g} is outside its bounds "
                            f"[{low:g}, {high:g}] (lower, upper)"
                        )
                self.names.append(name)
                self._shapes.append(parameter.shape)
                scaled += [start / s for start in starts]
                scale += [unit_of(name).factor * s] * len(starts)
                lower += [low / s] * len(starts)
                upper += [high / s] * len(starts)
        options: dict[str, Any] = {"dtype": lens.dtype, "device": lens.device}
        self.scaled = nn.Parameter(torch.tensor(scaled, **options))
        self.register_buffer("scale", torch.tensor(scale, **options))
        self.register_buffer("lower", torch.tensor(lower, **options))
        self.register_buffer("upper", torch.tensor(upper, **options))
        units = unit_factors(
            name
            for name, shape in zip(self.names, self._shapes, strict=True)
            for _ in range(shape.numel())
        )
        # It follows from the names, so that checkpoints need not hold it.
        self.register_buffer("units", units.to(**options), persistent=False)

    @property
    def best_focus(self) -> bool:
        """Return whether a merit function is to keep the lens's sensor at the best focus."""
        return "sensor_distance" in self.focused

    def __len__(self) -> int:
        """Return the number of parameters; an array is one."""
        return len(self.names)

    def labels(self) -> list[str]:
        """Return P names: those of the parameters, with a number for every element of an array."""
        labels = []
        for name, shape in zip(self.names, self._shapes, strict=True):
            count = shape.numel()
            labels += [name] if not shape else [f"{name}[{place}]" for place in range(count)]
        return labels

    @property
    def unit_names(self) -> list[str]:
        """Return P units of files, `deg` or `mm`; nothing where one depends on the surface."""
        return [
            unit_of(name).name
            for name, shape in zip(self.names, self._shapes, strict=True)
            for _ in range(shape.numel())
        ]

    @property
    def file_scale(self) -> Tensor:
        """Return the scales (P,) as the settings have them, in the units of files."""
        return self.scale / self.units

    def file_values(self) -> dict[str, float]:
        """Return the values by label, in the units of files (degrees, mm)."""
        values = (self.file_scale * self.scaled.detach()).tolist()
        return dict(zip(self.labels(), values, strict=True))

    def forward(self, scaled: Tensor | None = None) -> dict[str, Tensor]:
        """Return the parameters θ = scale·u by name, and those that follow from them.

        They are to be traced with instead of the stored ones.

        Args:
            scaled: u (P,), in place of the stored one.
        """
        theta = self.scale * (self.scaled if scaled is None else scaled)
        parts = theta.split([shape.numel() for shape in self._shapes])
        values = {
            name: part.reshape(shape)
            for name, part, shape in zip(self.names, parts, self._shapes, strict=True)
        }
        for parameter in self.dependents:
            values[parameter.name] = parameter.value(self._of[0].with_values(values))
        return values

    def derivatives(self) -> tuple[list[str], Tensor]:
        """Return the derivatives of the lens's parameters with respect to u.

        Returns:
            Names of all parameters that change, in the lens's own order, and ∂θ/∂u, (Q, P), in
            double precision, a row for every number of theirs.
        """
        with torch.enable_grad():
            values = self()
            names = list(self._of[0].variables(self._of_lens(values)))
            if self.dependents:
                flat = torch.cat([values[name].reshape(-1) for name in names])
                return names, jacobian_of(flat, [self.scaled]).double()
        first, place = {}, 0
        for name, shape in zip(self.names, self._shapes, strict=True):
            first[name] = place
            place += shape.numel()
        columns = torch.cat(
            [first[name] + torch.arange(values[name].numel()) for name in names]
            or [torch.zeros(0, dtype=torch.int64)]
        )
        matrix = torch.zeros(len(columns), place, dtype=torch.float64)
        matrix[torch.arange(len(columns)), columns] = self.scale.double().cpu()[columns]
        return names, matrix

    def parameter_group(self) -> dict[str, Any]:
        """Return u and its bounds as a group of parameters for an optimizer."""
        return {"params": [self.scaled], "lower": self.lower.clone(), "upper": self.upper.clone()}

    @torch.no_grad()
    def project(self) -> None:
        """Put the variables back within their bounds (S17)."""
        self.scaled.copy_(torch.maximum(self.lower, torch.minimum(self.scaled, self.upper)))

    @torch.no_grad()
    def write_to(self, lens: Lens) -> None:
        """Store the current values in a lens."""
        values = self()
        for name, parameter in lens.variables(self._of_lens(values)).items():
            parameter.copy_(values[name])

    def _of_lens(self, names: Iterable[str]) -> list[str]:
        """Return those of some names that are the lens's parameters."""
        return [name for name in names if name not in self._others]


def _dependents(
    lens: Lens, variables: Mapping[str, Mapping[str, Any] | None]
) -> tuple[list[Dependent], frozenset[str]]:
    found, focused = [], []
    for name, settings in variables.items():
        if settings and ("pickup" in settings or "solve" in settings):
            lens.variables([name])
            made = dependent(name, settings, lens)
            if made is None:
                focused.append(name)
            else:
                found.append(made)
    return found, frozenset(focused)


def _setting(settings: Mapping[str, Any], key: str, default: float, pattern: str) -> float:
    value = settings.get(key)
    if value is None:
        return default
    # A bool is a number to Python, and none to a user; NaN bounds nothing.
    try:
        number = math.nan if isinstance(value, bool | str) else float(value)
    except (TypeError, ValueError):
        number = math.nan
    if math.isnan(number):
        raise InputError(f"variable '{pattern}': {key} must be a number, not {value!r}")
    return number


_START_KEYS = ("multiply", "add", "relative", "absolute")
_WITHOUT_UNIT = ("multiply", "relative")


def start_values(
    lens: Lens, settings: Mapping[str, float | Mapping[str, Any]], generator: torch.Generator
) -> dict[str, Tensor]:
    """Return parameters of a lens to begin with; the lens is not changed.

    Args:
        lens: whose parameters are named.
        settings: pattern → a number; or `multiply` and `add`, applied in this order; or `relative`
            and `absolute`, standard deviations of normal errors, as a share of the parameter and in
            its unit.  Numbers are in the units of files, degrees for tilts.
            Later patterns go on from what earlier ones made.
        generator: of the errors.

    Returns:
        name → value, of the parameters that a pattern names.

    Raises:
        InputError: an unknown pattern or key, or a value that is no finite number.
    """
    found: dict[str, Tensor] = {}
    for pattern, change in settings.items():
        written = _numbers(pattern, change)
        for name, parameter in lens.variables([pattern]).items():
            numbers = {
                key: value if key in _WITHOUT_UNIT else to_lens_units(name, value)
                for key, value in written.items()
            }
            value = found.get(name, parameter.detach().clone())
            if "value" in numbers:
                found[name] = torch.full_like(value, numbers["value"])
                continue
            errors = torch.randn(value.shape, generator=generator, dtype=torch.float64).to(value)
            value = value * numbers.get("multiply", 1.0) + numbers.get("add", 0.0)
            spread = numbers.get("relative", 0.0) * value + numbers.get("absolute", 0.0)
            found[name] = value + spread * errors
    return found


def _numbers(pattern: str, change: object) -> dict[str, float]:
    given: dict[str, Any] = dict(change) if isinstance(change, Mapping) else {"value": change}
    if isinstance(change, Mapping):
        check_keys(change, _START_KEYS, f"start '{pattern}'")
    for key, value in given.items():
        number = isinstance(value, int | float) and not isinstance(value, bool)
        if not number or not math.isfinite(value):
            raise InputError(f"start '{pattern}': {key} must be a finite number, not {value!r}")
    return {key: float(value) for key, value in given.items()}


ParameterGroups = Iterable[Tensor] | Iterable[dict[str, Any]]


def by_number_of_variables(
    params: ParameterGroups,
    max_variables: int,
    few: Callable[[ParameterGroups], torch.optim.Optimizer],
    many: Callable[[ParameterGroups], torch.optim.Optimizer],
) -> torch.optim.Optimizer:
    """Return an optimizer whose step costs what the problem's size allows (supplement, Section II
    A).

    A step of damped least squares factors a matrix with a column for each variable; one of Adam
    costs a gradient, whatever their number.

    Args:
        params: tensors, or groups of them, as every optimizer takes.
        max_variables: variables up to which `few` is taken.
        few: for example damped least squares.
        many: for example Adam.

    Raises:
        InputError: `max_variables` is negative.
    """
    if max_variables < 0:
        raise InputError(f"optimizer.max_variables: {max_variables}; allowed: 0 or more variables")
    given: list[Any] = list(params)
    tensors = [
        tensor
        for entry in given
        for tensor in (entry["params"] if isinstance(entry, dict) else [entry])
    ]
    count = sum(tensor.numel() for tensor in tensors)
    return (few if count <= max_variables else many)(given)
