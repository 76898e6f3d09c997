"""A table of the states of a lens: what each is, and the numbers that differ."""

import math

import torch

from dolens.analysis.conditions import conditions
from dolens.analysis.first_order_numbers import first_order_numbers
from dolens.errors import InputError
from dolens.lens_page.tables import Table, number
from dolens.optics.lens import Lens
from dolens.optics.parameter_units import to_file_units


@torch.no_grad()
def states_table(lens: Lens) -> Table:
    """Return a column for every state: focal length, F-number, edge of the field, object distance,
    track, temperature, and the parameters that any state has for itself.

    Args:
        lens: with states.

    Raises:
        InputError: a state's conditions are none that an analysis can take; the message names it.
    """
    own = dict.fromkeys(
        base for name in lens.state_names for base, _ in lens.states[name].named_parameters()
    )
    shown = [base for base in own if lens.get_parameter(base).ndim == 0]
    columns = []
    for name in lens.state_names:
        there = lens.in_state(name)
        try:
            where = conditions(there)
        except InputError as error:
            raise InputError(f"state '{name}': {error}") from None
        first = first_order_numbers(there, where.reference_wavelength, where.object_distance)
        edge = max(math.hypot(*point) for point in where.fields.tolist())
        distance = math.inf if where.object_distance is None else where.object_distance
        efl = None if there.published is None else there.published.efl
        values = [to_file_units(base, float(there.get_parameter(base))) for base in shown]
        columns.append(
            (
                " × ".join(number(own.efl) for own in first.sections or (first,)),
                "" if efl is None else number(efl),
                number(abs(first.working_f_number), 3),
                f"{number(edge)}{where.field_unit}",
                number(distance),
                number(first.total_track),
                "" if there.temperature is None else number(there.temperature),
                *map(number, values),
            )
        )
    heads = ("EFL (mm)", "published", "F/#", "field", "object (mm)", "track (mm)", "T (°C)", *shown)
    rows = zip(heads, *columns, strict=True)
    return Table(
        ("state", *lens.state_names),
        [row for row in rows if any(row[1:])],
        "The working F-number, and what states have for themselves (mm, degrees)",
    )
