"""The table of all names of the configuration that have changed; `renaming` reads it."""

from collections.abc import Mapping, Sequence
from dataclasses import dataclass, field


@dataclass(frozen=True)
class Key:
    """A key that has another name now, or is gone.

    Attributes:
        old: its dotted path, of a value or of a mapping with all that is in it; one `*` stands for
            anything, as in `variables.*.most`.
        new: its path now, with the same `*`; None: it is gone.
        values: old value → value now, where these have changed too.
        instead: what to do where the key is gone; a clause.
    """

    old: str
    new: str | None
    values: Mapping[str, str] = field(default_factory=dict)
    instead: str = ""


@dataclass(frozen=True)
class Renamed:
    """All names that have changed.

    Attributes:
        keys: keys with another name, or none.
        values: key → old value → value now, of keys that keep their name.
        options: group → old option → option now, of Hydra's groups (`conf/<group>/<option>.yaml`).
        targets: old `_target_` → `_target_` now.
    """

    keys: Sequence[Key] = ()
    values: Mapping[str, Mapping[str, str]] = field(default_factory=dict)
    options: Mapping[str, Mapping[str, str]] = field(default_factory=dict)
    targets: Mapping[str, str] = field(default_factory=dict)


_SPECTRA = {"apart": "monochromatic", "together": "polychromatic"}

RENAMED = Renamed(
    keys=(
        Key("merit.colours", "merit.reference_spectrum", values=_SPECTRA),
        Key("evaluation.colours", "evaluation.reference_spectrum", values=_SPECTRA),
        Key("merit.most_vignetted", "merit.max_vignetting"),
        Key("evaluation.most_vignetted", "evaluation.max_vignetting"),
        Key("optimizer.least_squares.reach", "optimizer.least_squares.trust_radius"),
        Key("optimizer.least_squares.most", "optimizer.least_squares.max_trust_radius"),
        Key("optimizer.most", "optimizer.max_variables"),
        Key("optimizer.network.lr", None, instead="learning_rates.network is the rate"),
        Key("callbacks.pictures.most_frequency", "module.mtf_max_frequency"),
        Key("scene.reach", "scene.inpainting_radius"),
        Key("scene.follows", "scene.texture_scale", {"world": "fixed"}),
        Key("judges", "reference_renderers"),
        Key("calibrations", "miscalibrations"),
        Key("module.rings", "module.spots.pupil.rings"),
        Key("module.arms", "module.spots.pupil.arms"),
        Key("module.simulation_rings", "module.simulation_pupil.rings"),
        Key("module.simulation_arms", "module.simulation_pupil.arms"),
    ),
    options={
        "experiment": {
            "large_fov_doublet_initial": "large_fov_doublet_refocused",
            "pose_knowledge": "pose_bounds",
        },
        # One callback saves the figures of every experiment.
        "callbacks": dict.fromkeys(
            ("alignment", "pose_accuracy", "pose_knowledge", "speed", "tolerances"), "figures"
        ),
    },
    values={"semi_diameters": {"follow": "automatic"}},
    targets={
        **dict.fromkeys(
            (
                "experiments.callbacks.alignment_pictures.AlignmentPictures",
                "experiments.callbacks.design_pictures.DesignPictures",
                "experiments.callbacks.misalignment_pictures.MisalignmentPictures",
                "experiments.callbacks.pictures.CameraPictures",
                "experiments.callbacks.pose_accuracy_pictures.PoseAccuracyPictures",
                "experiments.callbacks.pose_coverage_pictures.PoseCoveragePictures",
                "experiments.callbacks.pose_knowledge_pictures.PoseKnowledgePictures",
                "experiments.callbacks.speed_pictures.SpeedPictures",
                "experiments.callbacks.tolerance_pictures.TolerancePictures",
            ),
            "dolens.experiments.callbacks.saved_figures.SaveFigures",
        ),
        "dolens.imaging.choice.auto_renderer.AutoRenderer": (
            "dolens.rendering.auto.auto_renderer.AutoRenderer"
        ),
        "dolens.imaging.layers.LayeredScene.evenly_spaced": (
            "dolens.scene.layered.LayeredScene.evenly_spaced"
        ),
        "dolens.imaging.psf_renderer.PsfRenderer": "dolens.rendering.psf_renderer.PsfRenderer",
        "dolens.imaging.ray_renderer.RayRenderer": "dolens.rendering.ray_renderer.RayRenderer",
        "dolens.imaging.readout.Readout": "dolens.sensor.readout.Readout",
        "dolens.imaging.readout.Readout.at_light": "dolens.sensor.readout.Readout.at_light",
        "dolens.imaging.scene.PlanarScene": "dolens.scene.planar.PlanarScene",
        "dolens.imaging.sensor.Sensor": "dolens.sensor.pixels.Sensor",
        "experiments.calibration.NoisyMeasurement": (
            "dolens.experiments.camera.calibration.NoisyMeasurement"
        ),
        "experiments.calibration.OtherDepth": "dolens.experiments.camera.calibration.OtherDepth",
        "experiments.calibration.OtherSample": "dolens.experiments.camera.calibration.OtherSample",
        "experiments.camera.CameraModule": "dolens.experiments.camera.camera.CameraModule",
        "experiments.design.DesignModule": "dolens.experiments.design.design.DesignModule",
        "experiments.lens_least_squares.CameraOptimizer": (
            "dolens.experiments.camera.lens_optimizer.CameraOptimizer"
        ),
        "experiments.misalignment.MisalignmentModule": (
            "dolens.experiments.poses.misalignment.MisalignmentModule"
        ),
        "experiments.pose_accuracy.PoseAccuracyModule": (
            "dolens.experiments.poses.accuracy.PoseAccuracyModule"
        ),
        "experiments.pose_coverage.PoseCoverageModule": (
            "dolens.experiments.poses.coverage.PoseCoverageModule"
        ),
        "experiments.pose_knowledge.PoseKnowledgeModule": (
            "dolens.experiments.poses.bounds.PoseBoundsModule"
        ),
        "experiments.speed_vs_error.SpeedVsErrorModule": (
            "dolens.experiments.speed.speed_vs_error.SpeedVsErrorModule"
        ),
        "experiments.tolerances.TolerancesModule": (
            "dolens.experiments.tolerances.tolerances.TolerancesModule"
        ),
        "experiments.triplet_alignment.TripletAlignmentModule": (
            "dolens.experiments.poses.triplet_alignment.TripletAlignmentModule"
        ),
        "experiments.views.depths.DepthViews": "dolens.experiments.camera.views.depths.DepthViews",
        "experiments.views.fields.FieldViews": "dolens.experiments.camera.views.fields.FieldViews",
        "experiments.views.layers.LayerViews": "dolens.experiments.camera.views.depths.LayerViews",
    },
)
