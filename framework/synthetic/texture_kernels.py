"""Procedural textures, evaluated for each pixel.

Procedural textures need no image files, have no seams, and have sufficient gradients for photometric alignment. Solid
textures (wood, fabric, paint, metal) use all three texture coordinates. Planar textures (planks, tiles, rug, painting)
use the first two. Detail that is finer than a pixel is faded out, which prevents flicker between frames.

Lengths are in m unless stated otherwise. `footprint` is the width of a pixel on the surface. A *color mix* of 0 is the
first color of the material, and a color mix of 1 is the second color. A *brightness factor* scales the mixed color.
"""

from __future__ import annotations

import numpy as np

from framework.compilation.kernel_cache import njit
from framework.data import Float32
from framework.synthetic.paints import Texture

# The textures as plain integers, which kernels can compare.
PAINT, WOOD, FABRIC, STRIPES, PLANKS, TILES, RUG, PAINTING = (int(texture) for texture in list(Texture)[:8])
SCREEN, METAL, BOOK, SKY, WALLPAPER, LEAF, CHECKS, PAGES = (int(texture) for texture in list(Texture)[8:])

# Odd 64-bit constants that distribute lattice coordinates and seeds over all bits of a hash.
STEP_X, STEP_Y = np.uint64(0x9E3779B97F4A7C15), np.uint64(0xC2B2AE3D27D4EB4F)
STEP_Z, STEP_SEED = np.uint64(0x165667B19E3779F9), np.uint64(0x27D4EB2F165667C5)


@njit(cache=True, nogil=True)
def _mixed(h: np.uint64) -> float:
    """Hash an integer to a number in [0, 1)."""
    h ^= h >> np.uint64(32)
    h *= np.uint64(0xD6E8FEB86659FD93)
    h ^= h >> np.uint64(29)
    return float(h >> np.uint64(40)) * (1.0 / 16777216.0)


@njit(cache=True, nogil=True)
def _lattice(i: int, j: int, k: int, seed: int) -> float:
    """Return a pseudorandom number in [0, 1) for a lattice point."""
    h = np.uint64(i) * STEP_X ^ np.uint64(j) * STEP_Y ^ np.uint64(k) * STEP_Z ^ np.uint64(seed) * STEP_SEED
    return float(_mixed(h))


@njit(cache=True, nogil=True)
def _noise(x: float, y: float, z: float, seed: int) -> float:
    """Return smooth value noise in [0, 1] with a lattice spacing of 1."""
    # Perlin's fade curve of 1985
    i, j, k = float(np.floor(x)), float(np.floor(y)), float(np.floor(z))
    fx, fy, fz = x - i, y - j, z - k
    fx, fy, fz = fx * fx * (3 - 2 * fx), fy * fy * (3 - 2 * fy), fz * fz * (3 - 2 * fz)
    x0, y0, z0 = np.uint64(np.int64(i)) * STEP_X, np.uint64(np.int64(j)) * STEP_Y, np.uint64(np.int64(k)) * STEP_Z
    x1, y1, z1 = x0 + STEP_X, y0 + STEP_Y, z0 + STEP_Z
    s = np.uint64(seed) * STEP_SEED
    x00 = _mixed(x0 ^ y0 ^ z0 ^ s) * (1 - fx) + _mixed(x1 ^ y0 ^ z0 ^ s) * fx
    x10 = _mixed(x0 ^ y1 ^ z0 ^ s) * (1 - fx) + _mixed(x1 ^ y1 ^ z0 ^ s) * fx
    x01 = _mixed(x0 ^ y0 ^ z1 ^ s) * (1 - fx) + _mixed(x1 ^ y0 ^ z1 ^ s) * fx
    x11 = _mixed(x0 ^ y1 ^ z1 ^ s) * (1 - fx) + _mixed(x1 ^ y1 ^ z1 ^ s) * fx
    return float((x00 * (1 - fy) + x10 * fy) * (1 - fz) + (x01 * (1 - fy) + x11 * fy) * fz)


@njit(cache=True, nogil=True)
def _visible(wavelength: float, footprint: float) -> float:
    """Return the visible fraction of detail with a given wavelength."""
    return min(1.0, max(0.0, wavelength / (2.0 * footprint) - 0.75))


@njit(cache=True, nogil=True)
def _fractal(x: float, y: float, z: float, wavelength: float, octaves: int, footprint: float, seed: int) -> float:
    """Return fractal noise in [-1, 1].

    `wavelength` is the wavelength of the first octave. Octaves that are too fine for a pixel are omitted.
    """
    value, amplitude, total = 0.0, 1.0, 0.0
    x, y, z = x / wavelength, y / wavelength, z / wavelength
    for octave in range(octaves):
        shown = _visible(wavelength, footprint)
        total += amplitude
        if shown > 0.0:
            value += shown * amplitude * (2.0 * _noise(x, y, z, seed + octave) - 1)
        x, y, z = 2 * x, 2 * y, 2 * z  # exact and faster than a division by each wavelength
        wavelength *= 0.5
        amplitude *= 0.7
    return value / total


@njit(cache=True, nogil=True)
def _step(low: float, high: float, x: float) -> float:
    """Return a smooth step from 0 at `low` to 1 at `high`."""
    t = min(1.0, max(0.0, (x - low) / (high - low)))
    return t * t * (3 - 2 * t)


@njit(cache=True, nogil=True)
def _line(x: float, width: float, footprint: float) -> float:
    """Return the antialiased coverage, in [0, 1], of lines at integer x.

    All arguments are in periods of the pattern.
    """
    d = abs(x - float(np.floor(x + 0.5)))
    blur = max(footprint, 0.25 * width)
    return float((1.0 - _step(0.5 * width - 0.5 * blur, 0.5 * width + 0.5 * blur, d)) * min(1.0, 2.0 * width / blur))


@njit(cache=True, nogil=True)
def _within(x: float, low: float, high: float, soft: float) -> float:
    """Return 1 between two limits and 0 elsewhere, with smooth transitions of width `soft`."""
    soft = max(soft, 1e-4)
    inside = _step(low - 0.5 * soft, low + 0.5 * soft, x) * (1.0 - _step(high - 0.5 * soft, high + 0.5 * soft, x))
    return float(inside)


@njit(cache=True, nogil=True)
def _wood(x: float, y: float, z: float, scale: float, footprint: float, seed: int) -> float:
    """Return the color mix of wood with grain along x and growth rings with spacing `scale`."""
    bend = 2.2 * _noise(0.9 * x, 5 * y, 5 * z, seed)
    rings = 0.5 + 0.5 * float(np.sin(2 * np.pi * (0.7 * (y + 0.6 * z) / scale + bend)))
    mix = 0.3 + 0.45 * rings * _visible(scale, footprint)
    broad, fine = _visible(0.02, footprint), _visible(0.004, footprint)
    if broad > 0:
        mix += 0.8 * broad * (_noise(2.5 * x, 45 * y, 45 * z, seed + 9) - 0.5)
    if fine > 0:
        mix += 0.5 * fine * (_noise(5 * x, 260 * y, 260 * z, seed + 7) - 0.5)
    return float(mix)


@njit(cache=True, nogil=True)
def _landscape(row: Float32, u: float, v: float, seed: int) -> tuple[float, float, float]:
    """Return the linear RGB color of a painted landscape with u and v in [0, 1].

    `row` is the row of the material table.
    """
    sun_u, sun_v = 0.25 + 0.5 * _lattice(1, 2, 3, seed), 0.6 + 0.15 * _lattice(3, 2, 1, seed)
    glow = np.exp(-8 * ((u - sun_u) ** 2 + (v - sun_v) ** 2))
    disc = 1 - _step(0.055, 0.07, np.sqrt((u - sun_u) ** 2 + 0.6 * (v - sun_v) ** 2))
    r = 0.30 * (1 - v) + 0.55 * glow + 0.5 * disc + row[1] * 0.6
    g = 0.35 * v + 0.30 * glow + 0.45 * disc + row[2] * 0.5
    b = 0.55 * v + 0.08 * glow + 0.2 * disc + row[3] * 0.4
    for ridge in range(3):
        crest = 0.62 - 0.2 * ridge + 0.22 * (_noise(3 * u + 9 * ridge, 0.5, 0.5, seed) - 0.5)
        crest += 0.06 * (_noise(14 * u, 0.5, 0.5, seed + ridge) - 0.5)
        inside = 1 - _step(crest - 0.008, crest + 0.008, v)
        shade = (0.75 - 0.2 * ridge) * (0.8 + 0.4 * _noise(20 * u, 20 * v, ridge, seed))
        r += inside * (shade * row[4] - r)
        g += inside * (shade * row[5] - g)
        b += inside * (shade * row[6] - b)
    return r, g, b


@njit(cache=True, nogil=True)
def _cloth(x: float, y: float, z: float, footprint: float, seed: int) -> float:
    """Return the brightness factor of woven threads."""
    return 1.0 + float(0.2 * _fractal(x, y, z, 0.012, 2, footprint, seed))


@njit(cache=True, nogil=True)
def _planks(x: float, y: float, width: float, footprint: float, seed: int) -> tuple[float, float]:
    """Return the color mix and brightness factor of a plank floor."""
    length, gap = 1.1, 0.004
    board = np.int64(np.floor(y / width))
    shift = _lattice(board, 3, 5, seed)
    tone = _lattice(board, np.int64(np.floor(x / length + shift)), 1, seed)
    along = _line(x / length + shift, gap / length, footprint / length)
    joint = max(_line(y / width, gap / width, footprint / width), along)
    mix = _wood(x + 7 * tone, y + 3 * tone, tone * 5, 0.05, footprint, seed)
    return mix, (0.78 + 0.40 * tone) * (1.0 - 0.6 * joint)


@njit(cache=True, nogil=True)
def _tiles(x: float, y: float, side: float, footprint: float, seed: int) -> tuple[float, float]:
    """Return the color mix and brightness factor of square tiles."""
    i, j = np.int64(np.floor(x / side)), np.int64(np.floor(y / side))
    grout = 0.006 / side
    mix = max(_line(x / side, grout, footprint / side), _line(y / side, grout, footprint / side))
    clouds = _fractal(x, y, float(i + 3 * j), 0.12, 4, footprint, seed)
    return mix, 0.88 + 0.18 * _lattice(i, j, 2, seed) + 0.10 * clouds


@njit(cache=True, nogil=True)
def _rug(x: float, y: float, scale: float, width: float, height: float, footprint: float) -> float:
    """Return the color mix of a rug with diamonds and a border."""
    edge = min(min(x, width - x), min(y, height - y))
    if edge < 0.16:
        return float(0.5 + 0.5 * np.sin(2 * np.pi * edge / 0.08))
    u, v = (x - 0.5 * width) / scale, (y - 0.5 * height) / scale
    diamond = abs(u - np.floor(u) - 0.5) + abs(v - np.floor(v) - 0.5)
    soft = footprint / scale + 0.06
    return float(_within(diamond, 0.20, 0.36, soft) + 1.0 - _step(0.10 - 0.5 * soft, 0.10 + 0.5 * soft, diamond))


@njit(cache=True, nogil=True)
def _book(u: float, v: float, soft: float) -> float:
    """Return the color mix of a book cover with u and v in [0, 1].

    `soft` is the width of the transitions, relative to the cover.
    """
    frame = _within(u, 0.07, 0.93, soft) * _within(v, 0.05, 0.95, soft)
    inner = _within(u, 0.10, 0.90, soft) * _within(v, 0.07, 0.93, soft)
    lines = _within(u, 0.18, 0.82, soft) * _within(v, 0.62, 0.86, soft) * _line(v * 12.5, 0.5, 12.5 * soft)
    emblem = _within(float(np.sqrt((u - 0.5) ** 2 + (1.4 * (v - 0.34)) ** 2)), -1.0, 0.17, soft)
    return float(frame - inner + lines + emblem)


@njit(cache=True, nogil=True)
def _wallpaper(x: float, y: float, scale: float, footprint: float) -> float:
    """Return the color mix of wallpaper with stripes and flowers."""
    u, v = x / scale, y / (1.6 * scale)
    cell = np.floor(u)
    v += 0.5 * (cell % 2)
    du, dv = u - cell - 0.5, v - np.floor(v) - 0.5
    petal = np.cos(5 * np.arctan2(dv, du)) * 0.12 + 0.22
    flower = 1 - _step(petal - 0.05, petal + 0.05, np.sqrt(du * du + dv * dv))
    stripe = _step(-0.15, 0.15, np.sin(np.pi * u))
    shown = _visible(0.5 * scale, footprint)
    return float((0.35 * stripe + 0.65 * flower) * shown + 0.3 * (1 - shown))


@njit(cache=True, nogil=True)
def _sky(u: float, v: float, seed: int) -> tuple[float, float, float]:
    """Return the linear RGB color of the view through a window, with u and v in [0, 1]."""
    line = 0.30 + 0.22 * _noise(5 * u, 0.5, 0.5, seed) + 0.08 * _noise(23 * u, 0.5, 0.5, seed)
    tree = 1 - _step(line - 0.02, line + 0.02, v)
    leaf = 0.45 + 0.4 * _noise(40 * u, 40 * v, 0.0, seed)
    cloud = 0.35 * _step(0.45, 0.8, _noise(3 * u, 5 * v, 0.0, seed + 2))
    return (
        (0.62 + cloud) * (1 - tree) + 0.22 * leaf * tree,
        (0.80 + 0.6 * cloud) * (1 - tree) + 0.36 * leaf * tree,
        (1.0 + 0.2 * cloud) * (1 - tree) + 0.14 * leaf * tree,
    )


@njit(cache=True, nogil=True)
def _screen(row: Float32, u: float, v: float, seed: int) -> tuple[float, float, float]:
    """Return the linear RGB color of a television screen, with u and v in [0, 1]."""
    r, g, b = _landscape(row, u, v, seed)
    caption = 1.0 if (0.07 < v < 0.16 and 0.06 < u < 0.55) else 0.0
    return r * (1 - caption) + 0.02 * caption, g * (1 - caption) + 0.05 * caption, b * (1 - caption) + 0.35 * caption


@njit(cache=True, nogil=True)
def surface_color(row, x, y, z, footprint):
    """Return the linear RGB color of a material at the texture coordinates x, y, z.

    `row` (14,) is the row of the material in paints.material_table.
    """
    kind, scale, width, height, seed = int(row[0]), float(row[7]), float(row[8]), float(row[9]), int(row[10])
    if kind == PAINTING:
        return _landscape(row, x / width, y / height, seed)
    if kind == SCREEN:
        return _screen(row, x / width, y / height, seed)
    if kind == SKY:
        return _sky(x / width, y / height, seed)
    mix, gain = 0.0, 1.0
    if kind == PAINT:
        mix = 0.5 + 0.5 * _fractal(x, y, z, 4 * scale, 4, footprint, seed)
        gain = 1.0 + 0.10 * _fractal(x, y, z, 0.03, 2, footprint, seed + 11)
    elif kind == WOOD:
        mix = _wood(x, y, z, scale, footprint, seed)
    elif kind == FABRIC:
        mix = 0.5 + 0.6 * _fractal(x, y, z, scale, 3, footprint, seed)
        gain = 1.0 + 0.35 * _fractal(x, y, z, 0.006, 2, footprint, seed + 5)
        gain += 0.16 * _fractal(x, y, z, 0.025, 2, footprint, seed + 6)
    elif kind == STRIPES:
        t = y / scale
        mix = max(_line(t, 0.42, footprint / scale), 0.7 * _line(t + 0.5, 0.10, footprint / scale))
        gain = _cloth(x, y, z, footprint, seed)
    elif kind == CHECKS:
        mix = 0.5 * (_line(x / scale, 0.5, footprint / scale) + _line(y / scale, 0.5, footprint / scale))
        gain = _cloth(x, y, z, footprint, seed)
    elif kind == PLANKS:
        mix, gain = _planks(x, y, scale, footprint, seed)
    elif kind == TILES:
        mix, gain = _tiles(x, y, scale, footprint, seed)
    elif kind == RUG:
        mix = _rug(x, y, scale, width, height, footprint)
        gain = _cloth(x, y, z, footprint, seed) + 0.15 * _fractal(x, y, z, 0.25, 2, footprint, seed + 3)
    elif kind == METAL:
        mix = 0.5 + 0.5 * _fractal(0.15 * x, 3 * y, 3 * z, 0.05, 3, footprint, seed)
        gain = 1.0 + 0.06 * _fractal(x, y, z, 0.3, 3, footprint, seed + 2)
    elif kind == BOOK:
        mix = _book(x / width, y / height, footprint / width)
        gain = 1.0 + 0.15 * _fractal(x, y, z, 0.02, 2, footprint, seed)
    elif kind == WALLPAPER:
        mix = _wallpaper(x, y, scale, footprint)
        gain = 1.0 + 0.10 * _fractal(x, y, z, 0.5, 4, footprint, seed)
        gain += 0.06 * _fractal(x, y, z, 0.02, 2, footprint, seed + 4)
    elif kind == LEAF:
        mix = 0.5 + 0.8 * _fractal(x, y, z, 0.05, 4, footprint, seed)
    else:  # PAGES
        mix = 0.5 + 0.5 * _visible(0.004, footprint) * np.sin(2 * np.pi * z / 0.003)
        gain = 1.0 + 0.10 * _fractal(x, y, 8 * z, 0.03, 3, footprint, seed)
    mix = min(1.0, max(0.0, mix))
    return (
        gain * (row[1] * (1 - mix) + row[4] * mix),
        gain * (row[2] * (1 - mix) + row[5] * mix),
        gain * (row[3] * (1 - mix) + row[6] * mix),
    )
