"""A renderer that was chosen, and what is known of it."""

from dataclasses import dataclass, fields
from typing import Any

import torch

from dolens.rendering.auto.agreement import Agreement
from dolens.rendering.auto.finding import Finding
from dolens.rendering.psf_renderer import PsfRenderer
from dolens.rendering.ray_renderer import RayRenderer


@dataclass(frozen=True)
class Choice:
    """A renderer, its precision, and how it was found.

    Attributes:
        renderer: what renders.
        dtype: of rays and image.
        findings: the decisions, with what each costs in grey levels.
        error: RMS error on the probe image against rays, both without diffraction, grey levels;
            0 is below what the reference can tell.
        uncertainty: of that error, grey levels.
        tolerance: grey levels that were asked for.
        seconds: that choosing took.
        agreement: of the gradients with those of rays; None where they were not asked for.
    """

    renderer: PsfRenderer | RayRenderer
    dtype: torch.dtype
    findings: tuple[Finding, ...]
    error: float
    uncertainty: float
    tolerance: float
    seconds: float
    agreement: Agreement | None = None

    def lines(self) -> list[str]:
        """The plan, for people: a line a decision."""
        model = "psf" if isinstance(self.renderer, PsfRenderer) else "rays"
        return [
            f"renderer auto: {model}, error {self.error:.2g} of {self.tolerance:g} grey levels "
            f"(±{self.uncertainty:.2g}) on the probe images, planned in {self.seconds:.1f} s",
            *(f"  {finding}" for finding in self.findings),
            *([f"  {self.agreement}"] if self.agreement else []),
        ]

    def numbers(self) -> dict[str, float]:
        """The plan as metrics."""
        renderer = self.renderer
        numbers = {
            "auto/error_grey_levels": self.error,
            "auto/uncertainty_grey_levels": self.uncertainty,
            "auto/tolerance_grey_levels": self.tolerance,
            "auto/plan_s": self.seconds,
            "auto/pupil_samples": float(renderer.pupil_samples),
            "auto/precision_bits": float(torch.finfo(self.dtype).bits),
            "auto/by_rays": float(isinstance(renderer, RayRenderer)),
        }
        if isinstance(renderer, PsfRenderer):
            numbers["auto/fields"] = float(renderer.fields[0] * renderer.fields[1])
            numbers["auto/psf_pixels"] = float(renderer.size)
            numbers["auto/diffraction"] = float(renderer.diffraction != "none")
        return numbers | gradient_numbers(self.agreement)


def gradient_numbers(agreement: Agreement | None) -> dict[str, float]:
    """How gradients agree, as metrics."""
    if agreement is None:
        return {}
    return {
        "auto/gradient_cosine": agreement.cosine,
        "auto/gradient_norm_ratio": agreement.norm_ratio,
        "auto/gradient_noise": agreement.noise,
    }


def settings_of(renderer: PsfRenderer | RayRenderer) -> dict[str, Any]:
    """All settings but the sensor, as plain values that a checkpoint can hold."""
    settings = {f.name: getattr(renderer, f.name) for f in fields(renderer) if f.name != "sensor"}
    return {name: list(v) if isinstance(v, tuple) else v for name, v in settings.items()}
