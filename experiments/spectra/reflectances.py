"""Spectra of reflectances, of daylight and of filters, as the package colour-science has them."""

from dataclasses import dataclass

import torch
from torch import Tensor

from dolens.experiments.data.camera_data import Split
from dolens.experiments.loggers.protocol import require_package

# 31 bands, nm.
BANDS = tuple(float(w) for w in range(400, 701, 10))
# Which measured spectra each split has: none stands in two.
SETS: dict[Split, tuple[str, ...]] = {
    "train": ("CIE 2017",),
    "validation": ("CIE 1995", "NIST CQS 9.0"),
    "test": ("BabelColor Average", "PMC"),
}
FILTERS = "Nikon 5100 (NPL)"
# Of CIE XYZ, 1931, to linear sRGB (IEC 61966-2-1).
_SRGB = ((3.2406, -1.5372, -0.4986), (-0.9689, 1.8758, 0.0415), (0.0557, -0.2040, 1.0570))


@dataclass(frozen=True)
class Reflectances:
    """What scenes and cameras are made of.

    Attributes:
        measured: split → reflectances (N, L).
        light: (L,), photons of daylight D65 in each band, of sum one.
        colour: (3, L), that takes a reflectance under D65 to linear sRGB; rows have the sum one.
        filters: (3, L), transmission of red, green and blue filters; each is one at its highest.
    """

    measured: dict[Split, Tensor]
    light: Tensor
    colour: Tensor
    filters: Tensor


def reflectances() -> Reflectances:
    """Read the spectra of the installed colour-science.

    Train: the 99 samples of CIE 224:2017, of paints, textiles, skin, plants and plastics.
    Validation: Munsell samples, those of the CIE's colour rendering index and of NIST's scale.
    Test: the 24 patches of a colour checker, averaged over 30 charts (BabelColor), and 30 objects
    and patches of Macbeth's PMC.

    Raises:
        InputError: colour-science is not installed.
    """
    require_package("colour", "spectra", "measured spectra")
    import colour
    from colour.quality.cfi2017 import load_TCS_CIE2017
    from colour.quality.datasets import SDS_TCS, SDS_VS

    shape = colour.SpectralShape(BANDS[0], BANDS[-1], BANDS[1] - BANDS[0])

    def bands(distribution: object) -> Tensor:
        return torch.tensor(distribution.copy().align(shape).values)

    samples = load_TCS_CIE2017(colour.SpectralShape(380, 780, 5))
    sets = {
        "CIE 2017": bands(samples).mT,
        "CIE 1995": torch.stack([bands(s) for s in SDS_TCS["CIE 1995"].values()]),
        "NIST CQS 9.0": torch.stack([bands(s) for s in SDS_VS["NIST CQS 9.0"].values()]),
    }
    for name in ("BabelColor Average", "PMC"):
        checker = colour.SDS_COLOURCHECKERS[name]
        sets[name] = torch.stack([bands(s) for s in checker.values()])
    measured = {split: torch.cat([sets[n] for n in names]) for split, names in SETS.items()}
    day = bands(colour.SDS_ILLUMINANTS["D65"])
    observer = bands(colour.MSDS_CMFS["CIE 1931 2 Degree Standard Observer"]).mT
    seen = torch.tensor(_SRGB, dtype=day.dtype) @ (observer * day)
    filters = bands(colour.MSDS_CAMERA_SENSITIVITIES[FILTERS]).mT.clamp(min=0.0)
    photons = day * torch.tensor(BANDS, dtype=day.dtype)
    return Reflectances(
        {split: spectra.clamp(0.0, 1.0).float() for split, spectra in measured.items()},
        (photons / photons.sum()).float(),
        (seen / seen.sum(1, keepdim=True)).float(),
        (filters / filters.amax(1, keepdim=True)).float(),
    )
