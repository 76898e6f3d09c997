"""Discriminators, and what they and a restorer learn from each other."""

import pytest
import torch
from torch import nn
from torch.nn import functional

from dolens.errors import InputError
from dolens.reconstruction import (
    GlobalDiscriminator,
    PatchDiscriminator,
    RelativisticDiscriminators,
    relativistic_discriminator_loss,
    relativistic_generator_loss,
)


def double_scale(width=4):
    return RelativisticDiscriminators(
        {"local": PatchDiscriminator(width, 2), "global": GlobalDiscriminator(width, 3)}
    )


def images(batch=3):
    generator = torch.Generator().manual_seed(0)
    real = torch.rand(batch, 3, 24, 24, generator=generator)
    return real, functional.avg_pool2d(real, 3, stride=1, padding=1)


class Level(nn.Module):
    """Scores an image by a multiple of its mean."""

    def __init__(self, factor):
        super().__init__()
        self.factor = nn.Parameter(torch.tensor(factor))

    def forward(self, image):
        return self.factor * image.mean(dim=(1, 2, 3))


# Scores of true and of restored images, the discriminator's and the generator's loss, by hand.
SCORES = [
    ([2.0], [0.5], 0.25, 6.25),  # ½(0.5² + 0.5²), ½(2.5² + 2.5²)
    ([1.0, 3.0], [0.0, 1.0], 0.875, 6.875),  # ½(½(0.25 + 2.25) + ½(1 + 0)), ½(7.25 + 6.5)
    ([0.7, 0.7], [0.7], 1.0, 1.0),  # undecided
    ([1.5], [0.5], 0.0, 4.0),  # told apart by one
    ([-0.5], [0.5], 4.0, 0.0),  # fooled by one
]


@pytest.mark.parametrize("real, fake, of_discriminator, of_generator", SCORES)
def test_losses_of_scores_worked_out_by_hand(real, fake, of_discriminator, of_generator):
    real, fake = torch.tensor(real), torch.tensor(fake)
    assert relativistic_discriminator_loss(real, fake).item() == pytest.approx(of_discriminator)
    assert relativistic_generator_loss(real, fake).item() == pytest.approx(of_generator)


def test_only_differences_of_scores_count():
    generator = torch.Generator().manual_seed(1)
    real, fake = torch.randn(2, 3, 1, 5, 5, generator=generator, dtype=torch.float64)
    for loss in (relativistic_discriminator_loss, relativistic_generator_loss):
        torch.testing.assert_close(loss(real + 7, fake + 7), loss(real, fake))
        assert (loss(real + 1, fake) - loss(real, fake)).abs() > 0.1


def test_losses_are_the_means_over_the_discriminators():
    real, fake = torch.full((2, 3, 4, 4), 0.75), torch.full((2, 3, 4, 4), 0.25)
    several = RelativisticDiscriminators({"a": Level(2.0), "b": Level(4.0)})
    # Scores differ by 1 and by 2: losses 0 and 1 of the discriminator, 4 and 9 of the generator.
    assert several.discriminator_loss(real, fake).item() == pytest.approx(0.5)
    assert several.generator_loss(real, fake).item() == pytest.approx(6.5)


def test_the_generator_s_loss_reaches_the_restored_image_alone():
    discriminators, (real, fake) = double_scale(), images()
    real, fake = real.requires_grad_(), fake.requires_grad_()
    discriminators.generator_loss(real, fake).backward()
    assert all(parameter.grad is None for parameter in discriminators.parameters())
    assert all(parameter.requires_grad for parameter in discriminators.parameters())
    assert real.grad is None
    assert (fake.grad.abs().amax(dim=(1, 2, 3)) > 0).all()


def test_the_generator_s_gradient_is_that_of_its_loss():
    discriminators = double_scale().double().eval()
    real, fake = (batch.double() for batch in images())
    fake.requires_grad_()
    discriminators.generator_loss(real, fake).backward()
    direction = torch.randn(
        fake.shape, generator=torch.Generator().manual_seed(1), dtype=torch.float64
    )
    step = 1e-7  # ten times as far, one weight in sixty has a kink of the activation between
    ahead, behind = (
        torch.stack(
            [
                relativistic_generator_loss(d(real), d(fake.detach() + sign * step * direction))
                for d in discriminators.discriminators.values()
            ]
        ).mean()
        for sign in (1, -1)
    )
    slope = (ahead - behind) / (2 * step)
    torch.testing.assert_close((fake.grad * direction).sum(), slope.detach(), rtol=1e-5, atol=0)


def test_the_generator_s_loss_leaves_the_discriminators_as_they_were():
    discriminators, (real, fake) = double_scale().train(), images()
    before = {name: value.clone() for name, value in discriminators.state_dict().items()}
    discriminators.generator_loss(real, fake)
    after = discriminators.state_dict()
    assert all(torch.equal(after[name], value) for name, value in before.items())
    discriminators.discriminator_loss(real, fake)  # which goes on with the power iteration
    after = discriminators.state_dict()
    assert not all(torch.equal(after[name], value) for name, value in before.items())


def test_the_discriminators_loss_reaches_all_their_parameters_and_no_image():
    discriminators, (real, fake) = double_scale(), images()
    real, fake = real.requires_grad_(), fake.requires_grad_()
    discriminators.discriminator_loss(real, fake).backward()
    assert real.grad is None and fake.grad is None
    gradients = {name: p.grad for name, p in discriminators.named_parameters()}
    # A constant added to all scores changes nothing: the last biases have no gradient.
    last = {"discriminators.local.layers.6.bias", "discriminators.global.score.bias"}
    for name, gradient in gradients.items():
        largest = gradient.abs().max()
        assert largest < 1e-6 if name in last else largest > 1e-6, name


def test_discriminators_learn_to_tell_blurred_from_sharp():
    torch.manual_seed(0)
    discriminators, (real, fake) = double_scale(width=8), images(batch=4)
    optimizer = torch.optim.Adam(discriminators.parameters(), lr=1e-2)
    for _ in range(25):
        optimizer.zero_grad()
        loss = discriminators.discriminator_loss(real, fake)
        loss.backward()
        optimizer.step()
    assert loss < 0.5  # an undecided one has 1
    assert discriminators.generator_loss(real, fake) > 1.5


def test_a_discriminator_of_one_s_own_needs_only_to_be_a_module():
    discriminators = RelativisticDiscriminators({"only": Level(1.0)}, weight=0.0)
    assert discriminators.weight == 0
    assert list(discriminators.state_dict()) == ["discriminators.only.factor"]


def test_no_discriminator_and_a_negative_weight_are_refused():
    with pytest.raises(InputError, match="discriminators: at least one"):
        RelativisticDiscriminators({})
    for weight in (-1.0, float("inf")):
        with pytest.raises(InputError, match=f"weight={weight}: must be finite"):
            RelativisticDiscriminators({"a": Level(1.0)}, weight=weight)


# ---------------------------------------------------------------- discriminators


def picture(size, batch=1):
    generator = torch.Generator().manual_seed(0)
    return torch.rand(batch, 3, size, size, generator=generator, dtype=torch.float64)


def seen_pixels(score, batch):
    """(H, W), bool: where an image's values change a score."""
    (gradient,) = torch.autograd.grad(score, batch)
    return gradient[0].abs().amax(dim=0) > 0


@pytest.mark.parametrize("halvings, patch", [(1, 16), (2, 34), (3, 70)])
def test_a_score_sees_a_square_patch(halvings, patch):
    discriminator = PatchDiscriminator(width=4, halvings=halvings).double()
    batch = picture(144).requires_grad_()
    scores = discriminator(batch)
    middle = scores.shape[-1] // 2
    seen = seen_pixels(scores[0, 0, middle, middle], batch)
    assert seen.sum() == patch**2
    assert seen.any(dim=0).sum() == seen.any(dim=1).sum() == patch


@pytest.mark.parametrize("halvings", [2, 5])
def test_the_global_score_sees_every_pixel(halvings):
    batch = picture(64).requires_grad_()
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
def test_scores_know_an_image_s_level_and_no_other_picture(kind):
    discriminator = kind(width=4, halvings=2).double().eval()
    batch = picture(32, batch=2)
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


def test_more_halvings_than_any_photograph_allows_are_refused():
    with pytest.raises(InputError, match=r"discriminator halvings=17: .* at most 16"):
        GlobalDiscriminator(halvings=17)
