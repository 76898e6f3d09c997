"""An imaging system: a lens together with the object planes, the exit pupil and the pixels."""

from dataclasses import dataclass, replace

from dolens.optics.system import OpticalSystem
from dolens.rendering.exit_pupil import ExitPupil, sampled_exit_pupil
from dolens.scene.scene import Scene
from dolens.sensor.pixels import Sensor


@dataclass(frozen=True)
class ImagingSystem:
    """A lens that images the planes of a scene onto the pixels of a sensor.

    Attributes:
        system: the lens; differentiable in its tensors.
        scene: D planes and C wavelengths.
        sensor: the pixels.
        pupil: the disc of the exit pupil that rays from the pixels are aimed at: numbers, or
            tensors whose gradients follow the lens (`differentiable_exit_pupil`).
    """

    system: OpticalSystem
    scene: Scene
    sensor: Sensor
    pupil: ExitPupil

    @classmethod
    def of(cls, system: OpticalSystem, scene: Scene, sensor: Sensor) -> "ImagingSystem":
        """Find the exit pupil that the light of all pixels passes.

        Raises:
            InputError: no ray from the sensor's centre gets through.
        """
        return cls(system, scene, sensor, sampled_exit_pupil(system, scene.wavelengths, sensor))

    def showing(self, scene: Scene) -> "ImagingSystem":
        """The same lens, pupil and pixels with other planes or wavelengths."""
        return replace(self, scene=scene)

    def on(self, sensor: Sensor) -> "ImagingSystem":
        """The same lens, pupil and scene with other pixels: a window of the sensor."""
        return replace(self, sensor=sensor)
