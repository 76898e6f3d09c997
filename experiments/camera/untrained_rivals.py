"""Restorers that nothing has trained, beside the network of a camera."""

from collections.abc import Mapping

import torch
from torch import Tensor

from dolens.experiments.camera.base import Camera
from dolens.experiments.camera.views.base import Views
from dolens.reconstruction import WienerBM3DRestoration, WienerTVRestoration
from dolens.reconstruction.untrained import bm3d_is_installed
from dolens.sensor.pixels import Sensor

# By what names of scores begin with, and what these restorers are called.
RIVALS = {
    "tv": "Wiener's filter and total variation, which nothing has trained",
    "bm3d": "Wiener's filter and BM3D, which nothing has trained",
}
# Pixels along each side: on smaller images the package bm3d may end the whole program.
_LEAST_BM3D = 32
_MADE = {"tv": WienerTVRestoration, "bm3d": WienerBM3DRestoration}


def rival_names(sensor: Sensor) -> list[str]:
    """Return the keys of `RIVALS` that this installation has, for images of a sensor's size."""
    small = min(sensor.height, sensor.width) < _LEAST_BM3D
    return [name for name in RIVALS if name != "bm3d" or (bm3d_is_installed() and not small)]


@torch.no_grad()
def restored_by_rivals(
    camera: Camera, taken: Views, functions: Tensor | None, values: Mapping[str, Tensor]
) -> dict[str, Tensor]:
    """Return images (B, V, 3, H, W), display-encoded, by the name of who restored them.

    They know what a network may know: the sensor's noise, and the point spread functions of each
    image's own place where a camera knows it, else of all views.

    Args:
        camera: whose images they are.
        taken: what the sensor gave.
        functions: that the camera's network was told; None where it asks for none.
        values: of the lens's variables.
    """
    if functions is None or functions.ndim == taken.given.ndim:  # not of each image its own
        own = camera.views.functions_of_images(camera.lens, values, taken, "test")
        functions = functions if own is None else own
    if functions is None:
        functions = camera.views.point_spread_functions(camera.lens, values)
    rivals = {name: _MADE[name]() for name in rival_names(camera.views.sensor)}
    noise = torch.tensor(camera.views.noise)
    return {
        name: rival(taken.given, functions, None, noise).unflatten(0, taken.raw.shape[:2])
        for name, rival in rivals.items()
    }
