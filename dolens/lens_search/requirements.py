"""What a found lens must keep is said in numbers that real rays can be compared with."""

from dataclasses import dataclass

from dolens.lens_search.specification import Specification


@dataclass(frozen=True)
class Requirements:
    """Says what a lens must keep; None leaves a quantity without a limit.

    Attributes:
        focal_length: mm.
        focal_length_error: the share by which the focal length may be off.
        f_number: of the real marginal ray, 1/(2·sin u').
        f_number_error: the share by which it may be off.
        total_track: mm, at most, from the first vertex to the sensor.
        back_focus: mm, at least, from the last refracting surface to the sensor: from its vertex,
            and from an asphere anywhere within the beam.
        glass_centre: mm, least and largest thickness of glass on the axis.
        glass_edge: mm, the least thickness of glass at its edge.
        air_centre: mm, least and largest air space on the axis.
        air_edge: mm, the least air space out to the edge.
        stop_to_glass: mm, at least, between a stop of its own and the surfaces beside it within the
            beam; below zero its plane lies within glass, and its rim is that of the surface.
        distortion: per cent of f·tan θ, at most, either way.
        chief_ray_angle: degrees to the axis at the sensor, at most.
        slope: degrees, of an asphere within the beam, to the plane across the axis.
        vignetting: the share of a field's light that may be lost, clipped or by rays that fail.
        rms_spot_um: µm, of any field from the axis to the edge.
    """

    focal_length: float | None = None
    focal_length_error: float = 0.01
    f_number: float | None = None
    f_number_error: float = 0.02
    total_track: float | None = None
    back_focus: float | None = None
    glass_centre: tuple[float | None, float | None] = (0.0, None)
    glass_edge: float | None = 0.0
    air_centre: tuple[float | None, float | None] = (0.0, None)
    air_edge: float | None = 0.0
    stop_to_glass: float | None = None
    distortion: float | None = None
    chief_ray_angle: float | None = None
    slope: float | None = None
    vignetting: float | None = 0.0
    rms_spot_um: float | None = None

    @classmethod
    def of(cls, specification: Specification) -> "Requirements":
        """Return what the specification of a search asks of its lenses."""
        limits = specification.limits
        distortion = None if limits.distortion is None else 100.0 * limits.distortion
        return cls(
            focal_length=specification.focal_length,
            f_number=specification.f_number,
            total_track=limits.track,
            back_focus=limits.back_focus,
            glass_centre=limits.glass,
            glass_edge=limits.glass_edge,
            air_centre=limits.air,
            air_edge=limits.air_edge,
            distortion=distortion,
            chief_ray_angle=limits.chief_ray_angle,
            slope=limits.slope,
            vignetting=specification.vignetting,
        )
