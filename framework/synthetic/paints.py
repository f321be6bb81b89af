"""Colours and materials that rooms are furnished with, drawn at random."""

from __future__ import annotations

import colorsys
from dataclasses import replace

import numpy as np

from framework.synthetic.textures import Material, Texture

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


BLACKEST = 0.35  # mean of the sRGB of a surface from which it begins to swallow a projector's infrared light
SWALLOWED = 0.8  # share of the readings that a black surface swallows
MATTE_SCREEN = 0.75  # `dark` of a matte screen
POLISHED, GLAZED = 0.7, 0.5  # `shiny` of metal and of ceramics


def swallowed(color: Color) -> float:
    """The share of a depth camera's readings that a surface of this colour loses."""
    return SWALLOWED * max(0.0, 1 - sum(color) / 3 / BLACKEST)


def pick(rng: np.random.Generator, choices: tuple[Color, ...]) -> Color:
    return choices[int(rng.integers(len(choices)))]


def shade(color: Color, factor: float) -> Color:
    """The colour made darker (below 1) or lighter (above 1)."""
    r, g, b = (min(1.0, factor * c) for c in color)
    return r, g, b


def vivid(rng: np.random.Generator) -> Color:
    """A strong colour of any hue, for books, bags and pictures."""
    return colorsys.hsv_to_rgb(rng.uniform(), rng.uniform(0.55, 0.9), rng.uniform(0.35, 0.85))


def wood(rng: np.random.Generator) -> Material:
    first, second = WOODS[int(rng.integers(len(WOODS)))]
    tone = rng.uniform(0.9, 1.08)
    light, veins = shade(first, tone), shade(second, tone)
    return Material(Texture.WOOD, light, veins, rng.uniform(0.03, 0.06), seed=new_seed(rng), dark=swallowed(light))


def cloth(rng: np.random.Generator, color: Color | None = None) -> Material:
    """Upholstery of one colour."""
    base = pick(rng, CLOTHS) if color is None else color
    scale = rng.uniform(0.10, 0.2)
    return Material(Texture.FABRIC, base, shade(base, 0.72), scale, seed=new_seed(rng), dark=swallowed(base))


def leather(rng: np.random.Generator) -> Material:
    """Black, and polished by use."""
    color = shade((0.17, 0.16, 0.15), rng.uniform(0.7, 1.3))
    return Material(
        Texture.PAINT, color, shade(color, 0.6), 0.03, seed=new_seed(rng), dark=swallowed(color), shiny=GLAZED
    )


def patterned_cloth(rng: np.random.Generator) -> Material:
    """Bed linen: striped, checked or plain."""
    base, other = pick(rng, CLOTHS), (0.90, 0.88, 0.84)
    texture = (Texture.STRIPES, Texture.CHECKS, Texture.FABRIC)[int(rng.integers(3))]
    second = shade(base, 0.75) if texture is Texture.FABRIC else base
    first = base if texture is Texture.FABRIC else other
    return Material(texture, first, second, rng.uniform(0.10, 0.2), seed=new_seed(rng))


def paint(rng: np.random.Generator, color: Color, contrast: float = 0.90, scale: float = 0.1) -> Material:
    return Material(Texture.PAINT, color, shade(color, contrast), scale, seed=new_seed(rng), dark=swallowed(color))


def glaze(rng: np.random.Generator, color: Color, contrast: float = 0.90, scale: float = 0.1) -> Material:
    """Paint on ceramics."""
    return replace(paint(rng, color, contrast, scale), shiny=GLAZED)


def metal(rng: np.random.Generator, color: Color = (0.62, 0.63, 0.65)) -> Material:
    dark = swallowed(color)
    return Material(Texture.METAL, color, shade(color, 0.91), seed=new_seed(rng), dark=dark, shiny=POLISHED)


def picture(rng: np.random.Generator, texture: Texture, width: float, height: float, emission: float = 0.0) -> Material:
    """A painting or a screen of this size (m). No depth camera reads a glossy screen; every other screen is matte."""
    first, second, seed = vivid(rng), vivid(rng), new_seed(rng)
    dark = (1.0, MATTE_SCREEN)[seed % 2] if texture is Texture.SCREEN else 0.0
    return Material(texture, first, second, 0.1, (width, height), seed, emission, dark)


def new_seed(rng: np.random.Generator) -> int:
    """A random seed of a texture."""
    return int(rng.integers(4096))
