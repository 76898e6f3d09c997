"""Weights that torchvision publishes are read from a file or the torch cache, and downloaded only
where the configuration says so.
"""

import logging
import os
import socket
from collections.abc import Callable, Mapping
from dataclasses import dataclass
from http.client import HTTPException
from pathlib import Path

import torch
from torch import Tensor

from dolens.errors import InputError, one_line

logger = logging.getLogger(__name__)

DOWNLOAD_TIMEOUT_S = 10.0
# ImageNet's statistics of sRGB values, with which torchvision's own weights were trained.
IMAGENET_MEAN = (0.485, 0.456, 0.406)
IMAGENET_STANDARD_DEVIATION = (0.229, 0.224, 0.225)


class PretrainedWeightsUnavailable(InputError):
    """Weights were not given, are not cached, and were not or could not be downloaded; the message
    says what to do.
    """


def published_address(name: str) -> str:
    """Return torchvision's address of weights, as `VGG16_Weights.IMAGENET1K_V1`.

    torchvision is loaded here, for restorers that have none of its networks need none of it.
    """
    from torchvision.models import get_weight

    return str(get_weight(name).url)


@dataclass(frozen=True)
class PublishedWeights:
    """A `PublishedWeights` names one of torchvision's files of weights for messages.

    Attributes:
        network: whose weights they are.
        purpose: of the weights, for messages.
        address: torchvision's of the file, asked for when it is needed; see `published_address`.
        megabytes: size of the download.
        key: the configuration key that names a file of one's own, `group.argument`.
        choice: the configuration key whose value `download` allows the download.
        prefix: beginning of the wanted parameters' names in the whole network's state dict.
    """

    network: str
    purpose: str
    address: Callable[[], str]
    megabytes: int
    key: str
    choice: str
    prefix: str = ""

    @property
    def url(self) -> str:
        """Return the address of the file."""
        return self.address()

    @property
    def file_name(self) -> str:
        """Return the file's name in the torch cache."""
        return self.url.rsplit("/", 1)[-1]

    def load(
        self, path: str | None, expected: Mapping[str, Tensor], download: bool = False
    ) -> dict[str, Tensor]:
        """Find the weights.

        In order: the file `path`, if one is given; torchvision's file in the torch cache
        (`torch.hub.get_dir()`/checkpoints); and, with `download` alone, torchvision's download
        into that cache, announced as a warning and tried once, with 10 s for each connection and
        each read.  The file that is read is logged.

        Args:
            path: a file saved by `torch.save` with a state dict of the whole network or, where
                there is a prefix, of that part alone, without it; or None.
            expected: tensors of the wanted names, without the prefix, and shapes; values are
                not looked at, so that they may be on the meta device.
            download: whether the network may be used where no file is found.

        Returns:
            Tensors of exactly the names and shapes of `expected`, on the CPU.

        Raises:
            InputError: `path`, or the file in the cache, is missing, unreadable or of another
                network.
            PretrainedWeightsUnavailable: no path is given, the cache is empty, and the download
                is not allowed or failed.
        """
        if path is not None:
            file = Path(path).expanduser()
            if not file.is_file():
                raise InputError(f"{self._argument} {file}: no such file")
            return self._select(file, expected)
        cached = Path(torch.hub.get_dir()).expanduser() / "checkpoints" / self.file_name
        if not cached.is_file():
            if not download:
                raise PretrainedWeightsUnavailable(
                    f"{self._missing(cached)}; or allow the download of {self.url} "
                    f"({self.megabytes} MB) by {self.choice}=download"
                )
            self._download(cached)
        return self._select(cached, expected)

    @property
    def _argument(self) -> str:
        return self.key.rsplit(".", 1)[-1]

    def _select(self, file: Path, expected: Mapping[str, Tensor]) -> dict[str, Tensor]:
        where = f"{self._argument} {file}"
        try:
            state = torch.load(file, map_location="cpu", weights_only=True)
        except Exception as error:  # a file of any other kind fails in many ways inside torch.load
            reason = f"cannot be read as PyTorch weights ({type(error).__name__})"
            raise InputError(f"{where}: {reason}") from error
        if not isinstance(state, Mapping):
            raise InputError(f"{where}: holds no state dict of {self.network}")
        weights: dict[str, Tensor] = {}
        for name, wanted in expected.items():
            full = f"{self.prefix}{name}"
            value = state.get(full, state.get(name))
            if not isinstance(value, Tensor):
                raise InputError(f"{where}: no {full}; not a {self.network} state dict")
            if value.shape != wanted.shape:
                raise InputError(
                    f"{where}: {full} has shape {tuple(value.shape)}, "
                    f"in {self.network} it is {tuple(wanted.shape)}"
                )
            weights[name] = value
        logger.info("%s weights for %s: %s", self.network, self.purpose, file)
        return weights

    def _missing(self, cached: Path) -> str:
        return (
            f"no {self.network} weights for {self.purpose}: give {self.key}=FILE; or put "
            f"{self.file_name} into {cached.parent}"
        )

    def _download(self, destination: Path) -> None:
        logger.warning(
            "downloading %s weights for %s (%d MB) from %s to %s",
            self.network,
            self.purpose,
            self.megabytes,
            self.url,
            destination,
        )
        # torch.hub sets no timeout of its own, and without one an offline machine may hang.
        previous = socket.getdefaulttimeout()
        socket.setdefaulttimeout(DOWNLOAD_TIMEOUT_S)
        try:
            os.makedirs(destination.parent, exist_ok=True)
            # torchvision's file names end in the first digits of the file's SHA-256.
            digest = destination.stem.rsplit("-", 1)[-1]
            torch.hub.download_url_to_file(
                self.url, str(destination), hash_prefix=digest, progress=False
            )
        except (OSError, HTTPException, RuntimeError) as error:  # network, disk, or a wrong hash
            reason = one_line(error) or type(error).__name__
            raise PretrainedWeightsUnavailable(
                f"{self._missing(destination)}; the download of {self.url} failed: {reason}"
            ) from error
        finally:
            socket.setdefaulttimeout(previous)
