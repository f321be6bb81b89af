"""Materials with textures and random colors.

Colors are sRGB in [0, 1].
"""

from __future__ import annotations

import colorsys
from dataclasses import dataclass, replace
from enum import IntEnum

import numpy as np

from framework.data import Float32, Float64

Color = tuple[float, float, float]

WOODS: tuple[tuple[Color, Color], ...] = (
    ((0.78, 0.60, 0.40), (0.62, 0.43, 0.25)),  # oak
    ((0.55, 0.36, 0.22), (0.38, 0.22, 0.12)),  # walnut
    ((0.86, 0.73, 0.54), (0.74, 0.57, 0.37)),  # birch
    ((0.62, 0.33, 0.19), (0.43, 0.19, 0.10)),  # cherry
    ((0.36, 0.26, 0.20), (0.22, 0.15, 0.11)),  # wenge
)
CLOTHS: tuple[Color, ...] = (
    (0.20, 0.33, 0.50), (0.55, 0.23, 0.22), (0.30, 0.45, 0.36), (0.75, 0.60, 0.28), (0.48, 0.47, 0.46),
    (0.26, 0.50, 0.55), (0.62, 0.42, 0.50), (0.80, 0.74, 0.64), (0.72, 0.40, 0.22), (0.34, 0.28, 0.44),
)  # fmt: skip
WALLS: tuple[Color, ...] = (
    (0.87, 0.84, 0.77), (0.78, 0.84, 0.85), (0.83, 0.86, 0.78), (0.90, 0.80, 0.72), (0.82, 0.80, 0.86),
)  # fmt: skip

DARKEST = 0.35  # mean sRGB value, in [0, 1], below which a surface absorbs infrared light of the projector
ABSORBED = 0.8  # fraction of the depth readings lost on a black surface
MATTE_SCREEN = 0.75  # `dark` of a matte screen
POLISHED, GLAZED = 0.7, 0.5  # `shiny` of metal and of ceramics

EMISSION, DARK, SHINY = 11, 12, 13  # columns of material_table


class Texture(IntEnum):
    """Procedural textures."""

    PAINT = 0
    WOOD = 1
    FABRIC = 2
    STRIPES = 3
    PLANKS = 4
    TILES = 5
    RUG = 6
    PAINTING = 7
    SCREEN = 8
    METAL = 9
    BOOK = 10
    SKY = 11
    WALLPAPER = 12
    LEAF = 13
    CHECKS = 14
    PAGES = 15


@dataclass(frozen=True)
class Material:
    """The appearance of a surface."""

    texture: Texture
    color: Color
    second: Color  # second color of the pattern
    scale: float = 0.1  # m, size of the pattern
    extent: tuple[float, float] = (1.0, 1.0)  # m, width and height of a picture, such as a painting or a book cover
    seed: int = 0
    emission: float = 0.0  # emitted light, 1 = radiance of a white wall in the mean light of the room
    dark: float = 0.0  # in [0, 1], fraction of a structured-light camera's depth readings lost at all angles
    shiny: float = 0.0  # in [0, 1], fraction of the other readings lost at oblique angles (shading_kernels.GLANCED_OFF)


def material_table(materials: list[Material]) -> Float32:
    """Return the materials as a table (M, 14) for kernels.

    The columns are texture, linear color, linear second color, scale, extent, seed, emission, dark and shiny.
    """
    rows = np.zeros((len(materials), 14))
    for row, m in zip(rows, materials, strict=True):
        row[0] = m.texture
        row[1:4], row[4:7] = _to_linear(np.array(m.color)), _to_linear(np.array(m.second))
        row[7:] = m.scale, *m.extent, m.seed % 4096, m.emission, m.dark, m.shiny
    return rows.astype(np.float32)


def _to_linear(srgb: Float64) -> Float64:
    """Convert sRGB to linear light."""
    return np.where(srgb <= 0.04045, srgb / 12.92, ((srgb + 0.055) / 1.055) ** 2.4)


def absorbed(color: Color) -> float:
    """Return the fraction of depth readings that are lost on a surface with the given sRGB color."""
    return ABSORBED * max(0.0, 1 - sum(color) / 3 / DARKEST)


def pick(rng: np.random.Generator, choices: tuple[Color, ...]) -> Color:
    """Return a random element of `choices`."""
    return choices[int(rng.integers(len(choices)))]


def shade(color: Color, factor: float) -> Color:
    """Scale the brightness of a color."""
    r, g, b = (min(1.0, factor * c) for c in color)
    return r, g, b


def vivid(rng: np.random.Generator) -> Color:
    """Return a random saturated color."""
    return colorsys.hsv_to_rgb(rng.uniform(), rng.uniform(0.55, 0.9), rng.uniform(0.35, 0.85))


def wood(rng: np.random.Generator) -> Material:
    """Return a random wood material."""
    first, second = WOODS[int(rng.integers(len(WOODS)))]
    tone = rng.uniform(0.9, 1.08)
    light, veins = shade(first, tone), shade(second, tone)
    return Material(Texture.WOOD, light, veins, rng.uniform(0.03, 0.06), seed=new_seed(rng), dark=absorbed(light))


def cloth(rng: np.random.Generator, color: Color | None = None) -> Material:
    """Return plain upholstery fabric."""
    base = pick(rng, CLOTHS) if color is None else color
    scale = rng.uniform(0.10, 0.2)
    return Material(Texture.FABRIC, base, shade(base, 0.72), scale, seed=new_seed(rng), dark=absorbed(base))


def leather(rng: np.random.Generator) -> Material:
    """Return black, polished leather."""
    return glaze(rng, shade((0.17, 0.16, 0.15), rng.uniform(0.7, 1.3)), 0.6, 0.03)


def patterned_cloth(rng: np.random.Generator) -> Material:
    """Return a random fabric that is striped, checked or plain."""
    base, other = pick(rng, CLOTHS), (0.90, 0.88, 0.84)
    texture = (Texture.STRIPES, Texture.CHECKS, Texture.FABRIC)[int(rng.integers(3))]
    second = shade(base, 0.75) if texture is Texture.FABRIC else base
    first = base if texture is Texture.FABRIC else other
    return Material(texture, first, second, rng.uniform(0.10, 0.2), seed=new_seed(rng))


def paint(rng: np.random.Generator, color: Color, contrast: float = 0.90, scale: float = 0.1) -> Material:
    """Return a painted material."""
    return Material(Texture.PAINT, color, shade(color, contrast), scale, seed=new_seed(rng), dark=absorbed(color))


def glaze(rng: np.random.Generator, color: Color, contrast: float = 0.90, scale: float = 0.1) -> Material:
    """Return a glossy painted material."""
    return replace(paint(rng, color, contrast, scale), shiny=GLAZED)


def metal(rng: np.random.Generator, color: Color = (0.62, 0.63, 0.65)) -> Material:
    """Return a metal material."""
    dark = absorbed(color)
    return Material(Texture.METAL, color, shade(color, 0.91), seed=new_seed(rng), dark=dark, shiny=POLISHED)


def picture(rng: np.random.Generator, texture: Texture, width: float, height: float, emission: float = 0.0) -> Material:
    """Return the material of a painting or a screen.

    Half of the screens are glossy and have no depth readings.

    Args:
        rng: The random number generator.
        texture: The texture of the picture.
        width: The width of the picture, m.
        height: The height of the picture, m.
        emission: The emitted light, see Material.
    """
    first, second, seed = vivid(rng), vivid(rng), new_seed(rng)
    dark = (1.0, MATTE_SCREEN)[seed % 2] if texture is Texture.SCREEN else 0.0
    return Material(texture, first, second, 0.1, (width, height), seed, emission, dark)


def new_seed(rng: np.random.Generator) -> int:
    """Return a random seed for a texture."""
    return int(rng.integers(4096))
