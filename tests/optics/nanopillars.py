"""What ridges of TiO2 on silica pass, computed without dolens: as a film, and rigorously."""

import numpy as np
import torch

from dolens.optics.metasurface import CellTable

RIDGE, SILICA, AIR = 2.43, 1.46, 1.0
PITCH, HEIGHT = 250.0, 800.0


def film(index, wavelength, height=HEIGHT):
    """Root of the share of power, with the phase, through a film on silica (Airy's formula)."""
    into, out = 2 * SILICA / (SILICA + index), 2 * index / (index + AIR)
    echo = (SILICA - index) / (SILICA + index) * (index - AIR) / (index + AIR)
    once = np.exp(2j * np.pi * index * height / wavelength)
    return into * out * once / (1 + echo * once**2) * np.sqrt(AIR / SILICA)


def effective(width, wavelength, pitch=PITCH, height=HEIGHT):
    """The same of ridges far finer than the wavelength, light polarised along them (Rytov)."""
    share = np.asarray(width) / pitch
    return film(np.sqrt(1 + share * (RIDGE**2 - 1)), wavelength, height)


def rigorous(width, wavelength, pitch=PITCH, height=HEIGHT, orders=7):
    """The same of any ridges, by coupled waves (Moharam et al., J. Opt. Soc. Am. A 12, 1068)."""
    m = np.arange(-orders, orders + 1)
    along, share = m * wavelength / pitch, width / pitch
    steps = m[:, None] - m
    square = (RIDGE**2 - 1) * share * np.sinc(steps * share) + (steps == 0)

    def root(value):
        found = np.sqrt(value.astype(complex))
        return np.where(found.imag < 0, -found, found)

    squares, modes = np.linalg.eigh(square - np.diag(along**2))
    normal = root(squares)
    front, behind = (1j * root(n**2 - along**2)[:, None] * modes for n in (SILICA, AIR))
    through = np.exp(2j * np.pi / wavelength * normal * height)
    slope = modes * (-1j * normal)
    system = np.block(
        [[front - slope, (front + slope) * through], [(behind + slope) * through, behind - slope]]
    )
    light = np.zeros(2 * len(m), complex)
    light[orders] = 2j * SILICA
    waves = np.linalg.solve(system, light)
    passed = modes @ (through * waves[: len(m)] + waves[len(m) :])
    return passed[orders] * np.sqrt(AIR / SILICA)


def table_of(passed, widths, wavelengths):
    """A table of what cells pass."""
    t = np.array([[passed(width, wave) for width in widths] for wave in wavelengths])
    return CellTable(widths, wavelengths, np.angle(t), np.abs(t))


FILMS = table_of(effective, np.linspace(60, 230, 35), np.linspace(460, 640, 19))


def interpolated(table, widths, wavelengths):
    """What a table says of widths at wavelengths, (L, W)."""
    widths = torch.as_tensor(widths)
    return np.stack([table.transmission(widths, float(w)).numpy() for w in wavelengths])
