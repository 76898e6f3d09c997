"""Ten co-designs: five lenses with an extended depth of field, five with a wide field; and ways to
move their lenses.
"""

from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass

from scripts.co_design.generalized_aberrations import GeneralizedAberrations
from scripts.co_design.training import CallbacksOf

_SMALL = ("network.width=8", "network.depth=2", "loss.perceptual=none")
_LIMITS = (
    "{kind: edge_thickness, min: 0.0, weight: 1.0}, {kind: centre_thickness, min: 0.1, weight: 1.0}"
)
_SHAPES = "surfaces.*.curvature: {scale: 1.0e-5}, thicknesses.*: {scale: 0.01}"

# Three depths in front of a small sensor, behind the network that knows the functions.
_DEPTHS = (
    "experiment=wavefront_coding",
    "renderer=psf_narrow",
    "renderer.sensor.height=64",
    "renderer.sensor.width=64",
    "renderer.pupil_samples=16",
    "psf_size=33",
    "evaluation_renderer=psf",
    "evaluation_renderer.fields=[1,1]",
    "++evaluation_renderer.registration=centred",
    "reference_renderers=none",
    "miscalibrations=none",
    "data.batch_size=4",
    "network=feature_wiener",
    *_SMALL,
)
# Windows of a large sensor, behind a network that knows where they lie.
_FIELDS = (
    "network=field_unet",
    "loss.perceptual=none",
    "data.batch_size=8",
)
_FORM = ("~data.train", "~data.validation", *_FIELDS)


@dataclass(frozen=True)
class Case:
    """A co-design.

    Attributes:
        overrides: of `train.py`.
        rate: learning rate of the lens's variables that tuning multiplies.
        strengths: of the linear filter, that tuning tries; see `DeconvolvedError`.
    """

    overrides: tuple[str, ...]
    rate: float
    strengths: tuple[float, ...]


def _all_shapes(
    lens: str, depths: str, focus: float, focal_length: float, colours: str = ""
) -> Case:
    """Return a lens whose curvatures, gaps and focus are learned for three depths.

    Args:
        lens: in conf/lens.
        depths: mm, so far apart that the outer ones blur by some four pixels.
        focus: sensor's distance where the middle one is sharp, mm.
        focal_length: mm, which is held.
        colours: wavelengths, if not the scene's.
    """
    waves = (f"scene.wavelengths={colours}",) if colours else ()
    return Case(
        (
            "experiment=wavefront_coding_refocused",
            *_DEPTHS[1:],
            f"lens={lens}",
            f"scene.depths={depths}",
            *waves,
            "renderer.sensor.pixel_pitch=0.01",
            "readout.reference_f_number=null",
            f"++variables={{sensor_distance: {{scale: 0.01, initial: {focus}, lower: null, "
            f"upper: null}}, {_SHAPES}}}",
            f"operands=[{{kind: efl, target: {focal_length}, weight: 0.1}}, {_LIMITS}]",
        ),
        0.3,
        (1.0, 0.7),
    )


CASES: Mapping[str, Case] = {
    "phase plate, depths": Case(_DEPTHS, 0.01, (1.0, 0.7)),
    "phase plate and doublet, depths": Case(
        (
            *_DEPTHS,
            "++variables={surfaces.1.curvature: {scale: 1.0e-4}, "
            "surfaces.2.curvature: {scale: 1.0e-4}, surfaces.3.curvature: {scale: 1.0e-4}}",
            "operands=[{kind: efl, target: 99.3, weight: 0.1}]",
        ),
        0.01,
        (1.0, 0.7),
    ),
    "Cooke triplet, depths": _all_shapes("cooke_triplet", "[2400.0,2000.0,1720.0]", 43.495, 50.0),
    "double Gauss, depths": _all_shapes("double_gauss", "[5208.0,5000.0,4808.0]", 74.26, 100.7),
    "quartet of the search, depths": _all_shapes(
        "quartet", "[5320.0,5000.0,4717.0]", 32.019, 100.0, "[587.5618,587.5618,587.5618]"
    ),
    "doublet of Table III, field": Case(
        (
            "experiment=large_fov_doublet",
            "~variables.sensor_distance",
            "renderer.fields=[1,1]",
            "renderer.sensor={height: 64, width: 64}",
            "evaluation_renderer.fields=[1,1]",
            "psf_size=33",
            *_FIELDS,
        ),
        0.06,
        (0.0, 0.3),
    ),
    "Cooke triplet, field": Case(("experiment=form_camera", *_FORM), 0.3, (0.0, 0.3)),
    "double Gauss, field": Case(
        (
            "experiment=form_camera",
            "lens=double_gauss",
            "views.sensor={height: 2857, width: 2857, pixel_pitch: 0.02}",
            f"operands=[{{kind: efl, target: 100.7, weight: 0.1}}, {_LIMITS}]",
            *_FORM,
        ),
        0.3,
        (0.0, 0.3),
    ),
    "quartet of the search, field": Case(("experiment=quartet_camera", *_FORM), 0.3, (0.0, 0.3)),
    "Cooke triplet in dim light, field": Case(
        ("experiment=form_camera", "light=100.0", *_FORM), 0.3, (0.0, 0.3)
    ),
}


def least_squares(strength: float, until: float) -> Sequence[str]:
    """Return overrides by which least squares move the lens."""
    return (
        "optimizer.lens=dls",
        "optimizer.least_squares.first_iterations=40",
        f"optimizer.least_squares.strength={strength}",
        f"optimizer.until={until}",
    )


def adam(rate: float, until: float = 1.0) -> Sequence[str]:
    """Return overrides by which Adam moves the lens."""
    return ("optimizer.lens=adam", f"learning_rates.optics={rate}", f"optimizer.until={until}")


def candidates(case: Case) -> dict[str, list[Sequence[str]]]:
    """Return what tuning tries, four settings of each optimizer."""
    rates = (1.0, 3.0, 10.0)
    return {
        "adam": [*(adam(case.rate * r) for r in rates), adam(3.0 * case.rate, 0.5)],
        "least squares": [least_squares(s, u) for s in case.strengths for u in (0.0, 0.5)],
    }


@dataclass(frozen=True)
class Method:
    """A way to move the lens, of one setting.

    Attributes:
        overrides: of `train.py`, for a case.
        callbacks: makes what moves the lens in dolens's place.
    """

    overrides: Callable[[Case], Sequence[str]]
    callbacks: CallbacksOf = list


THEIRS = "generalized aberrations"
# Of five settings of theirs this one had the best mean on validation photographs, over the Cooke
# triplet's field and the double Gauss's depths, with a seed of its own.
METHODS: Mapping[str, Method] = {
    THEIRS: Method(
        lambda case: (
            "optimizer.lens=dls",
            "optimizer.least_squares.first_iterations=0",
            "optimizer.least_squares.every=1000000000",
            "optimizer.until=0.5",
        ),
        lambda: [GeneralizedAberrations(damping=1.0, tolerance=1.25, memory=0.9)],
    ),
    "least squares": Method(lambda case: least_squares(case.strengths[0], 0.0)),
    "adam": Method(lambda case: adam(3.0 * case.rate)),
    "least squares, then the gradient": Method(lambda case: least_squares(case.strengths[0], 0.5)),
}
