"""Scenes with a depth at every texel: a stack of planes that hide one another, in one image.

Maps carry opacity α and light α·L, colours times opacity, so that interpolation and blur mix no
colour of a texel that is not there.
"""

from collections.abc import Iterable, Sequence
from dataclasses import dataclass
from typing import Any, ClassVar, Literal

import torch
from torch import Tensor
from torch.nn import functional

from dolens.errors import InputError
from dolens.scene.scene import Blur, Scene, bilinear


@dataclass(frozen=True)
class LayeredScene(Scene):
    """A surface of any depth, texel by texel, on a stack of partly transparent planes.

    Textures are (B, C + 1, H, W): linear light, a channel for each wavelength, and last the depth,
    mm in front of the first vertex.  The depth is a channel so that it is cropped, mirrored and
    moved between devices with the colours that it belongs to.

    The model: each surface point is shared by the two planes about it, linearly in vergence
    (`layer_opacities`).  A backward ray meets the planes from near to far; each stops min(α_l, what
    the nearer ones have left), and the ray carries home the sum of what it was stopped by, which
    for opaque planes is Σ_l α_l L_l Π_{k<l} (1 - α_k).  What lies behind an occluder's edge a
    pinhole never saw: planes go on there for `inpainting_radius` texels (`inpaint_hidden`), and
    rays that meet nothing even so count like the mean of those of the same pixel that do: the sum
    over the pupil is divided by its opacity.  So a white scene is white, whatever its depths.

    `RayRenderer` renders this model.  `PsfRenderer` composes blurred planes (`composite`) as if
    rays met distinct surfaces independently: exact where all but one at an edge are sharp.  Ikoma
    et al. (ICCP 2021, "Depth from defocus with learned optics") divide a plane's blur by that of
    all texels at or behind the plane instead of continuing planes.  Then nothing is known of a
    sharp background behind an occluder, whose blurred edge becomes half sharp.

    How many planes: so many that blur's radius changes by 1 to 3 pixels from one to the next; PSFs
    get worse again below 1.  RMS errors in grey levels (1/255) of a Cooke triplet, texture of 0.15
    RMS, blur's radius from 0 to 8.4 pixels over 56:

        change of radius    8.4  4.2  2.8  1.7  0.8  0.4
        rays                7.2  2.9  1.7  0.7  0.5  < 0.3
        PSFs                7.5  2.9  1.8  1.1  1.2  2.7

    On a slope where the radius changes by ε from texel to texel, what a pixel sees is displaced by
    up to 2 ε pixels, about as much as the slope's own parallax: the planes that share it hide one
    another a little.

    PSFs against rays at a straight edge of contrast 0.5, RMS over 48×48 pixels: 0.1 with the near
    or the far side in focus (2 at most), 0.5 with the focus halfway (5 at most), on two planes as
    on nine.

    Attributes:
        depths: of the planes, mm in front of the first vertex, near to far.
        inpainting_radius: texels by which a plane goes on behind what hides it; the widest blur's
            radius is enough.
    """

    inpainting_radius: int = 15

    separate_planes: ClassVar[bool] = False

    def __post_init__(self) -> None:
        super().__post_init__()
        if any(far <= near for near, far in zip(self.depths, self.depths[1:], strict=False)):
            raise InputError(
                f"scene: layers' depths must grow, near to far, not {list(self.depths)}"
            )
        if self.inpainting_radius < 0:
            raise InputError(
                f"scene.inpainting_radius must be 0 texels or more, not {self.inpainting_radius}"
            )

    @classmethod
    def evenly_spaced(
        cls,
        nearest: float,
        farthest: float,
        layers: int,
        wavelengths: Sequence[float],
        texture_centre: tuple[float, float] = (0.0, 0.0),
        inpainting_radius: int = 15,
        texture_scale: Literal["magnification", "fixed"] = "magnification",
    ) -> "LayeredScene":
        """Planes evenly spaced in vergence, 1/depth: blur grows evenly from one to the next.

        Vergence is counted from the first vertex: planes stay where they are while the lens's pupil
        moves in a design.

        Args:
            nearest: mm in front of the first vertex.
            farthest: mm.
            layers: how many planes, both ends' included; 1 is the middle in vergence.
            wavelengths: nm.
            texture_centre: of `Scene`.
            inpainting_radius: of `LayeredScene`.
            texture_scale: of `Scene`.
        """
        if not 0.0 < nearest < farthest < float("inf"):
            raise InputError(
                "scene: nearest and farthest must be mm, positive, finite and in this order, "
                f"not {nearest:g}, {farthest:g}"
            )
        if layers < 1:
            raise InputError(f"scene: layers must be at least 1, not {layers}")
        shares = [i / (layers - 1) for i in range(layers)] if layers > 1 else [0.5]
        depths = tuple(1.0 / ((1.0 - share) / nearest + share / farthest) for share in shares)
        return cls(
            depths,
            tuple(wavelengths),
            texture_centre,
            inpainting_radius,
            texture_scale=texture_scale,
        )

    def labels(self) -> list[str]:
        """The one image's: `0.5-8m`."""
        near, far = self.depths[0] / 1000.0, self.depths[-1] / 1000.0
        return [f"{near:g}-{far:g}m" if near < far else f"{near:g}m"]

    def colours(self, textures: Tensor) -> Tensor:
        """All channels but the depth."""
        return textures[..., :-1, :, :]

    def on_planes(self, textures: Tensor) -> tuple[Tensor, ...]:
        """Light and opacity of the planes, (B, L, C, H, W) and (B, L, 1, H, W).

        Differentiable in the colours; in the depth only as far as shares between planes go, not
        where one surface comes to hide another.

        Raises:
            InputError: the textures' channels are not colours and a depth, or a depth is not
                positive.
        """
        if textures.dim() != 4 or textures.shape[1] != len(self.wavelengths) + 1:
            raise InputError(
                f"textures must be (B, {len(self.wavelengths) + 1}, H, W), one channel a "
                f"wavelength and the depth in mm, not {tuple(textures.shape)}"
            )
        depth = textures[:, -1]
        if not bool((depth > 0.0).all()):
            raise InputError(
                f"textures: the last channel is the depth in mm and must be positive; its least is "
                f"{float(depth.min()):g}"
            )
        opacity, hidden = layer_opacities(depth, self.depths)
        light = opacity[:, :, None] * self.colours(textures)[:, None]
        maps = torch.cat((opacity[:, :, None], light), dim=2)
        maps = inpaint_hidden(maps, hidden, self.inpainting_radius)
        return maps[:, :, 1:], maps[:, :, :1]

    def gather(
        self,
        shown: tuple[Tensor, ...],
        channel: int,
        places: Iterable[tuple[Tensor, Tensor]],
        weight: Tensor,
    ) -> Tensor:
        """Return the light that rays collect through the stack, (B, 1, P); see `Scene.gather`."""
        light, opacity = shown
        seen: Any = 0.0
        covered: Any = 0.0
        through = torch.ones_like(weight)
        for plane, (rows, columns) in enumerate(places):
            maps = torch.cat((light[:, plane, channel], opacity[:, plane, 0]))
            glow, alpha = bilinear(maps, rows, columns).chunk(2)
            share = stopped_share(alpha, through)
            stopped = share * alpha
            seen = seen + (weight * share * glow).sum(dim=-1)
            covered = covered + (weight * stopped).sum(dim=-1)
            through = (through - stopped).clamp(min=0.0)
        return normalise_by_visibility(seen, covered, weight.sum(dim=-1))[:, None]

    def blend(self, shown: tuple[Tensor, ...], blur: Blur) -> Tensor:
        """Blurred planes in front of one another, (B, 1, C, height, width); see `Scene.blend`."""
        light, opacity = shown
        white = blur.white()
        lit = white > 0.0
        share = torch.where(lit, blur(opacity) / torch.where(lit, white, 1.0), 0.0)
        return normalise_by_visibility(*composite(blur(light), share))[:, None]


# A surface is on a plane if the next one's share is less than this, which rounding may leave.
_ON_A_PLANE = 1e-4
# Of what a pixel could have seen, the least share that tells anything about it.
_SEEN = 1e-3


def layer_opacities(depth: Tensor, depths: Sequence[float]) -> tuple[Tensor, Tensor]:
    """Opacities of planes that stand for a surface, and where the surface hides them.

    A surface at vergence V = 1/depth between planes of vergences V_l > V_{l+1} is shared by them,
    α_l = (V - V_{l+1})/(V_l - V_{l+1}) and α_{l+1} = 1 - α_l.  A blur's size is linear in vergence,
    so the error falls with the square of the planes' distance; that of the whole surface on the
    nearest plane falls with the distance itself.  A surface in front of the nearest plane or behind
    the farthest is on it.

    Args:
        depth: (..., H, W), mm, of the surface at each texel.
        depths: of L planes, mm, near to far.

    Returns:
        Opacities (..., L, H, W), which sum to one, and where the surface is in front of what the
        plane has a share in, (..., L, H, W), bool.
    """
    options: dict[str, Any] = {"dtype": torch.float64, "device": depth.device}
    planes = 1.0 / torch.tensor(depths, **options)
    surface = (1.0 / depth.double()).clamp(float(planes[-1]), float(planes[0]))[..., None, :, :]
    near, far = planes[:-1, None, None], planes[1:, None, None]
    # Of each gap, how much lies behind the surface.
    behind = ((surface - far) / (near - far)).clamp(0.0, 1.0)
    behind = torch.where(behind < _ON_A_PLANE, 0.0, behind)
    behind = torch.where(behind > 1.0 - _ON_A_PLANE, 1.0, behind)
    one = torch.ones_like(surface)
    opacity = torch.cat((behind, one), dim=-3) - torch.cat((torch.zeros_like(one), behind), dim=-3)
    hidden = torch.cat((torch.zeros_like(one), behind), dim=-3) >= 1.0
    return opacity.to(depth.dtype), hidden


def inpaint_hidden(maps: Tensor, hidden: Tensor, inpainting_radius: int) -> Tensor:
    """Continue planes behind what hides them, since a pinhole's image says nothing about it.

    A hidden texel takes the mean of its neighbours on the same plane, and these may have been
    continued themselves, at 1, 2, 4, ... texels' distance: as many steps as the reach has bits.

    Args:
        maps: (..., C, H, W): opacity first, and light, which goes with it.
        hidden: (..., H, W), bool, where the plane is hidden.
        inpainting_radius: texels, in rows and columns, as far as which a plane goes on.

    Returns:
        (..., C, H, W); differentiable in the maps.
    """
    step, done = 1, 0
    while done < inpainting_radius:
        step = min(step, inpainting_radius - done)
        there = maps[..., :1, :, :] > 0.0
        count = _sum_of_neighbours(there.to(maps.dtype), step)
        mean = _sum_of_neighbours(maps, step) / count.clamp(min=1.0)
        fill = hidden[..., None, :, :] & ~there & (count > 0.5)
        maps = torch.where(fill, mean, maps)
        done, step = done + step, 2 * step
    return maps


def _sum_of_neighbours(maps: Tensor, step: int) -> Tensor:
    """Sum of 3×3 texels `step` apart, none beyond the edges."""
    height, width = maps.shape[-2:]
    padded = functional.pad(maps, (0, 0, step, step))
    first, second, third = (padded[..., i * step : i * step + height, :] for i in range(3))
    padded = functional.pad(first + second + third, (step, step))
    first, second, third = (padded[..., j * step : j * step + width] for j in range(3))
    return first + second + third


def stopped_share(opacity: Tensor, through: Tensor) -> Tensor:
    """min(α, t)/α: the share of a plane's opacity that meets light still on its way.

    What comes through one plane meets the next where the first is not, so that opacities add up
    to a surface, α + (1 - α): multiplied transmissions would let α (1 - α) through it.

    Args:
        opacity: α of what a ray meets.
        through: t, the share of the ray that no plane before has stopped, 0 or more.
    """
    less = opacity > through
    return torch.where(less, through / torch.where(less, opacity, 1.0), 1.0)


def composite(light: Tensor, opacity: Tensor) -> tuple[Tensor, Tensor]:
    """Light and opacity of a stack of blurred planes, from near to far.

    Plane l stops the share P_l = a_l/(1 - s_{l-1}), at most 1, of the light that has come through
    the nearer ones, T_{l+1} = (1 - P_l) T_l, and Σ_l T_l P_l x_l/a_l is seen.  Here s_l is the sum
    over the run of planes up to l that belong to one surface: they stop different rays, and T falls
    by their sum.  Without s, T would be Π (1 - a_k), which holds for surfaces that rays meet
    independently; of a surface that two planes share it would let a (1 - a) through.  A plane that
    covers less than the one before ends the run by as much, s_l = a_l + min(1, a_l/a_{l-1})
    s_{l-1}, and what comes then is independent of it.

    Args:
        light: (B, L, ...), x_l: the planes' light, near to far, already times opacity.
        opacity: (B, L, ...), a_l, broadcast with light.

    Returns:
        Both (B, ...); the opacity is Σ_l T_l P_l.
    """
    opacity = opacity.clamp(min=0.0)
    seen, covered = torch.zeros_like(light[:, 0]), torch.zeros_like(opacity[:, 0])
    through, run, before = torch.ones_like(covered), torch.zeros_like(covered), covered
    for plane in range(light.shape[1]):
        own = opacity[:, plane]
        share = through / torch.maximum((1.0 - run).clamp(min=_SEEN), own)
        seen = seen + share * light[:, plane]
        covered = covered + share * own
        through = through - share * own
        goes_on = torch.minimum(own, before) / torch.where(before > 0.0, before, 1.0)
        run, before = own + goes_on * run, own
    return seen, covered


def normalise_by_visibility(light: Tensor, opacity: Tensor, whole: Tensor | float = 1.0) -> Tensor:
    """Light · whole / opacity: what is not known looks like the rest of what the pixel sees.

    Black where the opacity is less than a thousandth of the whole.
    """
    known = opacity > _SEEN * whole
    return torch.where(known, light * whole / torch.where(known, opacity, 1.0), 0.0)
