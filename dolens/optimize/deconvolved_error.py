"""The deconvolved error is what the best linear filter leaves of a blurred and noisy photograph.

It is a smooth function of the ray intercepts, without photographs, draws of noise or a network, so
that its first and second derivatives over the intercepts are known.
A network that follows a deconvolution does better than the filter, by an amount that varies little
from lens to lens; Stork and Robinson (Appl. Opt. 47, B64, 2008) design lenses by this error.
"""

import math
from collections.abc import Sequence
from dataclasses import dataclass

import torch
from torch import Tensor

from dolens.analysis.pupil_quadrature import SpotRays
from dolens.errors import InputError
from dolens.optimize.ray_intercept_quality import RayGroups

# Rows: luminance, red against blue, green against both (see `opponent_wiener`).
_OPPONENT = ((1.0, 1.0, 1.0), (1.0, 0.0, -1.0), (1.0, -2.0, 1.0))
# Their power in photographs, over that of luminance.
_OPPONENT_POWER = (1.0, 0.07, 0.018)
# Luminance's f²·S at f₁, f₁, how it falls from there, and where textures end, cycles a pixel.
_POWER, _FREQUENCY, _FALL, _END = 0.002, 0.05, 0.4, 0.38
# The lowest frequency: blur takes nothing from larger shapes.
_LOWEST = 1.0 / 128.0
# Smaller than any error, so that the power mean's root is never taken of zero.
_TINY = 1e-12


@dataclass(frozen=True)
class Photographs:
    """Statistics of photographs and of a sensor, in linear light.

    Attributes:
        pitch: of the pixels, mm.
        noise: N, variance of a pixel of mean grey.

    Raises:
        InputError: a number that is not positive.
    """

    pitch: float
    noise: float

    def __post_init__(self) -> None:
        for name in ("pitch", "noise"):
            if not 0.0 < getattr(self, name) < math.inf:
                raise InputError(f"{name}: {getattr(self, name)}; allowed: above 0")


def luminance_spectrum(frequency: Tensor) -> Tensor:
    """Return the power spectrum S of photographs' luminance, linear light, 1 for white.

    S = 0.002·(f/0.05)^-0.4·exp(-(f/0.38)²)/f².  Fitted to 240 crops of 128×128 pixels of 31
    photographs that cameras are trained on; within 20 % of them from 0.017 to 0.45 cycles a pixel.
    It falls faster than Field's 1/f² (J. Opt. Soc. Am. A 4, 2379, 1987), as pixels of photographs
    are soft themselves.

    Args:
        frequency: f, cycles a pixel, above 0.
    """
    falling = (frequency / _FREQUENCY) ** -_FALL * torch.exp(-((frequency / _END) ** 2))
    return _POWER * falling / frequency.square()


@dataclass(frozen=True)
class DeconvolvedError:
    """Computes the error that is left where several views share the best linear filter.

    A photograph has the spectrum S(ν)·C in its three colours, C being their covariance: luminance
    has most of the power.  A view v has the transfer functions H_v = diag(H_vr, H_vg, H_vb) of its
    ray intercepts p_k with weights w_k, and of the pixels' squares of side a,

        H_vc(ν) = sinc(a ν_x) sinc(a ν_y) Σ_k w_k exp(-2πi ν·p_k).

    The filter of least mean error over the V views that share it is

        W = B A⁻¹,  A = S·mean_v(H_v C H_v*) + N·1,  B = S·C·mean_v(H_v*),

    and the error of view v, over the photographs' variance, is

        E_v = ∫ S·tr[(1 - W H_v) C (1 - W H_v)*] + N·tr[W W*] dν / ∫ S·tr[C] dν.

    A network that is trained for a short time, or that is not told the transfer functions, does
    less: (1 - s)·1 + s·W with a strength s takes the place of W, so that s = 0 counts the blur as
    it is.  The loss is the power mean (Σ_v q_v E_v^p)^(1/p) of the views, Σ q_v = 1.

    Args:
        view: of each ray, (N,), int64, from 0 to V - 1.
        colour: of each ray, (N,), 0 to 2.
        share: of each ray in its view's light of its colour, (N,); they sum to one over each.
        filters: of each view, the number of its filter, from 0, (V,): views that share a filter
            are not told apart.
        view_weights: q, (V,).
        photographs: and sensor.
        norm: p, at least 1: the larger, the more the worst view counts.
        strength: s, from 0 to 1; see above.
        rings: frequencies along a radius, up to the Nyquist frequency.
        arms: directions over half a turn.

    Raises:
        InputError: p below 1, a strength out of range, or no frequencies.
    """

    view: Tensor
    colour: Tensor
    share: Tensor
    filters: Tensor
    view_weights: Tensor
    photographs: Photographs
    norm: float = 1.0
    strength: float = 1.0
    rings: int = 10
    arms: int = 10

    def __post_init__(self) -> None:
        if not 1.0 <= self.norm < math.inf:
            raise InputError(f"norm: {self.norm}; allowed: 1 or more")
        if not 0.0 <= self.strength <= 1.0:
            raise InputError(f"strength: {self.strength}; allowed: 0 to 1")
        if self.rings < 1 or self.arms < 1:
            raise InputError(f"rings, arms: {self.rings}, {self.arms}; allowed: 1 or more")

    @staticmethod
    def of_spots(
        spots: SpotRays,
        filters: Sequence[int],
        view_of_spot: Sequence[int],
        view_weights: Sequence[float],
        photographs: Photographs,
        norm: float = 1.0,
        strength: float = 1.0,
    ) -> "DeconvolvedError":
        """Return the error of views whose spots are given, three wavelengths to each.

        Args:
            spots: the rays; chief rays weigh nothing.
            filters: of each view.
            view_of_spot: view of each spot; its wavelengths are red, green, blue in their order.
            view_weights: of each view; they are divided by their sum.
            photographs: and sensor.
            norm: p.
            strength: s.

        Raises:
            InputError: a view that has not three spots.
        """
        views, of_spot = len(filters), torch.tensor(list(view_of_spot))
        colour = torch.zeros(len(of_spot), dtype=torch.int64)
        for number in range(views):
            own = torch.nonzero(of_spot == number).flatten()
            if len(own) != 3:
                raise InputError(f"deconvolved error: view {number} has {len(own)} spots, not 3")
            colour[own] = torch.arange(3)
        spot = spots.spot.cpu()
        weights = torch.tensor(list(view_weights), dtype=torch.float64)
        return DeconvolvedError(
            of_spot[spot],
            colour[spot],
            spots.weight.cpu(),
            torch.tensor(list(filters)),
            weights / weights.sum(),
            photographs,
            norm,
            strength,
        )

    def __call__(self, points: Tensor, groups: RayGroups) -> Tensor:
        """Return the loss of ray intercepts (2, N), mm from a point that a view's rays share."""
        return self._loss(self.transfer(points))

    def second_derivatives(self, points: Tensor, groups: RayGroups, moves: Tensor) -> Tensor:
        """Return m_iᵀ (∂²L/∂p²) m_j, (P, P), of P displacements of the rays.

        The loss depends on the rays by few numbers, H, of which its second derivative is taken;
        rays move H by ∂H/∂p, and their phases' own second derivative is a 2×2 matrix a ray.

        Args:
            points: (2, N), mm.
            groups: not looked at.
            moves: m, (P, 2, N), mm.
        """
        frequency, _ = self._frequencies(points)
        turn = self._turn * frequency
        waves = self._waves(points, frequency)
        transfer = torch.view_as_real(self._summed(waves)).requires_grad_()
        with torch.enable_grad():
            loss = self._loss(torch.view_as_complex(transfer))
            (gradient,) = torch.autograd.grad(loss, transfer, create_graph=True)
        moved = self._moved_transfer(waves, turn, moves)
        (curved,) = torch.autograd.grad(gradient, transfer, moved, is_grads_batched=True)
        found = moved.flatten(1) @ curved.flatten(1).T
        slope = torch.view_as_complex(gradient.detach()).flatten(1).conj()  # (F, 3V)
        own = -(slope[:, self._spot] * waves).real  # (F, N)
        matrices = torch.einsum("fk,fa,fb->kab", own, turn, turn)
        return found + torch.einsum("iak,kab,jbk->ij", moves, matrices, moves)

    def _moved_transfer(self, waves: Tensor, turn: Tensor, moves: Tensor) -> Tensor:
        """Return ∂H/∂p·m, (P, F, V, 3, 2), real and imaginary part."""
        count, views = len(moves), len(self.filters)
        found = waves.new_zeros((waves.shape[0], 3 * views, count))
        for number in range(3 * views):
            own = torch.nonzero(self._spot == number).flatten()
            for axis in range(2):
                slope = 1j * turn[:, axis, None] * waves[:, own]
                found[:, number] += slope @ moves[:, axis, own].T.to(slope)
        return torch.view_as_real(found.permute(2, 0, 1).unflatten(2, (views, 3)).contiguous())

    def errors(self, points: Tensor) -> Tensor:
        """Return the errors E (V,) of the views, shares of the photographs' variance."""
        return self._errors(self.transfer(points))

    def _loss(self, transfer: Tensor) -> Tensor:
        errors = self._errors(transfer)
        weights = self.view_weights.to(errors)
        return (weights * (errors + _TINY) ** self.norm).sum() ** (1.0 / self.norm)

    def _errors(self, transfer: Tensor) -> Tensor:
        """Return E (V,) of transfer functions (F, V, 3), complex."""
        like = transfer.real.detach()
        frequency, area = self._frequencies(like)
        power = luminance_spectrum(frequency.norm(dim=-1))
        covariance = _covariance().to(like)
        count = int(self.filters.max()) + 1
        member = torch.nn.functional.one_hot(self.filters, count).to(like)  # (V, G)
        mean = (member / member.sum(0)).to(transfer)
        pairs = transfer[..., :, None] * transfer.conj()[..., None, :] * covariance
        seen = torch.einsum("vg,fvij->fgij", mean, pairs)
        unity = torch.eye(3, dtype=like.dtype)
        known = power[:, None, None, None] * seen + self.photographs.noise * unity
        asked = torch.einsum("vg,fvj->fgj", mean, transfer.conj())
        asked = power[:, None, None, None] * covariance * asked[..., None, :]
        # W = B A⁻¹, A being Hermitian.
        found = torch.linalg.solve(known.mH, asked.mH).mH[:, self.filters]  # (F, V, 3, 3)
        found = (1.0 - self.strength) * unity + self.strength * found
        left = unity - found * transfer[..., None, :]
        blurred = torch.einsum("fvij,jk,fvik->fv", left, covariance.to(left), left.conj()).real
        noisy = (found.real.square() + found.imag.square()).sum((-2, -1))
        error = power[:, None] * blurred + self.photographs.noise * noisy
        whole = (area * power).sum() * covariance.trace()
        return (area[:, None] * error).sum(0) / whole

    def transfer(self, points: Tensor) -> Tensor:
        """Return the transfer functions H (F, V, 3), complex, of ray intercepts (2, N), mm."""
        frequency, _ = self._frequencies(points)
        return self._summed(self._waves(points, frequency))

    @property
    def _spot(self) -> Tensor:
        """Return the number of each ray's view and colour, (N,), of 3V."""
        return 3 * self.view + self.colour

    def _summed(self, waves: Tensor) -> Tensor:
        """Return H (F, V, 3) of what each ray adds to it (F, N)."""
        sums = waves.new_zeros((len(waves), 3 * len(self.filters)))
        sums = sums.index_add(1, self._spot, waves)
        return sums.unflatten(1, (len(self.filters), 3))

    @property
    def _turn(self) -> float:
        """Return by how much a ray's phase turns, radians a mm, at one cycle a pixel."""
        return -2.0 * math.pi / self.photographs.pitch

    def _waves(self, points: Tensor, frequency: Tensor) -> Tensor:
        """Return what each ray adds to its transfer function, (F, N), complex."""
        phase = self._turn * (frequency @ points)
        pixel = torch.sinc(frequency).prod(-1)
        return torch.polar(pixel[:, None] * self.share.to(points), phase)

    def _frequencies(self, like: Tensor) -> tuple[Tensor, Tensor]:
        """Return frequencies (F, 2), cycles a pixel, of half the plane, and their areas (F,).

        Radii are even in their logarithm, as the power is.
        """
        lowest, highest = math.log(_LOWEST), math.log(0.5)
        step = (highest - lowest) / self.rings
        radius = (lowest + step * (torch.arange(self.rings).to(like) + 0.5)).exp()
        angle = math.pi / self.arms * (torch.arange(self.arms).to(like) + 0.5)
        frequency = radius[:, None, None] * torch.stack([angle.cos(), angle.sin()], -1)
        area = (radius.square() * step * math.pi / self.arms)[:, None].expand(-1, self.arms)
        return frequency.flatten(0, 1), area.flatten()


def _covariance() -> Tensor:
    """Return C (3, 3) of red, green and blue, over the power of luminance."""
    axes = torch.nn.functional.normalize(torch.tensor(_OPPONENT, dtype=torch.float64), dim=1)
    power = torch.tensor(_OPPONENT_POWER, dtype=torch.float64)
    return axes.T @ (power[:, None] * axes)
