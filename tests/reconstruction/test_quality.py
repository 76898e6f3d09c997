"""Measures of restored pictures, and bootstrap intervals of them against normal theory."""

import math

import pytest
import torch
from scipy.stats import t as student_t
from torchmetrics.functional.image import structural_similarity_index_measure

from dolens.reconstruction import psnr_db, quality, structural_similarity
from dolens.reconstruction.quality import bootstrap_interval, gain_interval


def truth(batch=2):
    generator = torch.Generator().manual_seed(0)
    return 0.3 + 0.4 * torch.rand(batch, 3, 24, 20, generator=generator, dtype=torch.float64)


@pytest.mark.parametrize("batch", [1, 3])
def test_psnr_of_a_known_offset_is_known_for_each_image(batch):
    offset = torch.tensor([0.1, 0.01, 0.2], dtype=torch.float64)[:batch]
    ratio = psnr_db(truth(batch) + offset.view(-1, 1, 1, 1), truth(batch))
    assert ratio.shape == (batch,)
    torch.testing.assert_close(ratio, -20 * torch.log10(offset))


def test_values_beyond_the_display_do_not_count():
    white = torch.ones(1, 3, 16, 16)
    assert psnr_db(white + 5, white).item() == math.inf
    torch.testing.assert_close(structural_similarity(white + 5, white), torch.ones(1))


@pytest.mark.parametrize("batch", [1, 3])
def test_structural_similarity_is_one_for_equal_images(batch):
    similarity = structural_similarity(truth(batch), truth(batch))
    torch.testing.assert_close(similarity, torch.ones(batch, dtype=torch.float64))


def test_structural_similarity_of_uniform_images_is_the_luminance_term():
    a, b, constant = 0.2, 0.6, 0.01**2
    images = [torch.full((1, 3, 16, 16), value, dtype=torch.float64) for value in (a, b)]
    expected = (2 * a * b + constant) / (a**2 + b**2 + constant)
    torch.testing.assert_close(structural_similarity(*images).item(), expected)


def test_the_worse_image_of_a_batch_scores_lower():
    noise = torch.randn(truth().shape, generator=torch.Generator().manual_seed(1)).double()
    restored = truth() + torch.tensor([0.01, 0.1]).view(2, 1, 1, 1) * noise
    for measure in (psnr_db, structural_similarity):
        good, bad = measure(restored, truth())
        assert good > bad


def test_strips_of_rows_give_the_same_similarity_as_the_whole(monkeypatch):
    generator = torch.Generator().manual_seed(2)
    restored = truth() + 0.1 * torch.randn(truth().shape, generator=generator).double()
    whole = structural_similarity(restored, truth())
    expected = structural_similarity_index_measure(
        restored.clamp(0, 1), truth(), reduction="none", data_range=1.0
    )
    torch.testing.assert_close(whole, expected)
    for pixels in (1, 13 * 2 * 20, 23 * 2 * 20):
        monkeypatch.setattr(quality, "_PIXELS", pixels)
        torch.testing.assert_close(structural_similarity(restored, truth()), whole)


def test_sizes_that_cannot_be_compared_are_refused():
    for measure in (psnr_db, structural_similarity):
        with pytest.raises(ValueError, match="expected one shape"):
            measure(torch.zeros(1, 3, 16, 16), torch.zeros(2, 3, 16, 16))
    with pytest.raises(ValueError, match="at least 11×11"):
        structural_similarity(torch.zeros(1, 3, 10, 16), torch.zeros(1, 3, 10, 16))


# ---------------------------------------------------------------- intervals


def first(means):
    return means[:, 0]


def worst(means):
    return means.amin(dim=-1)


def seeded(seed=0):
    return torch.Generator().manual_seed(seed)


@pytest.mark.parametrize("shape", [(1, 60), (60, 1)])
def test_one_factor_has_students_interval(shape):
    # Of normal scores: mean ± t s/√n.
    scores = torch.randn(shape, generator=seeded(1), dtype=torch.float64)
    found = bootstrap_interval(scores[..., None], first, seeded(), resamples=40000)
    half = student_t.ppf(0.975, 59) * float(scores.std()) / math.sqrt(60)
    mean = float(scores.mean())
    assert found.estimate == pytest.approx(mean, abs=1e-12)
    assert found.low == pytest.approx(mean - half, abs=0.05 * half)
    assert found.high == pytest.approx(mean + half, abs=0.05 * half)


def test_few_photographs_have_students_interval_too():
    # No resample of three photographs goes beyond them; t at two degrees of freedom does.
    scores = torch.tensor([1.0, 2.0, 3.0], dtype=torch.float64)[None, :, None]
    found = bootstrap_interval(scores, first, seeded(), resamples=40000)
    half = student_t.ppf(0.975, 2) / math.sqrt(3)
    assert found.low == pytest.approx(2.0 - half, rel=0.02)
    assert found.high == pytest.approx(2.0 + half, rel=0.02)


def test_the_interval_reaches_further_to_the_side_of_rare_scores():
    scores = torch.zeros(1, 30, 1, dtype=torch.float64)
    scores[0, :2] = 10.0
    found = bootstrap_interval(scores, first, seeded())
    half = student_t.ppf(0.975, 29) * float(scores.std()) / math.sqrt(30)
    assert found.low == pytest.approx(found.estimate - half, abs=0.05 * half)
    assert found.high > found.estimate + 1.05 * half


@pytest.mark.parametrize("level", [0.8, 0.95])
@pytest.mark.parametrize(
    ("seeds", "photographs", "of_seeds", "of_photographs"),
    [(5, 40, 0.1, 0.5), (5, 40, 0.3, 0.3), (1, 40, 0.0, 1.0), (1, 3, 0.0, 1.0)],
)
def test_coverage_of_normal_scores(level, seeds, photographs, of_seeds, of_photographs):
    generator, covered, trials = seeded(2), 0, 300
    for _ in range(trials):
        scores = (
            of_seeds * torch.randn(seeds, 1, 1, generator=generator)
            + of_photographs * torch.randn(1, photographs, 1, generator=generator)
            + 0.2 * torch.randn(seeds, photographs, 1, generator=generator)
        )
        found = bootstrap_interval(scores, first, generator, level, resamples=500)
        covered += found.low <= 0.0 <= found.high
    # Within four standard deviations of the count, and above by what is a little too wide.
    spread = math.sqrt(level * (1 - level) / trials)
    assert level - 4 * spread <= covered / trials <= level + 4 * spread + 0.03


def test_seeds_of_few_photographs_do_not_hide_that_they_are_few():
    # Four seeds on each of nine photographs: the spread is that of nine, not of thirty-six.
    of_photographs = torch.randn(1, 9, 1, generator=seeded(3)).double()
    alone = bootstrap_interval(of_photographs, first, seeded(), resamples=20000)
    repeated = bootstrap_interval(
        of_photographs.expand(4, -1, -1), first, seeded(), resamples=20000
    )
    width = alone.high - alone.low
    assert repeated.high - repeated.low == pytest.approx(width, rel=0.05)


def test_a_constant_gain_has_no_width_however_photographs_differ():
    against = 10.0 * torch.randn(3, 20, 2, generator=seeded(4)).double()
    found = gain_interval(against + 0.3, against, worst, seeded())
    assert (found.seeds, found.photographs) == (3, 20)
    assert found.estimate == pytest.approx(0.3)
    assert found.low == pytest.approx(0.3) and found.high == pytest.approx(0.3)
    apart = bootstrap_interval(against, worst, seeded())
    assert apart.high - apart.low > 5.0


def test_the_worst_view_is_the_worst_of_the_means():
    # Each view is the worst on half of the photographs: the mean of minima would be 0.
    scores = torch.tensor([[[0.0, 2.0], [2.0, 0.0]]], dtype=torch.float64)
    assert bootstrap_interval(scores, worst, seeded()).estimate == 1.0


def test_a_gain_is_the_difference_of_the_means_that_are_printed_for_the_seeds():
    # One seed is worst in the first view, the other in the second: each is printed with its own.
    scores = torch.tensor([[[24.0, 26.0]], [[27.0, 25.0]]]).expand(-1, 4, -1)
    against = torch.tensor([[[23.0, 24.0]], [[23.5, 24.0]]]).expand(-1, 4, -1)
    printed = [float(worst(side.mean(dim=1)).mean()) for side in (scores, against)]
    assert printed == [24.5, 23.25]
    assert gain_interval(scores, against, worst, seeded()).estimate == printed[0] - printed[1]


@pytest.mark.parametrize("photographs", [1, 3])
def test_two_seeds_with_worst_views_of_their_own_have_students_interval(photographs):
    # Their worst means are 24 and 25, whatever the photographs, which are all alike.
    scores = torch.tensor([[[24.0, 26.0]], [[27.0, 25.0]]]).expand(-1, photographs, -1)
    found = bootstrap_interval(scores, worst, seeded(), resamples=20000)
    half = student_t.ppf(0.975, 1) * 0.5
    assert found.low == pytest.approx(24.5 - half, rel=0.02)
    assert found.high == pytest.approx(24.5 + half, rel=0.02)


def test_the_same_generator_gives_the_same_interval():
    scores = torch.randn(3, 12, 2, generator=seeded(5))
    found = bootstrap_interval(scores, worst, seeded(6))
    assert bootstrap_interval(scores, worst, seeded(6)) == found
    assert bootstrap_interval(scores, worst, seeded(7)) != found


def test_one_seed_and_one_photograph_have_no_interval():
    found = bootstrap_interval(torch.ones(1, 1, 2), worst, seeded())
    assert found.estimate == 1.0
    assert math.isnan(found.low) and math.isnan(found.high)


def test_scores_that_are_not_finite_have_no_interval():
    scores = torch.tensor([[[1.0], [math.inf]]])
    assert math.isnan(bootstrap_interval(scores, first, seeded()).low)


@pytest.mark.parametrize(
    ("arguments", "words"),
    [
        ({"scores": torch.ones(3, 4)}, "shape"),
        ({"scores": torch.ones(0, 4, 1)}, "shape"),
        ({"level": 1.0}, "level"),
        ({"resamples": 1}, "resamples"),
    ],
)
def test_bad_arguments_are_named(arguments, words):
    given = {"scores": torch.ones(2, 3, 1), "statistic": first, "generator": seeded()}
    with pytest.raises(ValueError, match=words):
        bootstrap_interval(**{**given, **arguments})


def test_cameras_judged_on_different_photographs_are_refused():
    with pytest.raises(ValueError, match="same seeds, photographs and views"):
        gain_interval(torch.ones(2, 3, 1), torch.ones(2, 4, 1), first, seeded())
