"""One exposure time is shared by the states of a lens: focus brackets and focal sweeps."""

import copy
import math
from collections.abc import Iterator, Mapping, Sequence
from dataclasses import dataclass, replace
from typing import Any, Self

import torch
from torch import Tensor

from dolens.analysis.pupil_quadrature import SpotRays
from dolens.errors import InputError, check_choice
from dolens.experiments.camera.views.base import (
    Comparison,
    Imaging,
    PlainExposure,
    Shot,
    Views,
)
from dolens.experiments.camera.views.whole import Placing, WholePicture
from dolens.experiments.settings import check_positive
from dolens.optics.lens import Lens
from dolens.optics.lens_states import check_state
from dolens.reconstruction.likelihood import estimated_motion
from dolens.reconstruction.wiener import shifted
from dolens.sensor.noise import generator_of
from dolens.sensor.pixels import Sensor
from dolens.sensor.readout import Readout

READOUTS = ("each", "one")
KNOWLEDGE = ("known", "estimated", "ignored")
# Streams of random numbers beside those of the views: a readout's own, and of motion.
_READOUT_OFFSET, _MOTION_OFFSET = 1 << 34, 1 << 37
# Textures move by so many pixels at most; their margins are wider.
_MOST_MOTION = 8.0


@dataclass(frozen=True)
class Exposures:
    """Says how the exposure time is shared by the states of a lens.

    Attributes:
        shares: of the time, for each state in the lens's order; None: equal ones.  What their sum
            lacks to 1 is lost.
        readouts: `each` state's light is read out by itself, with read noise of its own; or `one`
            readout has the light of all, as of a sensor that moves while it is exposed.
        motion: of the scene from one readout to the next, pixels, straight on in a direction that
            is drawn for each batch.  The middle one is the truth.  The scene rests during each.
        motion_is: what restorers know of it: `known`, `estimated` from the readouts, or `ignored`.
        beside: a state that takes no part: the plain lens in one exposure of all the time, at its
            own F-number, which tests compare with.  None: nothing.

    Raises:
        InputError: a number out of range, or an unknown word.
    """

    shares: Sequence[float] | None = None
    readouts: str = "each"
    motion: float = 0.0
    motion_is: str = "known"
    beside: str | None = None

    def __post_init__(self) -> None:
        for number, share in enumerate(self.shares or ()):
            check_positive(f"exposures.shares.{number}", share)
        if sum(self.shares or ()) > 1.0 + 1e-6:
            raise InputError(
                f"exposures.shares: their sum is {sum(self.shares or ()):g}; allowed: at most 1"
            )
        check_choice(self.readouts, READOUTS, "exposures.readouts")
        check_choice(self.motion_is, KNOWLEDGE, "exposures.motion_is")
        if not (isinstance(self.motion, int | float) and 0.0 <= self.motion < math.inf):
            raise InputError(f"exposures.motion: {self.motion}; allowed: pixels, at least 0")
        if self.motion_is == "estimated" and self.readouts == "one":
            raise InputError(
                "exposures.motion_is: estimated; allowed with one readout: known, ignored"
            )

    def of(self, views: Imaging, lens: Lens) -> "ExposedViews":
        """Return views in which the lens passes through its states.

        Raises:
            InputError: the lens has fewer than two states, or the shares are not as many.
        """
        if self.beside is not None:
            check_state(lens, self.beside)
        names = [name for name in lens.state_names if name != self.beside]
        if len(names) < 2:
            raise InputError(
                f"exposures: lens '{lens.name}' has {len(names)} states; needed: two at least, as "
                "lens.states.far.sensor.distance and lens.states.near.sensor.distance"
            )
        shares = [1.0 / len(names)] * len(names) if self.shares is None else list(self.shares)
        if len(shares) != len(names):
            raise InputError(
                f"exposures.shares: {len(shares)} of {len(names)} states ({', '.join(names)})"
            )
        if self.motion * (len(names) - 1) > _MOST_MOTION:
            raise InputError(
                f"exposures.motion: {self.motion:g}; allowed: {_MOST_MOTION:g} pixels from the "
                "first to the last readout"
            )
        return ExposedViews(views, self, dict(zip(names, shares, strict=True)))


class ExposedViews(Imaging):
    """Takes each image several times, by a lens in each of its states.

    Magnification that changes with the state is taken for corrected: it is known.

    Args:
        views: that one state's images are; they are copied.
        settings: see `Exposures`.
        shares: state → its share of the exposure time.
    """

    def __init__(self, views: Imaging, settings: Exposures, shares: Mapping[str, float]) -> None:
        super().__init__(views.scene, views.renderer, views.readout, views.seed)
        self.settings, self.shares = settings, dict(shares)
        self.parts = {name: copy.copy(views) for name in shares}
        for part in self.parts.values():
            part.readout = Readout()  # light, which is read out here
        self.evaluation_renderer = views.evaluation_renderer
        self._plain = copy.copy(views)
        self.view_is_known = views.view_is_known  # type: ignore[misc]
        self.psf_place = views.psf_place  # type: ignore[misc]
        self._several = settings.readouts == "each"

    @property
    def _first(self) -> Imaging:
        return next(iter(self.parts.values()))

    def _states(self, lens: Lens) -> Iterator[tuple[Imaging, Lens]]:
        """Yield the views of each state, and the lens in it."""
        for name, part in self.parts.items():
            yield part, lens.in_state(name)

    @property
    def image_sensor(self) -> Sensor:
        """The whole sensor, of which an image may be a window."""
        return self._first.image_sensor

    def field_shares(self) -> Sequence[float]:
        """Return the fields that drawings show, over the sensor's half diagonal, from the axis."""
        return self._first.field_shares()

    def labels(self) -> Sequence[str]:
        """Names of the evaluation's views, for metrics."""
        return self._first.labels()

    def psf_labels(self) -> Sequence[str]:
        """Names of the point spread functions."""
        if not self._several:
            return self._first.psf_labels()
        return [f"{name}, {label}" for name in self.shares for label in self._first.psf_labels()]

    @property
    def readouts(self) -> int | None:
        """How many readouts an image has; None: one, and no list of it."""
        return len(self.shares) if self._several else None

    @property
    def noise(self) -> Sequence[float] | Sequence[Sequence[float]]:
        """The noise of each readout, as of `Readout.noise`."""
        if not self._several:
            return self.readout.noise
        return [self._readout(share).noise for share in self.shares.values()]

    def _readout(self, share: float) -> Readout:
        return replace(self.readout, exposure=share * self.readout.exposure)

    def take(self, lens: Lens, shot: Shot) -> Views:
        """Image textures in every state; see `Imaging.take`."""
        seed, share = shot.seed(self.seed), shot.share
        motion = self._motion(seed).to(shot.textures)
        found = []
        for moved, (part, there) in zip(motion, self._states(lens), strict=True):
            shown = shifted(shot.textures, moved) if bool(moved.any()) else shot.textures
            found.append(part.take(there, shot._replace(textures=shown)))
        middle = found[len(found) // 2]  # which does not move
        shares = list(self.shares.values())
        if not self._several:
            light = sum(s * one.raw for s, one in zip(shares, found, strict=True))
            assert isinstance(light, Tensor)  # there are two states at least
            raw = self._raw(light, seed, share)
            return Views(middle.truth, raw, middle.field, motion=motion)
        images = [
            self._raw(one.raw, seed + number * _READOUT_OFFSET, share, self._readout(own))
            for number, (own, one) in enumerate(zip(shares, found, strict=True))
        ]
        each = torch.stack(images, dim=2)
        weights = each.new_tensor(shares)
        mean = torch.einsum("n,bvnchw->bvchw", weights / weights.sum(), each)
        return Views(middle.truth, mean, middle.field, each, motion)

    def _motion(self, seed: int) -> Tensor:
        """Return where the scene is at each readout, pixels down and to the right, (N, 2)."""
        angle = 2.0 * math.pi * torch.rand((), generator=generator_of(seed + _MOTION_OFFSET))
        direction = torch.stack([angle.sin(), angle.cos()])
        count = len(self.shares)
        steps = torch.arange(count) - count // 2
        return self.settings.motion * steps[:, None] * direction

    def point_spread_functions(
        self,
        lens: Lens,
        pupil_samples: int | None = None,
        depths: Sequence[float] | None = None,
        size: int | None = None,
    ) -> Tensor:
        """(N, views, 3, K, K) of each state, of a scene at rest; of one readout (views, 3, K, K).

        Otherwise as `Imaging.point_spread_functions`.
        """
        asked = (pupil_samples, depths, size)
        return self._joined(self._of_states(lens, *asked), None)

    def _of_states(self, lens: Lens, *asked: Any) -> Sequence[Tensor]:
        return [part.point_spread_functions(there, *asked) for part, there in self._states(lens)]

    def functions_of_images(self, lens: Lens, taken: Views, stage: str) -> Tensor | None:
        """Return what restorers are told of images: with the motion as it is known, and where the
        views know their places, of those.

        Returns:
            (N, D, 3, K, K) of all images, or (B·V, N, D, 3, K, K); of one readout without N; None
            where functions are the same for all images, and the scene rests.
        """
        places = [
            part.functions_of_images(there, taken, stage) for part, there in self._states(lens)
        ]
        own = [functions for functions in places if functions is not None]
        known = self.settings.motion_is if self.settings.motion else "ignored"
        if known == "ignored" and not own:
            return None
        states, dim = (own, 1) if own else (self._of_states(lens), 0)
        if known == "known":
            return self._joined(states, taken.motion, dim)
        still = self._joined(states, None, dim)
        if known == "ignored":
            return still
        assert taken.readouts is not None  # only motion between several readouts is estimated
        motion = estimated_motion(
            taken.readouts.flatten(0, 1).to(still),
            still,
            torch.tensor(self.noise).to(still),
            len(self.shares) // 2,
            max(2.0, 2.0 * self.settings.motion * len(self.shares)),
        )
        return shifted(still, motion[:, :, None, None])

    def _joined(self, states: Sequence[Tensor], motion: Tensor | None, dim: int = 0) -> Tensor:
        """Join functions (..., D, 3, K, K) of the states, moved, into those of the readouts."""
        if motion is not None:
            states = [shifted(one, move) for one, move in zip(states, motion, strict=True)]
        if self._several:
            return torch.stack(list(states), dim=dim)
        weighted = [s * one for s, one in zip(self.shares.values(), states, strict=True)]
        return torch.stack(weighted).sum(dim=0)

    @property
    def has_plain_exposure(self) -> bool:
        """Whether there is a plain lens to compare with."""
        return self.settings.beside is not None and not self.view_is_known

    def plain_exposure(self, lens: Lens, shot: Shot) -> PlainExposure | None:
        """Return images of the scene at rest by the state `beside`."""
        if not self.has_plain_exposure:
            return None
        there = lens.in_state(self.settings.beside)
        taken = self._plain.take(there, shot._replace(share=None))
        functions = self._plain.point_spread_functions(there)
        return PlainExposure(taken, functions, self._plain.readout.noise)

    def whole_picture(self, lens: Lens, picture: Tensor, placing: Placing) -> WholePicture:
        """Image a picture at rest in every state; see `Imaging.whole_picture`.

        Raises:
            InputError: the views know the place in the field.
        """
        if self.view_is_known:
            raise InputError("exposures: whole pictures of a field; allowed: exposures=null")
        found = [part.whole_picture(there, picture, placing) for part, there in self._states(lens)]
        images = torch.stack([one.image for one in found], dim=1)
        weights = images.new_tensor(list(self.shares.values()))
        swept = torch.einsum("n,bnchw->bchw", weights, images)
        return found[0]._replace(image=images if self._several else swept)

    def sensed(self, image: Tensor, generator: torch.Generator) -> Tensor:
        """Return what the sensor gives; see `Imaging.sensed`."""
        if not self._several:
            return super().sensed(image, generator)
        each = zip(self.shares.values(), image.unbind(1), strict=True)
        return torch.stack([self._readout(s)(one, generator) for s, one in each], dim=1)

    def developed(self, signal: Tensor) -> Tensor:
        """Return the linear light of what the sensor gave."""
        if not self._several:
            return super().developed(signal)
        each = zip(self.shares.values(), signal.unbind(1), strict=True)
        return torch.stack([self._readout(s).develop(one) for s, one in each], dim=1)

    def reference_renderers(self) -> Sequence[str]:
        """Names of renderers that make the test images besides."""
        return self._first.reference_renderers()

    def spots(self, lens: Lens, rings: int, arms: int) -> list[SpotRays]:
        """Refuse: least squares of rays know one image alone.

        Raises:
            InputError: always.
        """
        raise InputError("optimizer.lens: dls; allowed with exposures: adam")

    def judged_by_training(self) -> Self:
        """Return these views with the training's renderer for evaluation images too."""
        found = copy.copy(self)
        found.parts = {name: part.judged_by_training() for name, part in self.parts.items()}
        return found

    def check(self, lens: Lens) -> None:
        """Raise `InputError` where a depth lies inside the lens; fix the scene's scale for it."""
        super().check(lens)
        for name, part in self.parts.items():
            part.check(lens.in_state(name))
        self._plain.check(lens.in_state(self.settings.beside))

    def expose(self, lens: Lens) -> None:
        """Set the exposure by the aperture of the lens, as `Imaging.expose`."""
        super().expose(lens)
        for name, part in self.parts.items():
            part.expose(lens.in_state(name))
        if self.settings.beside is not None:
            self._plain.expose(lens.in_state(self.settings.beside))

    def prepare(
        self,
        lens: Lens,
        comparison: Comparison | None = None,
        photographs: Tensor | None = None,
    ) -> None:
        """Let the training renderer look at the lens in each state, by the images alone."""
        for part, there in self._states(lens):
            part.prepare(there, None, photographs)

    def rays(self) -> int:
        """Rays that a training image takes, in all states; 0 before a renderer is chosen."""
        return sum(part.rays() for part in self.parts.values())

    def numbers(self) -> dict[str, float]:
        """The renderer's metrics of itself, of the first state."""
        return self._first.numbers()

    def state(self) -> dict[str, Any]:
        """Return what the renderers found, as plain values for a checkpoint."""
        return {name: part.state() for name, part in self.parts.items()}

    def load_state(self, lens: Lens, state: Mapping[str, Any]) -> None:
        """Go on with what another one's `state` held."""
        for name, part in self.parts.items():
            part.load_state(lens.in_state(name), state.get(name, {}))
