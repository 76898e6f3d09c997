"""Design of a lens in one call: a better lens."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import replace
from typing import TYPE_CHECKING, Any

from dolens.errors import InputError, check_choice, check_count, check_keys
from dolens.views.overview import as_lens

if TYPE_CHECKING:
    from dolens.analysis.fields_and_wavelengths import FieldPoints
    from dolens.optics.lens import Lens
    from dolens.views.optimization import Wanted
    from dolens.views.overview import Wavelengths


class DesignViews:
    """Methods of `Lens` that make another lens of it."""

    def optimize(
        self,
        variables: Sequence[str] | Mapping[str, Mapping[str, Any] | None],
        for_: str = "spots",
        keep: Mapping[str, Wanted] | None = None,
        iterations: int = 50,
        fields: FieldPoints | None = None,
        wavelengths: Wavelengths = None,
        **merit: Any,
    ) -> Lens:
        """Return a better lens, found by damped least squares; this one stays as it is.

        Its attribute `optimization` says what was done: merit by iteration, operands, variables at
        their bounds (see `dolens.views.optimization.Optimization`).  Variables, merit function and
        optimizer are those of `dolens train experiment=nikon`.  Apertures stay as they are.

        Args:
            variables: names or patterns, as `surfaces.*.curvature`, `thicknesses.[24]` or
                `sensor_distance`; or patterns with settings, as
                `{"thicknesses.*": {"lower": 1.0}, "sensor_distance": {"solve": "best_focus"}}`, in
                mm, 1/mm and degrees (see `dolens.optimize.DesignVariables`).
            for_: what becomes small: `spots` (RMS radii, µm) or `wavefront` (RMS errors, waves); or
                `spot_size`, `modulation` or `encircled_energy`, with their `quality_options`.
            keep: operand → target, as `{"efl": 50}`, or (min, max) with None for no limit, as
                `{"back_focus": (30, None)}`: `efl`, `back_focus`, `f_number`, `total_track`,
                `edge_thickness`, `distortion` (of the farthest field unless one is named) and the
                others of `dolens.optimize.operands`, in mm, degrees and per cent; or settings, as
                `{"distortion": {"min": -2, "max": 2, "field": (0, 20), "weight": 10}}`.  Each is
                kept by its weight, 100 per unit unless given, not to the last digit.  Glass and
                air, on the axis and at the edges, stay above half of the least that the lens has,
                unless `keep` names them (`centre_thickness`, `edge_thickness`, `air_gap`,
                `edge_air_gap`).
            iterations: at most.
            fields: numbers along y or points (x, y): degrees, or mm on a near object; None: the
                lens's own.
            wavelengths: nm; None: the lens's own.
            merit: other settings of `dolens.optimize.MeritSettings`, as `sampling` or
                `reference`.

        Raises:
            InputError: an unknown parameter, operand or setting; a lens without fields or
                wavelengths where none are given; or one whose rays fail where the search begins.

        Example:
            >>> lens = dolens.load_lens("cooke_triplet")
            >>> better = lens.optimize(["surfaces.*.curvature"], keep={"efl": 50}, iterations=5)
            >>> better.optimization.reached < better.optimization.merit[0]
            True
            >>> abs(better.first_order().efl.item() - 50) < 0.02
            True
        """
        from dolens.analysis.fields_and_wavelengths import as_wavelengths, field_points
        from dolens.optimize.merit_settings import LOSSES, RESIDUALS, MeritSettings
        from dolens.optimize.rounds import design
        from dolens.views.optimization import Optimization, gaps_that_stay, operands_to_keep

        lens = as_lens(self)
        check_choice(for_, (*RESIDUALS, *LOSSES), "for_")
        known = set(MeritSettings.__dataclass_fields__) - {"quality", "operands"}
        check_keys(merit, sorted(known), "optimize()")
        check_count("iterations", iterations)
        settings = MeritSettings(
            quality=for_,
            fields=None if fields is None else field_points(fields).tolist(),
            wavelengths=None if wavelengths is None else as_wavelengths(wavelengths).tolist(),
            **merit,
        )
        where = settings.conditions_of(lens)
        wanted = operands_to_keep(keep or {}, lens, where.fields.tolist())
        held = gaps_that_stay(lens, wanted, where.object_distance)
        settings = replace(settings, operands=[*wanted.values(), *held.values()])
        found = design(lens, patterns(variables), settings, iterations)
        record = Optimization.of(found, for_, wanted, held, where)
        better = found.after.lens.storing_its_values().to(lens.dtype)
        better.optimization = record
        return better


def patterns(
    variables: Sequence[str] | Mapping[str, Mapping[str, Any] | None],
) -> dict[str, Mapping[str, Any] | None]:
    """Return patterns of variables with their settings.

    Raises:
        InputError: neither names nor a mapping.
    """
    if isinstance(variables, Mapping):
        return dict(variables)
    names = [variables] if isinstance(variables, str) else variables
    if not isinstance(names, list | tuple) or not all(isinstance(name, str) for name in names):
        raise InputError(
            f"variables: {variables!r}; allowed: names or patterns, as ['surfaces.*.curvature']"
        )
    return dict.fromkeys(names)
