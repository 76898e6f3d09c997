"""Thin films on a surface: what a stack of layers reflects, passes and absorbs.

Light is a plane wave exp(i(k·x - ωt)), so that an absorbing medium has the index n + iκ with κ ≥ 0.
Over the vacuum's, its wavenumber along the films is β = n₀·sin θ in all media (Snell), and along
the normal it is q = √(n² - β²) in each, with Re q ≥ 0 and Im q ≥ 0.

Amplitudes are those of the electric field (Born and Wolf, *Principles of Optics*, 1.5.2): s along
the normal of the plane of incidence, p such that r_p = -r_s and t_p = t_s at normal incidence.

Layers are added one by one from the back (Rouard's recursion; Heavens, *Optical Properties of Thin
Solid Films*, 4.6),

    r = (r₁ + r'·e²) / (1 + r₁·r'·e²),   t = t₁·t'·e / (1 + r₁·r'·e²),   e = exp(2πi·q·d/λ),

with the amplitudes r₁, t₁ of a layer's front, and r', t' of all behind it.  |e| ≤ 1, so nothing
overflows however thick an absorbing layer is, as products of matrices do.
"""

import math
from collections.abc import Sequence
from dataclasses import dataclass
from typing import NamedTuple

import torch
from torch import Tensor


@dataclass(frozen=True)
class Layer:
    """A homogeneous film.

    Attributes:
        index: n + iκ, real or complex, κ ≥ 0.
        thickness: nm.
    """

    index: Tensor | complex
    thickness: Tensor | float


class Polarised(NamedTuple):
    """Reflected and transmitted numbers (...) of both polarisations: complex amplitudes of the
    electric field, or shares of the power.
    """

    r_s: Tensor
    r_p: Tensor
    t_s: Tensor
    t_p: Tensor

    @property
    def reflected(self) -> Tensor:
        """Return the share of unpolarised light that is reflected, of shares."""
        return 0.5 * (self.r_s + self.r_p)

    @property
    def passed(self) -> Tensor:
        """Return the share of unpolarised light that passes, of shares."""
        return 0.5 * (self.t_s + self.t_p)


class Parts(NamedTuple):
    """A complex number (...) as two real ones; a product with real ones takes half of the time.

    Attributes:
        real: its real part.
        imaginary: None: zero.
    """

    real: Tensor
    imaginary: Tensor | None = None

    @staticmethod
    def of(value: Tensor) -> "Parts":
        """Return the parts of a complex tensor."""
        return Parts(value.real, value.imag)

    def times(self, real: Tensor | float) -> "Parts":
        """Return the product with a real number."""
        i = self.imaginary
        return Parts(self.real * real, None if i is None else i * real)

    def plus(self, other: "Parts", real: Tensor | float = 1.0) -> "Parts":
        """Return the sum with another number times a real one."""
        i, j = self.imaginary, other.imaginary
        if i is not None and j is not None:
            i = _sum(i, j, real)
        elif j is not None:
            i = j * real
        return Parts(_sum(self.real, other.real, real), i)

    def product(self, other: "Parts") -> "Parts":
        """Return the product."""
        (a, b), (c, d) = self, other
        if b is None:
            return other.times(a)
        if d is None:
            return self.times(c)
        return Parts(torch.addcmul(a * c, b, d, value=-1.0), torch.addcmul(a * d, b, c))


def _sum(a: Tensor, b: Tensor, real: Tensor | float) -> Tensor:
    if isinstance(real, Tensor):
        return torch.addcmul(a, b, real)
    return torch.add(a, b, alpha=real)


class _Boundary(NamedTuple):
    """Amplitudes where two media meet; t is over the normal wavenumber in front."""

    r_s: Tensor
    r_p: Tensor
    t_s: Tensor
    t_p: Tensor


class _Behind(NamedTuple):
    """A boundary, and all that lies behind it.

    Attributes:
        front: of the boundary alone.
        whole: of the boundary and all behind it.
        echo: e² times what is reflected behind, s and p; zero at the last boundary.
    """

    front: _Boundary
    whole: Polarised
    echo: tuple[Tensor, Tensor]


def amplitudes(
    front: Tensor | complex,
    layers: Sequence[Layer],
    behind: Tensor | complex,
    cosine: Tensor,
    wavelength: Tensor | float,
) -> Polarised:
    """Return the amplitudes r_s, r_p, t_s, t_p of a stack, complex.

    They are at the first and the last boundary.  A stack without layers gives Fresnel's equations.
    All arguments broadcast and are differentiable.

    Args:
        front: index of the medium that light comes from; transparent.
        layers: in the order that light meets them.
        behind: index of the medium behind the stack.
        cosine: of the angle of incidence in front, (...), from 0 to 1; its precision is that of
            the result.
        wavelength: nm.
    """
    media = _Media(front, layers, behind, cosine, wavelength)
    whole = _reflected(media)[0].whole
    q = media.q[0]
    return Polarised(whole.r_s, whole.r_p, q * whole.t_s, q * whole.t_p)


def shares(
    front: Tensor | complex,
    layers: Sequence[Layer],
    behind: Tensor | complex,
    cosine: Tensor,
    wavelength: Tensor | float,
) -> Polarised:
    """Return the shares of power R_s, R_p, T_s, T_p that a stack reflects and passes, real.

    R = |r|², T_s = Re(q')·|t_s|²/q and T_p = Re(q'/n'²)·|n'|²·|t_p|²/q: fluxes along the normal
    behind the stack (n', q') over that in front of it (Born and Wolf 1.5.3).  What is missing to
    one is absorbed; see `absorbed`.  Arguments are those of `amplitudes`.
    """
    media = _Media(front, layers, behind, cosine, wavelength)
    whole = _reflected(media)[0].whole
    return _shares(media, whole)


def transparent(
    front: Tensor | float,
    layers: Sequence[Layer],
    behind: Tensor | float,
    cosine: Tensor,
    wavelength: Tensor | float,
) -> tuple[Parts, Parts] | None:
    """Return the amplitudes t_s and t_p of a transparent stack, by real arithmetic.

    None where a medium absorbs, or light is totally reflected in one.

    By characteristic matrices (Born and Wolf 1.6.2).  Arguments are those of `amplitudes`.
    """
    media = (front, *(layer.index for layer in layers), behind)
    if any(isinstance(n, complex) or (isinstance(n, Tensor) and n.is_complex()) for n in media):
        return None
    n = [torch.as_tensor(index, dtype=cosine.dtype, device=cosine.device) for index in media]
    square = (n[0] * cosine).square()
    squares = [square, *(square + (m - n[0]) * (m + n[0]) for m in n[1:])]
    if not all(bool((s.detach() > _FAR_FROM_TOTAL).all()) for s in squares):
        return None
    q = [s.sqrt() for s in squares]
    k = 2.0 * math.pi / torch.as_tensor(wavelength, dtype=cosine.dtype, device=cosine.device)
    turns = [k * layer.thickness * p for layer, p in zip(layers, q[1:], strict=False)]
    waves = [(phase.cos(), phase.sin()) for phase in turns]
    # Of the tangential fields; that of p is cos θ of the whole.
    of_s = _through(q, waves)
    ratio = q[0] * n[-1] / (q[-1] * n[0])
    of_p = _through([m * m / p for m, p in zip(n, q, strict=True)], waves)
    return of_s, of_p.times(ratio)


# Square of a normal wavenumber over the vacuum's, above which derivatives of its root are harmless.
_FAR_FROM_TOTAL = 1e-6


def _through(admittance: list[Tensor], waves: list[tuple[Tensor, Tensor]]) -> Parts:
    """Return 2η/(η·B + C) of the tangential electric field, with (B, C) = M·(1, η').

    Args:
        admittance: η of each medium.
        waves: cosine and sine of each layer's phase.
    """
    y, last = admittance[0], admittance[-1]
    if not waves:
        return Parts(2.0 * y / (y + last))
    # B = b + i·e and C = c + i·f; a transparent layer mixes b with f, and c with e.
    (b, sine), inner = waves[-1], admittance[-2]
    c, e, f = b * last, sine * last / -inner, -sine * inner
    for eta, (cosine, sine) in zip(admittance[-3:0:-1], waves[-2::-1], strict=True):
        thin, thick = sine / eta, sine * eta
        b, f = cosine * b + thin * f, cosine * f - thick * b
        c, e = cosine * c + thick * e, cosine * e - thin * c
    real, imaginary = torch.addcmul(c, y, b), torch.addcmul(f, y, e)
    share = 2.0 * y / torch.addcmul(real * real, imaginary, imaginary)
    return Parts(share * real, -share * imaginary)


def absorbed(
    front: Tensor | complex,
    layers: Sequence[Layer],
    behind: Tensor | complex,
    cosine: Tensor,
    wavelength: Tensor | float,
) -> tuple[Tensor, Tensor]:
    """Return the shares of power that each layer absorbs, (layers, ...) of s and of p.

    They are integrals of the heat, k·Im(n²)·|E|², through each layer, and owe nothing to what is
    reflected and transmitted.  Arguments are those of `amplitudes`.
    """
    media = _Media(front, layers, behind, cosine, wavelength)
    found = _reflected(media)
    q0 = media.q[0]
    forward_s, forward_p = q0, q0
    of_s, of_p = [], []
    for number, depth in enumerate(media.depths):
        boundary, (echo_s, echo_p) = found[number].front, found[number].echo
        forward_s = forward_s * boundary.t_s / (1.0 + boundary.r_s * echo_s)
        forward_p = forward_p * boundary.t_p / (1.0 + boundary.r_p * echo_p)
        n, q = media.n[number + 1], media.q[number + 1]
        after = found[number + 1].whole
        heat = (n * n).imag / q0.real
        of_s.append(heat * _square(forward_s) * _energy(q, depth, after.r_s))
        # Along the film the reflected field has the other sign, along the normal the same.
        along = _square(q / n) * _energy(q, depth, -after.r_p)
        normal = media.beta2 / _square(n) * _energy(q, depth, after.r_p)
        of_p.append(heat * _square(forward_p) * (along + normal))
        passed = torch.exp(1j * q * depth) * q
        forward_s, forward_p = forward_s * passed, forward_p * passed
    if not layers:
        nothing = torch.zeros_like(q0.real)[None][:0]
        return nothing, nothing
    return torch.stack(of_s), torch.stack(of_p)


def _energy(q: Tensor, depth: Tensor, reflected: Tensor) -> Tensor:
    """Return the integral of |E|² over a layer, with E = e^{iqζ} + ρ·e^{iq(2D - ζ)} at ζ = kz.

    Args:
        q: a + ib.
        depth: D = kd.
        reflected: ρ, at the layer's back.
    """
    a, b = q.real, q.imag
    twice = 2.0 * b * depth
    # (1 - e^{-x})/x, 1 at zero.
    thin = twice < torch.finfo(b.dtype).eps
    one_way = depth * torch.where(thin, 1.0, -torch.expm1(-twice) / torch.where(thin, 1.0, twice))
    back = torch.exp(-twice)
    wave = depth * torch.sinc(a * depth / math.pi) * torch.exp(torch.complex(0.0 * a, -a * depth))
    cross = 2.0 * (reflected.conj() * wave).real
    return one_way * (1.0 + back * _square(reflected)) + back * cross


class _Media:
    """All media have these numbers at one angle of incidence and wavelength.

    Attributes:
        beta2: the square of the tangential wavenumber.
        n: indices, complex.
        q: normal wavenumbers, complex.
        depths: of the layers, kd.
    """

    def __init__(
        self,
        front: Tensor | complex,
        layers: Sequence[Layer],
        behind: Tensor | complex,
        cosine: Tensor,
        wavelength: Tensor | float,
    ) -> None:
        real, device = cosine.dtype, cosine.device
        given = (front, *(layer.index for layer in layers), behind)
        self.n = [torch.as_tensor(n, dtype=real.to_complex(), device=device) for n in given]
        first = self.n[0]
        self.beta2 = (first * first).real * ((1.0 - cosine) * (1.0 + cosine))
        # At grazing incidence q is held a little above zero, where quotients of it are finite.
        q = first * (cosine + 1e2 * math.sqrt(torch.finfo(real).tiny))
        self.q = [q, *(_normal_wavenumber(first, q, n) for n in self.n[1:])]
        k = 2.0 * math.pi / torch.as_tensor(wavelength, dtype=real, device=device)
        self.depths = [
            k * torch.as_tensor(layer.thickness, dtype=real, device=device) for layer in layers
        ]


def _normal_wavenumber(first: Tensor, q: Tensor, n: Tensor) -> Tensor:
    """Return √(n² - β²) in a medium from q in the first: q² - q'² = n² - n'² in any two media.

    Zero is held a little above it, where the root still has a derivative; that is then zero.
    """
    squared = (n - first) * (n + first) + q * q
    # Adding zero makes +0 of -0, which would choose the other root.
    squared = torch.complex(squared.real, squared.imag + 0.0)
    least = 1e4 * torch.finfo(q.real.dtype).tiny
    dark = squared.abs() < least
    return torch.where(dark, math.sqrt(least), torch.where(dark, 1.0, squared).sqrt())


def _boundary(n: Tensor, m: Tensor, beta2: Tensor, q: Tensor, p: Tensor) -> _Boundary:
    """Fresnel's amplitudes from a medium (n, q) to another (m, p).

    q² - p² = n² - m², and (m²q)² - (n²p)² = (m² - n²)·(n²m² - β²(n² + m²)), take the place of
    differences whose terms cancel: equal indices reflect exactly nothing.
    """
    n2, m2 = n * n, m * m
    step = (m - n) * (m + n)
    s, h = q + p, m2 * q + n2 * p
    # Divided twice: their squares may underflow where light grazes the boundary.
    return _Boundary(
        -step / s / s,
        step * (n2 * m2 - beta2 * (n2 + m2)) / h / h,
        2.0 / s,
        2.0 * n * m / h,
    )


def _reflected(media: _Media) -> list[_Behind]:
    """Return what each boundary and all behind it reflect and pass, from the first to the last."""
    beta2, n, q = media.beta2, media.n, media.q
    last = _boundary(n[-2], n[-1], beta2, q[-2], q[-1])
    nothing = torch.zeros_like(last.r_s)
    found = [_Behind(last, Polarised(*last), (nothing, nothing))]
    for number, depth in reversed(list(enumerate(media.depths))):
        behind = found[0].whole
        front = _boundary(n[number], n[number + 1], beta2, q[number], q[number + 1])
        phase = q[number + 1] * depth
        e = torch.exp(torch.complex(-phase.imag, phase.real))
        echo_s, echo_p = behind.r_s * e * e, behind.r_p * e * e
        of_s, of_p = 1.0 + front.r_s * echo_s, 1.0 + front.r_p * echo_p
        inside = e * q[number + 1]  # t behind is over the layer's own q
        whole = Polarised(
            (front.r_s + echo_s) / of_s,
            (front.r_p + echo_p) / of_p,
            front.t_s * behind.t_s * inside / of_s,
            front.t_p * behind.t_p * inside / of_p,
        )
        found.insert(0, _Behind(front, whole, (echo_s, echo_p)))
    return found


def _shares(media: _Media, whole: Polarised) -> Polarised:
    m, q, p = media.n[-1], media.q[0], media.q[-1]
    # |t|²·p/q with t over q: no division by a q that is zero at grazing incidence.
    of_s = p.real * q.real
    of_p = (p / (m * m)).real * _square(m) * q.real
    return Polarised(
        _square(whole.r_s),
        _square(whole.r_p),
        of_s * _square(whole.t_s),
        of_p * _square(whole.t_p),
    )


def _square(value: Tensor) -> Tensor:
    """Return |z|², whose derivative is finite at zero."""
    return value.real.square() + value.imag.square()
