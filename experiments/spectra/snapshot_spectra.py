"""A camera of spectra: a plate's relief is learned with the estimator, beside cameras that are not
learned.
"""

from collections.abc import Collection, Mapping
from dataclasses import dataclass, replace
from functools import cached_property
from typing import Any

import torch
from torch import Tensor

from dolens.diffraction.pixel_psf import PixelWindow, wave_kernels
from dolens.diffraction.propagation import DiffractionSettings
from dolens.errors import InputError, check_choice, check_count
from dolens.experiments.camera.photograph_scores import PhotographScores, scores_by_photograph
from dolens.experiments.data.camera_data import Split
from dolens.experiments.data.crop_loading import EvaluationCrops
from dolens.experiments.experiment import Experiment, Figures
from dolens.experiments.spectra.figures import Shown, functions_figure, spectra_figure
from dolens.experiments.spectra.reflectances import BANDS, Reflectances, reflectances
from dolens.experiments.spectra.scenes import spectral_scene
from dolens.optics.lens import Lens
from dolens.prescriptions import lens_from_prescription
from dolens.reconstruction.quality import psnr_db, spectral_angle
from dolens.reconstruction.spectral_wiener import (
    SpectralCamera,
    SpectralPrior,
    SpectralWiener,
    spectral_prior,
)
from dolens.sensor.colour import PATTERNS
from dolens.sensor.noise import generator_of
from dolens.sensor.readout import Readout

LEARNED = "learned"
# Where scenes are, mm.
_FAR = 1.0e6
# Numbers that seeds of training, validation and test scenes begin with.
_FIRST: dict[Split, int] = {"train": 0, "validation": 1_000_000, "test": 2_000_000}


@dataclass(frozen=True)
class Rival:
    """A camera that nothing is learned for but its estimator.

    Attributes:
        lens: its prescription.
        pattern: of its filters, as `RGGB`; None: a monochrome sensor.
    """

    lens: Mapping[str, Any]
    pattern: str | None = None


@dataclass(frozen=True)
class Sampling:
    """How images and estimates are computed.

    Attributes:
        pixel_pitch: mm.
        psf_size: pixels along each side of functions, odd.
        rival_samples: across the pupils of rivals, whose zones are narrow.
        maps: of the prior.
        prior_crops: of each training photograph, that the prior is fitted to.
    """

    pixel_pitch: float
    psf_size: int
    rival_samples: int
    maps: int
    prior_crops: int


@dataclass(frozen=True)
class Learning:
    """What is learned, and how.

    Attributes:
        relief: name of the heights' parameter.
        scatter: nm, standard deviation of the heights that training begins with, beside the lens's.
        rate: nm a step, of Adam, where training begins; it ends at 0.
    """

    relief: str
    scatter: float
    rate: float


class SnapshotSpectraModule(Experiment):
    """Learns a relief by the error of the spectra that are estimated behind it.

    The loss is the error that the linear estimator expects of scenes as the training photographs
    are, in decibels; every camera has the estimator of its own functions.

    Args:
        lens: with a diffractive element; an object far away is imaged, by the function on the axis.
        learning: see `Learning`.
        pattern: of the filters, as `RGGB`; None: a monochrome sensor.
        rivals: name → camera.
        readout: of all cameras, without filters; 1 is the signal of white without filters.
        sampling: see `Sampling`.
        shown: number of the test crop that figures show.
        seed: of scenes, noise and the relief.

    Raises:
        InputError: a setting that is out of range, or colour-science is not installed.
    """

    metrics = (
        "train/loss",
        f"val/psnr_db/{LEARNED}",
        f"val/angle_deg/{LEARNED}",
        "test/expected_psnr_db/*",
        "test/psnr_db/*",
        "test/angle_deg/*",
        "test/photographs",
        "test/crops",
        "error/test/*",
    )

    def __init__(
        self,
        lens: Lens,
        learning: Learning,
        pattern: str | None,
        rivals: Mapping[str, Rival],
        readout: Readout,
        sampling: Sampling,
        shown: int,
        seed: int,
    ) -> None:
        super().__init__(lens)
        check_count("sampling.maps", sampling.maps)
        if sampling.psf_size % 2 == 0:
            raise InputError(f"sampling.psf_size: {sampling.psf_size}; allowed: odd numbers")
        self.learning, self.sampling, self.readout = learning, sampling, readout
        self.patterns = {LEARNED: pattern, **{n: r.pattern for n, r in rivals.items()}}
        for name, filters in self.patterns.items():
            if filters is not None:
                check_choice(filters, PATTERNS, f"pattern of {name}")
        self.shown, self.seed = shown, seed
        found = lens.variables([learning.relief])
        if [*found] != [learning.relief]:
            raise InputError(f"learning.relief: {learning.relief}; allowed: one parameter's name")
        self.relief = found[learning.relief]
        with torch.no_grad():
            noise = torch.randn(self.relief.shape, generator=generator_of(seed))
            self.relief.add_(learning.scatter * noise.to(self.relief))
        self.relief.requires_grad_(True)
        self.rivals: dict[str, Lens] = {}
        for name, rival in rivals.items():
            where = f"rivals.{name}.lens"
            same = [n for n in self.rivals if rivals[n].lens == rival.lens]
            made = lens_from_prescription(rival.lens, lens.dtype, where=where)
            self.rivals[name] = self.rivals[same[0]] if same else made
        self.prior: SpectralPrior | None = None
        self._functions: dict[str, Tensor] = {}
        self._wiener: dict[str, SpectralWiener] = {}
        self._scores: dict[str, list[Tensor]] = {}
        self._shown: Shown | None = None
        self.test_scores: dict[str, PhotographScores] = {}

    @cached_property
    def spectra(self) -> Reflectances:
        """Return what scenes and filters are made of."""
        return reflectances()

    def setup(self, stage: str) -> None:
        """Fit the prior to the training photographs, and compute rivals' functions."""
        if self.prior is not None:
            return
        data, sampling = self.trainer.datamodule, self.sampling
        if any(length % 2 for length in data.crop_size):
            raise InputError(f"data.crop_size: {list(data.crop_size)}; allowed: even numbers")
        photographs = data.photographs("train")
        crops = EvaluationCrops(
            photographs, data.item_size, sampling.prior_crops, data.evaluation_scale
        )
        rgb = torch.stack([crops[n][:3] for n in range(len(crops))])
        self.prior = spectral_prior(self._scenes(rgb, "train", -len(rgb)), sampling.maps)
        fine = DiffractionSettings(samples=sampling.rival_samples)
        with torch.no_grad():
            lenses = {id(lens): lens for lens in self.rivals.values()}
            found = {key: self.functions(lens, fine) for key, lens in lenses.items()}
        self._functions = {name: found[id(lens)] for name, lens in self.rivals.items()}

    def functions(self, lens: Lens, settings: DiffractionSettings | None = None) -> Tensor:
        """Return the functions (L, K, K) of a lens on its axis, of the bands."""
        sampling = self.sampling
        options = {"dtype": torch.float64, "device": self.relief.device}
        points = torch.tensor([[0.0, 0.0, -_FAR]], **options).expand(len(BANDS), 3)
        window = PixelWindow(sampling.pixel_pitch, sampling.psf_size)
        settings = settings or DiffractionSettings()
        waves, middle = torch.tensor(BANDS, **options), torch.zeros(len(BANDS), 2, **options)
        return wave_kernels(lens.system(), points, waves, middle, window, settings)

    def _scenes(self, rgb: Tensor, split: Split, first: int) -> Tensor:
        """Return the scenes (N, L, H, W) of photographs; the first one has this number."""
        seed = self.seed * 10_000_000 + _FIRST[split] + first
        made = (spectral_scene(c, self.spectra, split, seed + n) for n, c in enumerate(rgb.cpu()))
        return torch.stack(list(made)).to(rgb.device)

    def camera(self, name: str, functions: Tensor) -> SpectralCamera:
        """Return a camera of the experiment with these functions."""
        light, filters = self.spectra.light, self.spectra.filters
        bayer = self.patterns[name] is not None
        responses = filters * light if bayer else light[None]
        return SpectralCamera(
            functions, responses.to(functions.device), self.patterns[name], self.readout.noise
        )

    def estimator(self, name: str, shape: tuple[int, int]) -> SpectralWiener:
        """Return the estimator of a camera as it is now, for images of a shape."""
        assert self.prior is not None
        functions = self._functions[name] if name in self._functions else self.functions(self.lens)
        camera = self.camera(name, functions.to(self.device))
        return SpectralWiener(camera, self.prior.to(self.device), shape)

    def _inside(self, images: Tensor, margins: int = 1) -> Tensor:
        """Return images without so many half functions at each edge."""
        edge = margins * (self.sampling.psf_size // 2)
        return images[..., edge : images.shape[-2] - edge, edge : images.shape[-1] - edge]

    def _shape(self, rgb: Tensor) -> tuple[int, int]:
        """Return the height and width of the images of photographs."""
        edge = 2 * (self.sampling.psf_size // 2)
        return rgb.shape[-2] - edge, rgb.shape[-1] - edge

    # ---------------------------------------------------------------- training

    def configure_optimizers(self) -> dict[str, Any]:
        """Return Adam for the relief, with a cosine schedule."""
        optimizer = torch.optim.Adam([self.relief], lr=self.learning.rate, betas=(0.9, 0.99))
        steps = max(1, int(self.trainer.estimated_stepping_batches))
        schedule = torch.optim.lr_scheduler.CosineAnnealingLR(optimizer, steps)
        return {
            "optimizer": optimizer,
            "lr_scheduler": {"scheduler": schedule, "interval": "step"},
        }

    def training_step(self, batch: Tensor, batch_idx: int) -> Tensor:
        """Return the loss, see the class; of photographs it takes the size alone."""
        loss = 10.0 * self.estimator(LEARNED, self._shape(batch)).expected_error.log10()
        self.log("train/loss", loss.detach(), prog_bar=True)
        return loss

    def lens_values(self) -> dict[str, Tensor]:
        """Return the heights."""
        return {self.learning.relief: self.relief.detach()}

    # ---------------------------------------------------------------- evaluation

    def on_validation_epoch_start(self) -> None:
        """Forget the estimators of another relief."""
        self._wiener.clear()

    def validation_step(self, batch: Tensor, batch_idx: int) -> None:
        """Log the scores of the learned camera."""
        scores, *_ = self._judged(LEARNED, batch, "validation", batch_idx)
        for key, values in scores.items():
            self.log(f"val/{key}/{LEARNED}", values.nanmean(), batch_size=len(batch))

    def _judged(
        self, name: str, batch: Tensor, split: Split, number: int
    ) -> tuple[dict[str, Tensor], Tensor, Tensor, Tensor]:
        """Return scores of each crop, the image, estimated spectra, and true ones."""
        if name not in self._wiener:
            self._wiener[name] = self.estimator(name, self._shape(batch))
        wiener = self._wiener[name]
        first = number * int(getattr(self.trainer.datamodule, "batch_size", len(batch)))
        scenes = self._scenes(batch, split, first)
        readout = replace(self.readout, pattern=wiener.camera.pattern)
        generator = generator_of(_FIRST[split] + self.seed + first, scenes.device)
        raw = readout(wiener.camera.image(scenes), generator) / readout.relative_exposure
        found, truth = self._inside(wiener(raw)), self._inside(scenes, 2)
        scores = {"psnr_db": psnr_db(found, truth), "angle_deg": spectral_angle(found, truth)}
        return scores, self._inside(raw), found.clamp(min=0.0), truth

    def on_test_start(self) -> None:
        """Begin."""
        self._wiener.clear()
        self._scores, self._shown = {"psnr_db": [], "angle_deg": []}, None

    def test_step(self, batch: Tensor, batch_idx: int) -> None:
        """Judge all cameras by the same scenes."""
        first = sum(len(s) for s in self._scores["psnr_db"])
        of_cameras: dict[str, list[Tensor]] = {key: [] for key in self._scores}
        at = self.shown - first
        for name in self.patterns:
            scores, raw, found, truth = self._judged(name, batch, "test", batch_idx)
            for key, values in scores.items():
                of_cameras[key].append(values.cpu())
            if 0 <= at < len(batch):
                shown = self._shown or Shown(truth[at].cpu(), self.spectra.colour, {}, {})
                shown.images[name] = raw[at].cpu()
                shown.found[name] = found[at].cpu()
                self._shown = shown
        for key, values in of_cameras.items():
            self._scores[key].append(torch.stack(values, -1))

    def on_test_epoch_end(self) -> None:
        """Log means and intervals over photographs."""
        scores = {key: torch.cat(values) for key, values in self._scores.items()}
        names = self.trainer.datamodule.evaluation_photographs("test")[: len(scores["psnr_db"])]
        table = scores_by_photograph(scores, names, list(self.patterns))
        self.test_scores = {"test": table}
        numbers = {
            key: value  # means over cameras say nothing
            for key, value in table.numbers("test").items()
            if not key.startswith("error") or key.split("/")[-2] in self.patterns
        }
        for key, values in table.metrics.items():
            means = zip(self.patterns, values.nanmean(0).tolist(), strict=True)
            numbers |= {f"test/{key}/{name}": mean for name, mean in means}
        for name, wiener in self._wiener.items():
            expected = -10.0 * float(wiener.expected_error.detach().log10())
            numbers[f"test/expected_psnr_db/{name}"] = expected
        self.log_dict(numbers)

    def metric_names(self) -> Collection[str]:
        """Return the names of all metrics."""
        return self.metrics

    def figures(self) -> Figures:
        """Return pictures and spectra of a test scene, and what the cameras make of a point."""
        functions = {name: w.camera.functions.detach().cpu() for name, w in self._wiener.items()}
        found = {"functions": lambda: functions_figure(functions, self.relief.detach().cpu())}
        if self._shown is not None:
            shown = self._shown
            found["spectra"] = lambda: spectra_figure(shown)
        return found
