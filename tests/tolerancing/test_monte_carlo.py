"""Lenses of a batch against the same lenses one by one; the compensator; yields."""

import math

import pytest
import torch

from dolens import InputError, load_lens
from dolens.analysis.pupil_quadrature import gaussian_quadrature
from dolens.tolerancing import (
    Outcome,
    Yield,
    quantiles,
    share_within,
    spot_weights,
    tolerances_from,
    trace_perturbed,
)


def test_each_lens_of_the_batch_is_the_lens_itself_traced_by_the_kernel(
    triplet, spots, settings, moved, traced_spots
):
    tolerances = tolerances_from(triplet, settings)
    errors = tolerances.draw(5, torch.Generator().manual_seed(0))
    found = trace_perturbed(triplet, spots, tolerances.names, errors)
    for row, error in enumerate(errors.tolist()):
        lens = moved(triplet, dict(zip(tolerances.names, error, strict=True)))
        lens.backend = "cpu"
        centroids, radii = traced_spots(lens, spots)
        torch.testing.assert_close(found.centroids[row], centroids, rtol=0.0, atol=1e-11)
        torch.testing.assert_close(found.curves.at()[row].sqrt(), radii, rtol=1e-9, atol=0.0)


def test_a_batch_of_aspheres_too(root, moved, traced_spots):
    """Newton's iteration serves all lenses of the batch at once."""
    lens = load_lens(root / "conf/lens/asphere.yaml")
    spots = gaussian_quadrature(lens, [(0.0, 1.0)], [587.5618], 2, 6, symmetry=False)
    names = list(lens.variables(["surfaces.*.curvature", "surfaces.*.a4", "thicknesses.1"]))
    generator = torch.Generator().manual_seed(0)
    scale = torch.tensor([p.item() for p in lens.variables(names).values()]).double()
    errors = 1e-3 * scale * torch.randn((4, len(names)), generator=generator, dtype=torch.float64)
    found = trace_perturbed(lens, spots, names, errors)
    for row, error in enumerate(errors.tolist()):
        radii = traced_spots(moved(lens, dict(zip(names, error, strict=True))), spots)[1]
        torch.testing.assert_close(found.curves.at()[row].sqrt(), radii, rtol=1e-9, atol=0.0)


def test_the_curves_through_focus_are_those_of_a_moved_sensor(
    triplet, spots, settings, moved, traced_spots
):
    tolerances = tolerances_from(triplet, settings)
    errors = tolerances.draw(2, torch.Generator().manual_seed(5))
    curves = trace_perturbed(triplet, spots, tolerances.names, errors).curves
    for shift in (-0.3, 0.1):
        error = {**dict(zip(tolerances.names, errors[1].tolist(), strict=True))}
        radii = traced_spots(moved(triplet, {**error, "sensor_distance": shift}), spots)[1]
        torch.testing.assert_close(curves.at(shift)[1].sqrt(), radii, rtol=1e-9, atol=0.0)


def test_the_best_focus_is_where_the_sum_of_squares_is_least(triplet, spots, settings):
    tolerances = tolerances_from(triplet, settings)
    errors = tolerances.draw(20, torch.Generator().manual_seed(2))
    weights = spot_weights(range(1, spots.count + 1), spots.count)
    curves = trace_perturbed(triplet, spots, tolerances.names, errors).curves
    best = curves.best_focus(weights)
    least = curves.at(best) @ weights
    for step in (-1e-3, 1e-3):
        assert bool((curves.at(best + step) @ weights > least).all())


def test_the_compensator_removes_a_shift_of_the_sensor_exactly(triplet, spots):
    tolerances = tolerances_from(triplet, {"sensor_distance": 0.5})
    errors = tolerances.draw(30, torch.Generator().manual_seed(0))
    weights = spot_weights(None, spots.count)
    curves = trace_perturbed(triplet, spots, tolerances.names, errors).curves
    found = Outcome.of(curves, weights)
    assert float(found.before.amax()) > 4.0 * float(found.after.amax())
    torch.testing.assert_close(found.after, found.after[:1].expand(30, -1), rtol=1e-9, atol=0.0)
    same = errors[:, 0] + found.refocus
    torch.testing.assert_close(same, same[:1].expand(30), rtol=0.0, atol=1e-12)


def test_neither_chunks_nor_threads_change_anything(triplet, spots, settings):
    tolerances = tolerances_from(triplet, settings)
    errors = tolerances.draw(17, torch.Generator().manual_seed(0))
    before, found = torch.get_num_threads(), []
    try:
        for threads, chunk in ((1, None), (1, 3), (2, 3), (2, 1)):
            torch.set_num_threads(threads)
            traced = trace_perturbed(triplet, spots, tolerances.names, errors, chunk)
            found.append(traced.curves.at())
            assert torch.get_num_threads() == threads and not found[-1].requires_grad
    finally:
        torch.set_num_threads(before)
    for other in found[1:]:
        torch.testing.assert_close(found[0], other, rtol=1e-12, atol=0.0)


def test_a_lens_whose_rays_fail_counts_as_failing(triplet, spots, moved):
    """A front element on its edge lets rays miss it; the others are as they were."""
    errors = torch.tensor([[0.0], [math.radians(85.0)], [1e-4]], dtype=torch.float64)
    name = "elements.front.tilt_x"
    found = trace_perturbed(triplet, spots, [name], errors)
    hit = moved(triplet, {name: math.radians(85.0)}).trace(spots.rays)
    lost = float((hit.status >= 2).double().mean())
    assert lost > 0.0
    assert found.failed.tolist() == pytest.approx([0.0, lost, 0.0])
    outcome = Outcome.of(found.curves, spot_weights(None, spots.count))
    for refocused in (True, False):
        radii = outcome.found(refocused)
        for values in (radii.rms, radii.worst):
            assert values.isinf().tolist() == [False, False, True]
            assert share_within(values, 1e9) == pytest.approx(2 / 3)


def test_clipped_light_is_reported_and_still_counts(triplet, spots, moved, traced_spots):
    """The stop is 0.4 mm aside: what its rim takes of these rays, and no ray is lost."""
    name = "elements.middle.decenter_x"
    found = trace_perturbed(triplet, spots, [name], torch.tensor([[0.4]], dtype=torch.float64))
    lens = moved(triplet, {name: 0.4})
    hit = lens.trace(spots.rays)
    share = float((spots.weight * (hit.status == 1)).sum()) / spots.count
    assert 0.0 < share < 0.5
    assert float(found.vignetted) == pytest.approx(share, rel=1e-12)
    radii = traced_spots(lens, spots)[1]
    torch.testing.assert_close(found.curves.at()[0].sqrt(), radii, rtol=1e-9, atol=0.0)


def test_single_precision_is_refused(triplet, spots):
    with pytest.raises(InputError, match="lens_dtype: tolerances need float64"):
        trace_perturbed(triplet.float(), spots, ["thicknesses.1"], torch.zeros(1, 1))


def test_yields_and_quantiles_count_lenses():
    """Four lenses of two spots, the one of three times the weight of the other."""
    squares = torch.tensor([[1.0, 9.0], [4.0, 4.0], [0.0, 16.0], [1.0, 1.0]], dtype=torch.float64)
    weights = spot_weights([3.0, 1.0], 2)
    found = Yield.of(squares, weights)
    assert found.rms.square().tolist() == pytest.approx([1.0, 3.0, 4.0, 4.0])
    assert found.worst.tolist() == pytest.approx([1.0, 2.0, 3.0, 4.0])
    assert share_within(found.worst, 3.0) == 0.75 and share_within(found.worst, 0.9) == 0.0
    assert quantiles(found.worst, [0.25, 0.5, 0.51, 1.0]) == [1.0, 2.0, 3.0, 4.0]
    with pytest.raises(InputError, match="quantiles lie"):
        quantiles(found.worst, [0.0])


@pytest.mark.parametrize("weights", [[1.0], [1.0, -1.0], [0.0, 0.0]])
def test_bad_weights_are_refused(weights):
    with pytest.raises(InputError, match="weights"):
        spot_weights(weights, 2)
