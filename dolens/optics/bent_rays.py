"""Rays bend in the gap between two surfaces that a gradient fills; see `dolens.optics.gradients`.

A ray is carried to where it meets the next surface, whose place is found first without derivatives.
From there it goes on along its tangent by what is left, a rounding error, whose derivatives are
those of the point of intersection.
"""

from collections.abc import Callable
from dataclasses import dataclass, replace
from importlib import import_module
from typing import Any

import torch
from torch import Tensor
from torch.autograd.function import once_differentiable

from dolens.kernels.operators import is_eager
from dolens.optics.autograd import is_transformed
from dolens.optics.bent_motion import Motion, carry
from dolens.optics.elements import (
    Axes,
    from_lens_axes,
    points_from_lens_axes,
    points_to_lens_axes,
    to_lens_axes,
)
from dolens.optics.gradients import KERNEL_TERMS, Bend, Number, Profile
from dolens.optics.rays import Components

# Newton's steps towards the next surface, and the share of a path's steps that all but the first
# take: what is left is short.
_APPROACHES, _SHARE = 6, 8
# Of n², beyond which there is no medium.
_LEAST, _LARGEST = 1e-6, 1e4


# Of more wavelengths PyTorch's operations carry rays through a profile that changes with them.
_COLOURS = 16
# Of fewer rays PyTorch's operations are at their end before a kernel is compiled.
_FEW = 1024


@dataclass(frozen=True)
class Form:
    """A profile without its numbers.

    Attributes:
        terms: as in `Profile`.
        squared: likewise.
    """

    terms: tuple[str, ...]
    squared: bool

    def profile(self, coefficients: Tensor) -> Profile:
        """Return the profile with these coefficients of `KERNEL_TERMS`, (14,)."""
        values = tuple(coefficients[KERNEL_TERMS.index(term)] for term in self.terms)
        return Profile(self.terms, values, self.squared)


class _Carry(torch.autograd.Function):
    """Rays are carried through a gradient by the CPU's kernel; first derivatives only.

    Coefficients (14,) are those of `KERNEL_TERMS`; `form` has the names of the profile's own, and
    whether the terms add to n².
    """

    @staticmethod
    def forward(
        motion: Tensor, t: Tensor, base: Tensor, coefficients: Tensor, form: Form, steps: int
    ) -> Tensor:
        """Carry (7, N)."""
        given = (coefficients, form.squared, steps)
        end: Tensor = _kernels().carry(motion.clone(), t, base, *given)
        return end

    @staticmethod
    def setup_context(ctx: Any, inputs: tuple[Any, ...], output: Tensor) -> None:
        """Keep both ends."""
        motion, t, base, coefficients, ctx.form, ctx.steps = inputs
        ctx.save_for_backward(motion, output, t, base, coefficients)
        ctx.save_for_forward(motion, output, t, base, coefficients)

    @staticmethod
    @once_differentiable
    def backward(ctx: Any, cotangent: Tensor) -> tuple[Tensor | None, ...]:
        """Take cotangents back to the beginning."""
        motion, end, t, base, coefficients = ctx.saved_tensors
        if not is_eager([cotangent, motion, t, base, coefficients]):
            return _by_operations(motion, t, base, coefficients, ctx.form, ctx.steps, cotangent)
        of_motion, of_base, of_coefficients = _kernels().carry_adjoint(
            *(end, cotangent.contiguous().clone(), t, base),
            *(coefficients, ctx.form.squared, ctx.steps, ctx.needs_input_grad[3]),
        )
        of_base = of_base if base.numel() > 1 else of_base.sum(0, True)
        return of_motion, None, of_base, of_coefficients, None, None

    @staticmethod
    def jvp(
        ctx: Any, tangent: Tensor, _: Any, of_base: Tensor | None, of_own: Tensor | None, *__: Any
    ) -> Any:
        """Carry tangents along; t has none."""
        motion, _, t, base, coefficients = ctx.saved_tensors
        of_base = torch.zeros_like(base) if of_base is None else of_base
        of_own = torch.zeros_like(coefficients) if of_own is None else of_own
        given = (motion, t, base, tangent, of_base, coefficients, of_own)
        return _CarryTangent.apply(*given, ctx.form, ctx.steps)

    @staticmethod
    def vmap(info: Any, in_dims: tuple[Any, ...], *args: Any) -> tuple[Tensor, int]:
        """Carry the rays of many lenses as those of one, or lens by lens where profiles differ."""
        return _batched(_Carry.apply, info.batch_size, in_dims, args, 3)


class _CarryTangent(torch.autograd.Function):
    """Tangents are carried along with rays by the CPU's kernel."""

    @staticmethod
    def forward(
        motion: Tensor,
        t: Tensor,
        base: Tensor,
        tangent: Tensor,
        of_base: Tensor,
        coefficients: Tensor,
        of_coefficients: Tensor,
        form: Form,
        steps: int,
    ) -> Tensor:
        """Carry (7, N)."""
        tangents = tangent.contiguous().clone(), t, base, of_base.contiguous()
        given = (coefficients, of_coefficients, form.squared, steps)
        found: Tensor = _kernels().carry_tangent(motion, *tangents, *given)
        return found

    @staticmethod
    def setup_context(ctx: Any, inputs: tuple[Any, ...], output: Tensor) -> None:
        """Keep nothing."""

    @staticmethod
    def vmap(info: Any, in_dims: tuple[Any, ...], *args: Any) -> tuple[Tensor, int]:
        """Carry many tangents as those of as many rays, or one by one where profiles differ."""
        return _batched(_CarryTangent.apply, info.batch_size, in_dims, args, 5)


def _by_operations(
    motion: Tensor,
    t: Tensor,
    base: Tensor,
    coefficients: Tensor,
    form: Form,
    steps: int,
    cotangent: Tensor,
) -> tuple[Tensor | None, ...]:
    """Return the cotangents of `_Carry` through PyTorch's operations, which all can follow."""
    with torch.enable_grad():
        given = motion, base, coefficients
        motion, base, coefficients = (part.detach().requires_grad_() for part in given)
        profile = form.profile(coefficients)
        begin = Motion(*motion.unbind())
        end = torch.stack(carry(lambda *point: profile.bend(base, *point), begin, t, steps))
        found = torch.autograd.grad(end, (motion, base, coefficients), cotangent)
    of_motion, of_base, of_coefficients = found
    return of_motion, None, of_base, of_coefficients, None, None


def _batched(
    apply: Callable[..., Tensor],
    size: int,
    dims: tuple[Any, ...],
    args: tuple[Any, ...],
    of_rays: int,
) -> tuple[Tensor, int]:
    """Carry a batch of B lenses or tangents.

    Args:
        apply: carries those of one.
        size: B.
        dims: of the batch in each argument, or None.
        args: `of_rays` tensors with a last dimension of rays, then those of profiles, then others.
        of_rays: how many.
    """
    if all(dim is None for dim in dims[of_rays:]):
        folded = _folded(size, dims[:of_rays], args[:of_rays])
        end = apply(*folded, *args[of_rays:])
        return end.reshape(len(end), size, -1), 1
    own = [
        [arg] * size if dim is None else arg.movedim(dim, 0).unbind()
        for arg, dim in zip(args, dims, strict=True)
    ]
    return torch.stack([apply(*each) for each in zip(*own, strict=True)]), 0


def _folded(size: int, dims: tuple[Any, ...], tensors: tuple[Tensor, ...]) -> list[Tensor]:
    """Return (7, B·N) and (B·N,) of tensors with or without a dimension of a batch of B."""
    batches = [
        tensor.expand(size, *tensor.shape) if dim is None else tensor.movedim(dim, 0)
        for tensor, dim in zip(tensors, dims, strict=True)
    ]
    rays = batches[1].shape[-1]
    return [
        # An expanded tensor stays one where its shape allows it, and a kernel reads memory.
        part.movedim(0, 1).reshape(part.shape[1], -1).contiguous()
        if part.ndim == 3
        else part.expand(size, rays).reshape(-1).contiguous()
        for part in batches
    ]


def _kernels() -> Any:
    return import_module("dolens.kernels.cpu.bent")


@dataclass(frozen=True)
class Space:
    """The gap behind a surface is filled with a gradient.

    Attributes:
        profile: of the index.
        base: index of the homogeneous medium, with what is added to it.
        axes: of the surface in front, from which the profile counts.
        steps: that a ray takes through it.
        reach: of its profile, mm: a ray that is farther away is lost.
        kernels: whether the CPU's kernels may carry rays.
        colours: nm, wavelengths of the rays, where there are several.
    """

    profile: Profile
    base: Number
    axes: Axes
    steps: int
    reach: float
    kernels: bool = False
    colours: Tensor | None = None

    def bend(self, x: Number, y: Number, z: Number) -> Bend:
        """Return n² and its half gradient at points along `axes`, mm."""
        return self.profile.bend(self.base, x, y, z)

    def index(self, point: tuple[Tensor, Tensor, Tensor], axes: Axes) -> Tensor:
        """Return the index at points in the axes of a surface, mm."""
        still = torch.zeros_like(point[0])
        return self._index(
            *_seen_from(Components(*point, still, still, still), axes, self.axes)[:3]
        )

    def cross(
        self,
        ray: Components,
        now: Axes,
        then: Axes,
        meet: Callable[[Components], Any],
        meet_still: Callable[[Components], Any],
    ) -> tuple[Components, Any, Tensor]:
        """Carry rays through the medium to a surface.

        Args:
            ray: in the medium, in the axes `now`.
            now: where the rays are.
            then: axes of the surface.
            meet: finds where straight rays meet it, as `dolens.optics.trace.meet` does.
            meet_still: the same of a surface without derivatives; see `still`.

        Returns:
            The rays that arrive, in the axes `then`; where they meet the surface; and their optical
            path, mm.
        """
        start = _seen_from(ray, now, self.axes)
        with torch.no_grad():
            # No derivative is carried along while the place is looked for.
            values = tuple(map(still, self.profile.values))
            profile = replace(self.profile, values=values)
            held = replace(self, profile=profile, base=still(self.base), axes=still(self.axes))
            begin = _seen_from(still(ray), still(now), held.axes)
            t, kept = held._time(held._motion(begin), still(then), meet_still)
        # A ray that is lost stays at the vertex: nothing infinite comes into the derivatives.
        x, y, z = (part.masked_fill(~kept, 0.0) for part in start[:3])
        end = self._carried(self._motion(start._replace(x=x, y=y, z=z)), t, self.steps)
        found, rest, force = self._meeting(end, then, meet)
        speeds = zip(end[3:6], (force.x, force.y, force.z), strict=True)
        cosines = _unit(*(speed + rest * slope for speed, slope in speeds))
        arriving = _seen_from(Components(*end[:3], *cosines), self.axes, then)
        size = 1e3 * max(torch.finfo(t.dtype).eps, 1e-9) * (1.0 + self.reach)
        near = size - rest.detach().abs()
        met = torch.where(kept, torch.minimum(found.met, near), -1.0)
        on_it = found.ray._replace(l=arriving.l, m=arriving.m, n=arriving.n)
        return arriving, found._replace(ray=on_it, met=met), end.path + rest * force.squared

    def between(
        self, ray: Components, now: Axes, end: tuple[Tensor, Tensor, Tensor], count: int
    ) -> list[tuple[Tensor, Tensor, Tensor]]:
        """Return points on the way of rays, in the lens's axes, mm, for drawings.

        Args:
            ray: where they begin, in the axes `now`.
            now: where the rays are.
            end: where they meet the next surface, in the lens's axes, mm.
            count: of points, equal steps of t apart.
        """
        start = self._motion(_seen_from(ray, now, self.axes))
        x, y, z = points_from_lens_axes(end, self.axes)
        t, motion = torch.zeros_like(x), start
        for _ in range(_APPROACHES):
            speeds, ways = motion[3:6], (x - motion.x, y - motion.y, z - motion.z)
            left = sum(speed * way for speed, way in zip(speeds, ways, strict=True))
            t = t + left / sum(speed * speed for speed in speeds)
            motion = carry(self.bend, start, t, self.steps)
        shares = (k / (count + 1) for k in range(1, count + 1))
        points = (carry(self.bend, start, share * t, self.steps)[:3] for share in shares)
        return [points_to_lens_axes(point, self.axes) for point in points]

    def _carried(self, motion: Motion, t: Tensor, steps: int) -> Motion:
        """Return rays that are carried on by t."""
        if not self.kernels or not (is_transformed() or (t.numel() >= _FEW and is_eager([t]))):
            return carry(self.bend, motion, t, steps)
        parts = torch.stack(torch.broadcast_tensors(*motion)).reshape(7, -1)
        if not any(isinstance(v, Tensor) and v.numel() > 1 for v in self.profile.values):
            end = self._by_kernel(
                parts, t.reshape(-1), self._coefficients(t), self._bases(t), steps
            )
            return Motion(*end.reshape(7, *t.shape))
        found = self._each_colour(t)
        if found is None:
            return carry(self.bend, motion, t, steps)
        ends = [
            self._by_kernel(parts[:, rays], t.reshape(-1)[rays], coefficients, base, steps)
            for rays, coefficients, base in found
        ]
        order = torch.cat([rays for rays, _, _ in found]).argsort()
        return Motion(*torch.cat(ends, 1)[:, order].reshape(7, *t.shape))

    def _by_kernel(
        self, motion: Tensor, t: Tensor, coefficients: Tensor, base: Tensor, steps: int
    ) -> Tensor:
        form = Form(self.profile.terms, self.profile.squared)
        end: Tensor = _Carry.apply(motion, t.contiguous(), base, coefficients, form, steps)
        return end

    def _bases(self, like: Tensor) -> Tensor:
        """Return the base's index, (N,) or (1,)."""
        base = torch.as_tensor(self.base, dtype=like.dtype, device=like.device)
        return (base.expand(like.shape) if base.numel() > 1 else base).reshape(-1).contiguous()

    def _coefficients(self, like: Tensor, ray: Tensor | None = None) -> Tensor:
        """Return the coefficients (14,) of `KERNEL_TERMS`, of one ray where they differ."""
        options: dict[str, Any] = {"dtype": like.dtype, "device": like.device}
        numbers = [torch.as_tensor(number, **options) for number in self.profile.coefficients]
        if ray is not None:
            numbers = [n.expand(like.shape).reshape(-1)[ray] for n in numbers]
        return torch.stack([number.reshape(()) for number in numbers])

    def _each_colour(self, like: Tensor) -> list[tuple[Tensor, Tensor, Tensor]] | None:
        """Return the rays of each wavelength, their coefficients and base; None where there are too
        many, or derivatives with respect to them are wanted.
        """
        colours = self.colours
        if colours is None or colours.requires_grad or not _is_plain(colours):
            return None
        several, which = colours.expand(like.shape).reshape(-1).unique(return_inverse=True)
        if len(several) > _COLOURS:
            return None
        base, found = self._bases(like), []
        for k in range(len(several)):
            rays = (which == k).nonzero().squeeze(1)
            own = base[rays] if base.numel() > 1 else base
            found.append((rays, self._coefficients(like, rays[0]), own.contiguous()))
        return found

    def _index(self, x: Tensor, y: Tensor, z: Tensor) -> Tensor:
        x, y, z = (part.clamp(-self.reach, self.reach) for part in (x, y, z))
        squared = self.bend(x, y, z).squared + torch.zeros_like(x)
        return squared.clamp(_LEAST, _LARGEST).sqrt()

    def _motion(self, ray: Components) -> Motion:
        """Return rays in motion."""
        n = self._index(*ray[:3])
        return Motion(*ray[:3], n * ray.l, n * ray.m, n * ray.n, torch.zeros_like(n))

    def _meeting(
        self, motion: Motion, then: Axes, meet: Callable[[Components], Any]
    ) -> tuple[Any, Tensor, Bend]:
        """Return where rays meet the surface along their tangents, t to there, and their bend."""
        x, y, z = motion[:3]
        tangent = Components(x, y, z, *_unit(*motion[3:6]))
        found = meet(_seen_from(tangent, self.axes, then))
        n = self._index(x, y, z)
        force = self.bend(x, y, z)._replace(squared=n * n)
        return found, (found.to_plane + found.t) / n, force

    def _time(
        self, start: Motion, then: Axes, meet: Callable[[Components], Any]
    ) -> tuple[Tensor, Tensor]:
        """Return t to the surface, zero for rays that are lost on the way, and which are not."""
        _, rest, _ = self._meeting(start, then, meet)
        t, motion, steps = torch.zeros_like(rest), start, self.steps
        for _ in range(_APPROACHES):
            t, motion = t + rest, self._carried(motion, rest, steps)
            steps = max(1, self.steps // _SHARE)
            _, rest, force = self._meeting(motion, then, meet)
        t = t + rest
        kept = (force.squared > _LEAST) & (force.squared < _LARGEST) & t.isfinite()
        for end in motion[:3]:
            kept = kept & (end.abs() < self.reach)
        return t.masked_fill(~kept, 0.0), kept


def _is_plain(tensor: Tensor) -> bool:
    return not torch._C._functorch.is_functorch_wrapped_tensor(tensor)


def still(value: Any) -> Any:
    """Return numbers, or a tuple of them, without derivatives, and out of transforms that do not
    make many of one.
    """
    if isinstance(value, Tensor):
        value = value.detach()
        if is_transformed():
            beneath = torch.func.debug_unwrap(value, recurse=True)
            value = beneath if beneath.shape == value.shape else value
        return value
    if isinstance(value, Axes | Components):
        return type(value)(*map(still, value))
    return value


def _unit(x: Tensor, y: Tensor, z: Tensor) -> tuple[Tensor, Tensor, Tensor]:
    length = (x * x + y * y + z * z).clamp(min=_LEAST).sqrt()
    return x / length, y / length, z / length


def _seen_from(ray: Components, now: Axes, then: Axes) -> Components:
    """Return rays in the axes `now` in the axes `then`, where they are."""
    if now.together(then):
        return ray._replace(z=ray.z + (now.z - then.z))
    return from_lens_axes(to_lens_axes(ray, now), then)
