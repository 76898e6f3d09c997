"""Images, blurs and fields that several tests of restorers share."""

import torch


def raw_image(height=15, width=18, dtype=torch.float64):
    generator = torch.Generator().manual_seed(0)
    return torch.rand(2, 3, height, width, generator=generator, dtype=dtype)


def blur(depths=2, size=5, dtype=torch.float64):
    """Point spread functions that differ in depth and colour, of unit sum."""
    generator = torch.Generator().manual_seed(1)
    found = torch.rand(depths, 3, size, size, generator=generator, dtype=dtype)
    found[:, :, size // 2, size // 2] += 8.0
    return found / found.sum((-2, -1), keepdim=True)


def field_of(raw):
    """Coordinates with the sensor's centre in the middle of the image."""
    height, width = raw.shape[-2:]
    y, x = torch.meshgrid(torch.arange(height), torch.arange(width), indexing="ij")
    field = torch.stack([0.5 * (width - 1) - x, y - 0.5 * (height - 1)])
    return (2 * field / (height**2 + width**2) ** 0.5).expand(len(raw), 2, height, width)


def left_start(network):
    """Move all parameters, so that the network is no longer what it begins as."""
    generator = torch.Generator().manual_seed(5)
    with torch.no_grad():
        for parameter in network.parameters():
            parameter.add_(0.05 * torch.randn(parameter.shape, generator=generator))
    return network
