"""Photographs with depth maps are read from any folder of both."""

import math
from dataclasses import replace
from functools import partial
from pathlib import Path
from typing import Any

import numpy as np

from dolens.errors import InputError
from dolens.experiments.data.camera_data import Split
from dolens.experiments.data.depth_maps import ENDINGS, depth_map_of, is_depth_map, read_depth_map
from dolens.experiments.data.folder_index import FolderIndex
from dolens.experiments.data.folder_photographs import FolderPhotographs
from dolens.experiments.data.image_folder import ImageFolderDataModule
from dolens.experiments.data.photographs import Photograph, read_photograph


class RgbdFolderDataModule(ImageFolderDataModule):
    """`RgbdFolderDataModule` cuts crops of photographs with depth (mm) as a fourth channel, for
    `scene=layers`.

    Beside each photograph lies its depth map: `hall.jpg` and `hall_depth.png`.

    Args:
        root: the folder, searched recursively; split as `ImageFolderDataModule` says.
        depth_suffix: ending of a depth map's name after the photograph's.
        depth_unit: mm per unit of the maps' numbers: 1 for millimetres (Kinect), 1000 for metres,
            0.2 for the TUM benchmark's 5000 a metre.
        **settings: those of `ImageFolderDataModule`.

    Raises:
        InputError: an argument is out of range; at set-up, a photograph has no depth map.
    """

    def __init__(
        self,
        root: str | Path,
        depth_suffix: str = "_depth",
        depth_unit: float = 1.0,
        **settings: Any,
    ) -> None:
        super().__init__(root, **settings)
        if not depth_suffix:
            raise InputError("data.depth_suffix: empty; allowed: such as _depth")
        if not 0.0 < depth_unit < math.inf:
            raise InputError(f"data.depth_unit: {depth_unit}; allowed: mm per unit, above 0")
        self.depth_suffix, self.depth_unit = depth_suffix, float(depth_unit)

    def load_split(self, split: Split) -> FolderPhotographs:
        """Return the photographs of a split with their depths, none of them decoded yet."""
        read = partial(
            _read, suffix=self.depth_suffix, unit=self.depth_unit, megapixels=self.megapixels
        )
        return self._photographs_of(split, read)

    def _wanted(self, index: FolderIndex) -> np.ndarray:
        """Return photographs alone, each of which must have a depth map."""
        paths = {number: index.folder / name for number, name in enumerate(index.names)}
        photographs = [n for n, p in paths.items() if not is_depth_map(p, self.depth_suffix)]
        missing = [
            paths[n] for n in photographs if depth_map_of(paths[n], self.depth_suffix) is None
        ]
        if missing:
            first = missing[0]
            raise InputError(
                f"{first}: no depth map beside it (nor beside {len(missing) - 1} others); allowed: "
                f"{first.stem}{self.depth_suffix} with the ending {', '.join(ENDINGS)}"
            )
        return np.array(photographs, dtype=np.int32)


def _read(path: Path, suffix: str, unit: float, megapixels: float) -> Photograph:
    """Read a photograph and its depth map."""
    photograph = read_photograph(path, megapixels=megapixels)
    beside = depth_map_of(path, suffix)
    if beside is None:
        raise InputError(f"{path}: its depth map is no longer there")
    depth = read_depth_map(beside, unit, megapixels)
    return replace(photograph, depth=depth)
