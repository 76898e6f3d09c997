"""Photographs given a depth, as one image each: extended depth of field where depths meet."""

from collections.abc import Mapping
from typing import Any

from torch import Tensor

from dolens.errors import InputError
from dolens.experiments.camera.views.base import SCENE_OFFSET, Views, seed_of
from dolens.experiments.camera.views.depths import DepthViews
from dolens.experiments.data.occluders import with_occluders
from dolens.optics.lens import Lens
from dolens.scene.layered import LayeredScene
from dolens.sensor.noise import BatchShare, generator_of


class LayerViews(DepthViews):
    """Scenes with a depth at every texel, in front of the whole sensor.

    Textures that have a depth as their last channel are taken as they are; photographs are given
    one, with edges where near things hide far ones, drawn from the seed, the stage and the index.

    Args:
        scene: the planes.
        occluders: ellipses in front of each photograph.
        **settings: those of `DepthViews`.

    Raises:
        InputError: the scene is not one of layers.
    """

    def __init__(self, scene: LayeredScene, occluders: int = 8, **settings: Any) -> None:
        super().__init__(scene, **settings)
        if not isinstance(scene, LayeredScene):
            raise InputError("views: layers need a scene of layers; choose scene=layers")
        self.occluders = occluders

    def take(
        self,
        lens: Lens,
        values: Mapping[str, Tensor],
        textures: Tensor,
        stage: str,
        index: int,
        reference: str | None = None,
        share: BatchShare | None = None,
    ) -> Views:
        """One image of each texture."""
        if textures.shape[1] == len(self.scene.wavelengths):
            generator = generator_of(seed_of(self.seed, stage, index) + SCENE_OFFSET)
            near, far = self.scene.depths[0], self.scene.depths[-1]
            before = 0 if share is None else share.first
            textures = with_occluders(textures, near, far, self.occluders, generator, before)
        return super().take(lens, values, textures, stage, index, reference, share)
