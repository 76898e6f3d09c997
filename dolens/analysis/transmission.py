"""The light of a field is followed to the sensor: what arrives, and where the rest is lost.

Of the unpolarised light of a field that no aperture stops, each surface passes (T_s + T_p)/2, or
reflects (R_s + R_p)/2 where it is a mirror, and each glass what its catalogue says of the path
through it.  These are means over the pupil.  Light leaves a surface partly
polarised, and so meets the next one; this is left out.
"""

from collections.abc import Sequence
from dataclasses import dataclass
from pkgutil import resolve_name
from typing import TYPE_CHECKING, Any

import torch
from torch import Tensor

from dolens.analysis.conditions import AtConditions, Conditions
from dolens.analysis.pupil_quadrature import SpotRays, gaussian_quadrature
from dolens.optics.field_and_aperture import in_double_precision
from dolens.optics.fields import point_text
from dolens.optics.glass import Glass
from dolens.optics.lens import Lens
from dolens.optics.materials import is_glass, media_of
from dolens.optics.system import OpticalSystem
from dolens.optics.text_tables import html_table, printable, text_table
from dolens.optics.trace import enter_lens, trace_surfaces, trace_to_sensor

if TYPE_CHECKING:
    from matplotlib.figure import Figure

# Rings and arms of the pupil, and those that tell the error.
_PUPIL, _COARSE = (6, 12), (4, 8)


@dataclass(frozen=True)
class Transmission(AtConditions):
    """Shares of light at F fields and W wavelengths of a lens of N surfaces.

    Attributes:
        name: of the lens.
        share: (F, W), of the light that no aperture stops, what arrives.
        error: (F, W), by how much it differs with fewer rays.
        surfaces: (F, W, N), what each surface passes or reflects.
        media: (F, W, N + 1), what the medium in front of each surface, and behind the last, passes.
        ideal: numbers of the surfaces that bend light and have no coating: they lose nothing.
        unknown: names of the glasses whose catalogues give no internal transmittance at one of the
            wavelengths: they are clear.
    """

    name: str
    share: Tensor
    error: Tensor
    surfaces: Tensor
    media: Tensor
    ideal: tuple[int, ...]
    unknown: tuple[str, ...]

    @property
    def polychromatic(self) -> Tensor:
        """Return the mean over the wavelengths by their weights, (F,)."""
        return self.share @ self.where.weights

    @property
    def notes(self) -> list[str]:
        """Return what the numbers leave out, in sentences."""
        found = [f"The shares are off by {float(self.error.max()):.1g} or less."]
        if self.ideal:
            count = len(self.ideal)
            found.append(f"{count} of the surfaces are ideal: no coating, and nothing lost.")
        if self.unknown:
            names = ", ".join(self.unknown)
            found.append(f"No internal transmittance is known of {names}: taken as clear.")
        return [printable(note) for note in found]

    def cells(self) -> list[list[str]]:
        """Return rows of field and share in per cent at each wavelength and of all."""
        rows = []
        for at, field in enumerate(self.fields.tolist()):
            shares = [*self.share[at].tolist(), float(self.polychromatic[at].detach())]
            rows.append([point_text((field[0], field[1]), 5), *(f"{100 * s:.2f}" for s in shares)])
        return rows

    def surface_cells(self) -> list[list[str]]:
        """Return rows of surface and loss in per cent, of it and of the glass in front, the mean
        over fields and wavelengths; without those that lose nothing.
        """
        weights = self.where.field_weights[:, None] * self.where.weights
        at, before = (
            1.0 - torch.einsum("fw,fwn->n", weights, s) for s in (self.surfaces, self.media)
        )
        return [
            [str(n + 1) if n < len(at) else "sensor", *(f"{100 * loss:.3f}" for loss in losses)]
            for n, losses in enumerate(zip([*at.tolist(), 0.0], before.tolist(), strict=True))
            if max(losses) > _NOTHING
        ]

    @property
    def headings(self) -> tuple[str, ...]:
        """Return the headings of `cells`."""
        unit = self.field_unit
        return (f"field ({unit})", *(f"{w:g} nm (%)" for w in self.wavelengths.tolist()), "all (%)")

    def __repr__(self) -> str:
        """Return the tables as text."""
        parts = [f"Transmission: {printable(self.name)}", text_table(self.headings, self.cells())]
        if losses := self.surface_cells():
            parts.append(text_table(_LOSSES, losses))
        return "\n".join([*parts, *self.notes])

    def _repr_html_(self) -> str:
        """Return the tables for a notebook; all text is escaped."""
        title = f"Transmission: {self.name}"
        first = html_table(self.headings, self.cells(), title, note=" ".join(self.notes))
        losses = self.surface_cells()
        return first + (html_table(_LOSSES, losses) if losses else "")

    def figure(self) -> "Figure":
        """Return the figure of `plotting.transmission.transmission_figure`."""
        make = resolve_name("dolens.plotting.transmission.transmission_figure")
        found: Figure = make(self, f"Transmission: {printable(self.name)}")
        return found


# Shares of less are rounding.
_NOTHING = 1e-12
_LOSSES = ("surface", "loses (%)", "glass in front absorbs (%)")


def transmission(lens: Lens, where: Conditions) -> Transmission:
    """Compute which share of the light of each field and wavelength arrives.

    Differentiable with respect to the lens and its coatings.

    Args:
        lens: the lens.
        where: the conditions.

    Raises:
        InputError: a field whose light does not pass, or a wavelength that an index or a coating is
            not known at.
    """
    exact = in_double_precision(lens)
    fields = [(x, y) for x, y in where.fields.tolist()]
    waves = where.wavelengths.tolist()
    found = []
    for rings, arms in (_PUPIL, _COARSE):
        rays = gaussian_quadrature(
            exact, fields, waves, rings, arms, where.object_distance, lost_light=False
        )
        found.append(_means(exact, rays, (len(fields), len(waves))))
    share, surfaces, media = found[0]
    return Transmission(
        where,
        lens.name,
        share,
        (share - found[1][0]).detach().abs(),
        surfaces,
        media,
        tuple(ideal_surfaces(lens)),
        tuple(unknown_glasses(lens, waves)),
    )


def reflectances(
    system: OpticalSystem, wavelengths: Sequence[float] | Tensor, angles: Sequence[float]
) -> dict[int, Tensor]:
    """Return what coatings reflect of unpolarised light, number of a surface → shares (W, A).

    Args:
        system: the lens.
        wavelengths: (W,), nm.
        angles: (A,), degrees of incidence in front of each surface.
    """
    options: dict[str, Any] = {"dtype": torch.float64, "device": system.device}
    waves = torch.as_tensor(wavelengths, **options)[:, None]
    cosines = torch.deg2rad(torch.as_tensor(angles, **options)).cos().expand(len(waves), -1)
    indices = [torch.as_tensor(n, **options) for n in system.indices(waves)]
    found = {}
    for number, surface in enumerate(system.surfaces, 1):
        if surface.coating is not None:
            front, behind = indices[number - 1 : number + 1]
            found[number] = surface.coating.shares(front, behind, cosines, waves).reflected
    return found


def _means(lens: Lens, spots: SpotRays, shape: tuple[int, int]) -> tuple[Tensor, Tensor, Tensor]:
    """Return the shares of the whole lens, of its surfaces and of its media over the pupil."""
    system = lens.system()
    wavelength = spots.rays.wavelength
    ray, _ = enter_lens(system, spots.rays, 1, 1.0)
    traced = trace_surfaces(system, ray, wavelength, transmission=True)
    traced = trace_to_sensor(system, traced, wavelength)
    assert traced.shares is not None  # they were asked for
    one = torch.ones_like(traced.ray.x)
    media = torch.stack([one * share.medium for share in traced.shares], -1)
    met = torch.stack([one * share.surface for share in traced.shares[:-1]], -1)
    whole = media.prod(-1) * met.prod(-1)
    # Coordinate breaks are no surfaces that light meets.
    places = torch.tensor(system.met, device=met.device) - 1
    surfaces = met.new_ones(len(met), len(system.surfaces)).index_copy(1, places, met)
    before = torch.cat([places, places.new_tensor([len(system.surfaces)])])
    gaps = media.new_ones(len(media), len(system.surfaces) + 1).index_copy(1, before, media)

    def mean(values: Tensor) -> Tensor:
        weight = spots.weight.to(values)
        weighted = values * (weight if values.ndim == 1 else weight[:, None])
        summed = values.new_zeros(spots.count, *values.shape[1:]).index_add(0, spots.spot, weighted)
        return summed.unflatten(0, shape)

    return mean(whole), mean(surfaces), mean(gaps)


def ideal_surfaces(lens: Lens) -> list[int]:
    """Return the numbers of the surfaces that refract or reflect, and have no coating."""
    system = lens.system()
    return [
        n
        for n in system.met
        if system.surfaces[n - 1].coating is None
        and (system.refracts(n) or system.surfaces[n - 1].deflection is not None)
    ]


def unknown_glasses(lens: Lens, wavelengths: list[float]) -> list[str]:
    """Return the names of the solid media whose absorption is not known at one of the wavelengths
    (nm).
    """
    # Light travels in a medium between two surfaces.
    solid = filter(is_glass, media_of(lens.materials).materials[1:-1])
    unknown = (
        m.name
        for m in solid
        if not isinstance(m, Glass) or not all(map(m.knows_absorption, wavelengths))
    )
    return list(dict.fromkeys(unknown))
