"""Lens parameters as an optimizer likes them: scaled, bounded, and named."""

import math
from collections.abc import Mapping
from typing import Any

import torch
from torch import Tensor, nn

from dolens.errors import InputError
from dolens.optics.lens import Lens

_KEYS = ("scale", "initial", "lower", "upper")


class DesignVariables(nn.Module):
    """Chosen lens parameters θ, held as u = θ/scale so that optimizers see numbers near one.

    A parameter that is an array (the coefficients of a B-spline) counts as many variables, with
    one scale and the same bounds for all its elements.

    Args:
        lens: where the parameters live; it is not changed.
        variables: name or pattern → settings: `scale` (default 1), `initial` (default: the
            lens's own value), `lower` and `upper` (default: none), all in the parameter's unit.

    Raises:
        InputError: an unknown parameter or setting, a scale that is not positive, or an initial
            value outside its bounds.
    """

    def __init__(self, lens: Lens, variables: Mapping[str, Mapping[str, Any] | None]) -> None:
        super().__init__()
        self.names: list[str] = []
        self._shapes: list[torch.Size] = []
        scaled, scale, lower, upper = [], [], [], []
        for pattern, settings in variables.items():
            settings = dict(settings or {})
            for key in settings:
                if key not in _KEYS:
                    raise InputError(
                        f"variable '{pattern}': unknown key '{key}' (allowed: {', '.join(_KEYS)})"
                    )
            for name, parameter in lens.variables([pattern]).items():
                if name in self.names:
                    raise InputError(f"variable '{name}' is named twice (by '{pattern}' too)")
                s = _setting(settings, "scale", 1.0, pattern)
                own = parameter.detach().double().flatten().tolist()
                starts = [_setting(settings, "initial", value, pattern) for value in own]
                low = _setting(settings, "lower", -math.inf, pattern)
                high = _setting(settings, "upper", math.inf, pattern)
                if not s > 0.0:
                    raise InputError(f"variable '{name}': scale must be positive, not {s:g}")
                for start in starts:
                    if not low <= start <= high:
                        raise InputError(
                            f"variable '{name}': initial value {start:g} is outside its bounds "
                            f"[{low:g}, {high:g}]"
                        )
                self.names.append(name)
                self._shapes.append(parameter.shape)
                scaled += [start / s for start in starts]
                scale += [s] * len(starts)
                lower += [low / s] * len(starts)
                upper += [high / s] * len(starts)
        options = {"dtype": lens.dtype, "device": lens.device}
        self.scaled = nn.Parameter(torch.tensor(scaled, **options))
        self.register_buffer("scale", torch.tensor(scale, **options))
        self.register_buffer("lower", torch.tensor(lower, **options))
        self.register_buffer("upper", torch.tensor(upper, **options))

    def __len__(self) -> int:
        """How many parameters; an array is one."""
        return len(self.names)

    def forward(self) -> dict[str, Tensor]:
        """The parameters θ = scale·u by name, to be traced with instead of the stored ones."""
        parts = (self.scale * self.scaled).split([shape.numel() for shape in self._shapes])
        return {
            name: part.reshape(shape)
            for name, part, shape in zip(self.names, parts, self._shapes, strict=True)
        }

    @torch.no_grad()
    def project(self) -> None:
        """Put the variables back within their bounds (S17)."""
        self.scaled.copy_(torch.maximum(self.lower, torch.minimum(self.scaled, self.upper)))

    @torch.no_grad()
    def write_to(self, lens: Lens) -> None:
        """Store the current values in a lens."""
        parameters = dict(lens.named_parameters())
        for name, value in self().items():
            parameters[name].copy_(value)


def _setting(settings: Mapping[str, Any], key: str, default: float, pattern: str) -> float:
    value = settings.get(key)
    if value is None:
        return default
    try:
        return float(value)
    except (TypeError, ValueError):
        raise InputError(f"variable '{pattern}': {key} must be a number, not {value!r}") from None
