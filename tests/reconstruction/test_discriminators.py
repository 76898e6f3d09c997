import pytest
import torch
from torch import nn

from dolens.errors import InputError
from dolens.reconstruction import GlobalDiscriminator, PatchDiscriminator


@pytest.fixture(autouse=True)
def _seed():
    torch.manual_seed(1)


def image(size, batch=1):
    generator = torch.Generator().manual_seed(0)
    return torch.rand(batch, 3, size, size, generator=generator, dtype=torch.float64)


def seen_pixels(score, batch):
    """(H, W), bool: where an image's values change a score."""
    (gradient,) = torch.autograd.grad(score, batch)
    return gradient[0].abs().amax(dim=0) > 0


@pytest.mark.parametrize("halvings, patch", [(1, 16), (2, 34), (3, 70)])
def test_a_score_sees_a_square_patch(halvings, patch):
    discriminator = PatchDiscriminator(width=4, halvings=halvings).double()
    batch = image(144).requires_grad_()
    scores = discriminator(batch)
    middle = scores.shape[-1] // 2
    seen = seen_pixels(scores[0, 0, middle, middle], batch)
    assert seen.sum() == patch**2
    assert seen.any(dim=0).sum() == seen.any(dim=1).sum() == patch


@pytest.mark.parametrize("halvings", [2, 5])
def test_the_global_score_sees_every_pixel(halvings):
    batch = image(64).requires_grad_()
    score = GlobalDiscriminator(width=4, halvings=halvings).double()(batch)
    assert score.shape == (1, 1)
    assert seen_pixels(score.squeeze(), batch).all()


def test_scores_of_any_image_size():
    batch = torch.rand(2, 3, 40, 65)
    assert PatchDiscriminator(4, 3)(batch).shape == (2, 1, 3, 6)
    assert GlobalDiscriminator(4, 5)(batch).shape == (2, 1)


def test_channels_double_eightfold_at_most():
    convolutions = [
        [part.out_channels for part in discriminator.modules() if isinstance(part, nn.Conv2d)]
        for discriminator in (PatchDiscriminator(64, 3), GlobalDiscriminator(8, 5))
    ]
    assert convolutions == [[64, 128, 256, 512, 1], [8, 16, 32, 64, 64]]


@pytest.mark.parametrize("kind", [PatchDiscriminator, GlobalDiscriminator])
def test_every_weight_has_a_spectral_norm_of_one(kind):
    discriminator = kind(width=8, halvings=2)
    with torch.no_grad():
        for _ in range(60):  # the power iteration goes one step a pass
            discriminator(torch.rand(1, 3, 16, 16))
    layers = [p for p in discriminator.modules() if isinstance(p, nn.Conv2d | nn.Linear)]
    norms = [torch.linalg.svdvals(p.weight.detach().flatten(1))[0].item() for p in layers]
    assert norms == pytest.approx([1.0] * len(layers), rel=0.02)


@pytest.mark.parametrize("kind", [PatchDiscriminator, GlobalDiscriminator])
def test_scores_know_an_image_s_level_and_no_other_image(kind):
    discriminator = kind(width=4, halvings=2).double().eval()
    batch = image(32, batch=2)
    torch.testing.assert_close(discriminator(batch)[:1], discriminator(batch[:1]))
    dark, bright = (discriminator(torch.full_like(batch, level)) for level in (0.1, 0.9))
    assert (dark - bright).mean().abs() > 1e-3


def test_an_image_too_small_is_refused_with_what_would_do():
    with pytest.raises(InputError, match="halvings=3 needs at least 24×24; choose fewer"):
        PatchDiscriminator(4, 3)(torch.rand(1, 3, 64, 23))
    with pytest.raises(InputError, match="halvings=5 needs at least 32×32"):
        GlobalDiscriminator(4, 5)(torch.rand(1, 3, 31, 64))
    assert PatchDiscriminator(4, 3)(torch.rand(1, 3, 24, 24)).numel() == 1
    assert GlobalDiscriminator(4, 5)(torch.rand(1, 3, 32, 32)).numel() == 1


@pytest.mark.parametrize("kind", [PatchDiscriminator, GlobalDiscriminator])
@pytest.mark.parametrize("name", ["width", "halvings"])
def test_sizes_below_one_are_refused_by_name(kind, name):
    with pytest.raises(InputError, match=f"discriminator {name}=0"):
        kind(**{name: 0})
