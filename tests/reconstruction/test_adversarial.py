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
