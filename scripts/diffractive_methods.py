"""Draw which approximations of diffractive elements hold where.

    python scripts/diffractive_methods.py docs/images/diffractive_methods.webp

Left: irradiances about a point of the sensor of light of 480 nm behind a lens blazed for 550 nm, by
waves and by the sum of orders, against Rayleigh and Sommerfeld's integral over the relief in NumPy
(double precision).  Right: what rays' order alone costs in pictures, by the size of pixels, for
reliefs with more and more light in other orders; `renderer=auto` takes it below the lines.
"""

import argparse
import math
from collections.abc import Sequence
from dataclasses import dataclass
from typing import Any

import matplotlib.pyplot as plt
import numpy as np
import torch

from dolens.diffraction.element_orders import OrdersSpread
from dolens.diffraction.element_waves import element_light
from dolens.diffraction.entrance_beam import ObjectPoints
from dolens.optics.diffractive import lens_phase, order_efficiencies
from dolens.optics.lens import Lens
from dolens.prescriptions import lens_from_prescription
from dolens.rendering.auto.plan import _DIFFRACTION
from dolens.rendering.auto.probes import grey_levels
from dolens.rendering.imaging_system import ImagingSystem
from dolens.rendering.psf_renderer import PsfRenderer
from dolens.scene.planar import PlanarScene
from dolens.sensor.pixels import Sensor

DESIGN, WAVE, INDEX = 550.0, 480.0, 1.5
RADIUS = 0.1  # mm, of the element
POINTS = 7  # along each side of a window
CELLS = 800  # along the element's diameter, of the reference


@dataclass(frozen=True)
class Case:
    """A lens, a field and a sensor.

    Attributes:
        f_number: of the element at its design wavelength.
        angle: of the field, degrees.
        defocus: of the sensor, over the focal length for 480 nm.
    """

    f_number: float
    angle: float
    defocus: float

    @property
    def focal_length(self) -> float:
        """At the design wavelength, mm."""
        return 2.0 * RADIUS * self.f_number

    @property
    def zones(self) -> float:
        """Zones of the relief."""
        return RADIUS**2 / (2e-6 * DESIGN * self.focal_length)

    @property
    def distance(self) -> float:
        """Of the sensor, mm."""
        return self.focal_length * DESIGN / WAVE * (1.0 + self.defocus)

    def window(self) -> tuple[np.ndarray, float]:
        """Return places along a side about the window's middle, and its y, mm."""
        half = 4e-6 * WAVE * self.f_number + RADIUS * abs(self.defocus)
        middle = self.distance * math.tan(math.radians(self.angle))
        return np.linspace(-half, half, POINTS), middle


CASES = [
    Case(f_number, angle, defocus)
    for f_number in (2.0, 4.0, 8.0, 16.0, 32.0)
    for angle in (0.0, 6.0)
    for defocus in (0.0, 0.1)
]


def flat_lens(case: Case, levels: int | None = None) -> Lens:
    """Return a plate with a blazed lens on its back, for `DESIGN`."""
    plane = {"type": "plane", "semi_diameter": RADIUS}
    given = {"design_wavelength": DESIGN}
    if levels is not None:
        given["levels"] = levels
    phase = lens_phase(case.focal_length, DESIGN, RADIUS)
    front = {**plane, "semi_diameter": 3.0 * RADIUS, "thickness": 0.1, "material": str(INDEX)}
    back = {**plane, "material": "air", "phase": phase, "diffractive": given}
    sensor = {"distance": case.distance, "diameter": 1.0}
    rows = {"1": front, "2": back}
    return lens_from_prescription(
        {"stop": 2, "wavelengths": [DESIGN], "surfaces": rows, "sensor": sensor}, torch.float64
    )


def reference(case: Case) -> np.ndarray:
    """Return the irradiance in the window, over its largest, by brute force."""
    wave, (u, middle) = 1e-6 * WAVE, case.window()
    x = (np.arange(CELLS) + 0.5) * (2.0 * RADIUS / CELLS) - RADIUS
    square = x[None] ** 2 + x[:, None] ** 2
    phase = lens_phase(case.focal_length, DESIGN, RADIUS)
    ratio = square / phase["norm_radius"] ** 2
    path = sum(v * ratio ** (int(k[1:]) // 2) for k, v in phase.items() if k[0] == "p")
    sine = math.sin(math.radians(case.angle))
    # Light from the side sees lower heights.
    deeper = (math.sqrt(INDEX**2 - sine**2) - math.sqrt(1.0 - sine**2)) / (INDEX - 1.0)
    deeper *= DESIGN / WAVE
    field = np.exp(1j * deeper * np.mod(path, 2.0 * np.pi))
    field *= np.exp(2j * np.pi / wave * sine * x[:, None])
    # A cell that the edge cuts has a part of the light.
    edge = (RADIUS - np.sqrt(square)) / (2.0 * RADIUS / CELLS) + 0.5
    field *= np.clip(edge, 0.0, 1.0)
    found = np.empty((POINTS, POINTS))
    for j, v in enumerate(u + middle):
        for i, w in enumerate(u):
            squared = (w - x[None]) ** 2 + (v - x[:, None]) ** 2 + case.distance**2
            r = np.sqrt(squared)
            kernel = (1.0 / r - 2j * np.pi / wave) * np.exp(2j * np.pi / wave * r) / squared
            found[j, i] = abs((field * kernel).sum()) ** 2
    return found / found.max()


def by_waves(case: Case) -> np.ndarray:
    """Return the same by plane waves."""
    u, middle = case.window()
    points, centre = ObjectPoints.at_infinity([[0.0, case.angle]]), [[0.0, middle]]
    light = element_light(flat_lens(case).system(), points, WAVE, centre)
    grid = torch.tensor(u)
    field = light.field(0, light.plan(0, float(u[-1])), grid, grid, torch.float64)
    found = field.detach().abs().square().numpy()
    return found / found.max()


def by_orders(case: Case) -> np.ndarray:
    """Return the same as the sum of orders that are each a lens of its own."""
    u, middle = case.window()
    system = flat_lens(case).requires_grad_(False).system()
    points = ObjectPoints.at_infinity([[0.0, case.angle]])
    one, waves = torch.ones(1, dtype=torch.float64), torch.tensor([WAVE], dtype=torch.float64)
    centre = torch.tensor([[0.0, middle]], dtype=torch.float64)
    found = OrdersSpread.of(system, points.to(torch.float64, one.device), waves, centre, one)
    # Means over cells that are small beside the finest detail, at the same places.
    step = float(u[1] - u[0])
    parts = 9
    half = 0.5 * step * POINTS
    means, *_ = found.mean_irradiance(half, parts * POINTS)
    there = means.detach().numpy()[parts // 2 :: parts, parts // 2 :: parts]
    return there / there.max()


def propagation_panel(axes: Any, cases: Sequence[Case]) -> None:
    """Draw errors of waves and of the sum of orders."""
    drawn: dict[str, list[tuple[float, float]]] = {}
    for case in cases:
        exact = reference(case)
        where = "in focus" if case.defocus == 0.0 else "10 % out of focus"
        for name, method in (("waves", by_waves), ("orders", by_orders)):
            error = float(np.abs(method(case) - exact).max())
            drawn.setdefault(f"{name}, {where}", []).append((case.zones, error))
    for (name, rows), mark in zip(sorted(drawn.items()), "os^v", strict=True):
        axes.scatter(*zip(*rows, strict=True), s=24, marker=mark, label=name)
    axes.set(xscale="log", yscale="log", xlabel="zones of the relief", ylim=(1e-6, 0.2))
    zones = sorted({case.zones for case in cases})
    axes.set_xticks(zones, [f"{z:.2g}" for z in zones])
    axes.minorticks_off()
    axes.set_ylabel("largest error over the peak")
    axes.set_title("Light about the sensor, on the axis and at 6°")
    axes.legend(fontsize=8, loc="lower right")


def orders_panel(axes: Any) -> None:
    """Draw what rays' order costs, for levels and wavelengths, by the size of pixels."""
    case = Case(8.0, 0.0, 0.0)
    for levels, wave in ((None, DESIGN), (8, DESIGN), (None, 480.0), (4, DESIGN), (2, DESIGN)):
        lens = flat_lens(case, levels)
        share = float(order_efficiencies(lens, [1], [wave])[0, 0])
        airy = 1e-6 * wave * case.f_number
        sizes, errors = (0.5, 1.0, 2.0, 4.0, 8.0, 16.0, 32.0), []
        for size in sizes:
            sensor = Sensor(33, 33, size * airy)
            scene = PlanarScene((1e6,), (wave,))
            # In the focus of this wavelength's first order.
            distance = case.focal_length * DESIGN / wave
            system = lens.system({"sensor_distance": torch.tensor(distance, dtype=torch.float64)})
            imaging = ImagingSystem.of(system, scene, sensor)
            renderer = PsfRenderer(sensor, (1, 1), size=41, registration="centred")
            waves, rays = (
                PsfRenderer.point_spread_functions(kind, imaging, 0).functions.detach()
                for kind in (
                    PsfRenderer(
                        sensor, (1, 1), size=41, registration="centred", diffraction="wave"
                    ),
                    renderer,
                )
            )
            errors.append(float(grey_levels(rays - waves).square().mean().sqrt()))
        made = "blazed" if levels is None else f"{levels} levels"
        axes.plot(sizes, errors, "o-", label=f"{made}, {wave:g} nm: {share:.0%} in rays' order")
    for tolerance in (1.0, 4.0):
        axes.axhline(_DIFFRACTION * tolerance, color="grey", linewidth=0.8)
        axes.annotate(f"rays below, at tolerance {tolerance:g}", (0.5, _DIFFRACTION * tolerance),
                      fontsize=7, va="bottom")  # fmt: skip
    axes.set(xscale="log", yscale="log", xlabel="pixel, λN", ylabel="error of rays, grey levels")
    axes.set_xticks(sizes, [f"{size:g}" for size in sizes], minor=False)
    axes.minorticks_off()
    axes.set_title("Pictures: where renderer=auto takes rays' order")
    axes.set_ylim(0.2, 300.0)
    axes.legend(fontsize=7, loc="upper right")


def main() -> None:
    """Measure, and write the figure."""
    parser = argparse.ArgumentParser(description=__doc__)
    parser.add_argument("figure", help="file that is written")
    given = parser.parse_args()
    figure, (left, right) = plt.subplots(1, 2, figsize=(11.0, 4.4), layout="constrained")
    propagation_panel(left, CASES)
    orders_panel(right)
    figure.savefig(given.figure, dpi=110)


if __name__ == "__main__":
    main()
