"""Diagrams as SVG text: elements, and axes with round numbers. Colours are classes of report.css, light or dark."""

from __future__ import annotations

from collections.abc import Iterable
from html import escape

import numpy as np

from framework.data import Float64


def element(tag: str, *children: str, **attributes: object) -> str:
    """One element; `class_` is the attribute `class`, `stroke_width` is `stroke-width`. Children are markup."""
    named = "".join(
        f' {name.rstrip("_").replace("_", "-")}="{escape(_short(value))}"' for name, value in attributes.items()
    )
    return f"<{tag}{named}>{''.join(children)}</{tag}>"


def text(x: float, y: float, words: str, **attributes: object) -> str:
    """Text, escaped."""
    return element("text", escape(words), x=x, y=y, **attributes)


def diagram(width: float, height: float, label: str, children: Iterable[str]) -> str:
    """The whole picture; `label` says to who does not see it what it shows."""
    return element(
        "svg",
        *children,
        viewBox=f"0 0 {_short(width)} {_short(height)}",
        role="img",
        aria_label=label,
        xmlns="http://www.w3.org/2000/svg",
    )


def path(points: Float64, closed: bool = False, **attributes: object) -> str:
    """A line through points (n, 2)."""
    steps = [f"{_short(x)},{_short(y)}" for x, y in points.tolist()]
    return element("path", d=f"M{'L'.join(steps)}{'Z' if closed else ''}", **attributes) if steps else ""


def round_step(span: float, most: int) -> float:
    """The smallest of 1, 2, 5, 10, 20 ... that divides a span into at most so many parts."""
    smallest = max(span, 1e-9) / most
    power = 10.0 ** np.floor(np.log10(smallest))
    return float(next(factor * power for factor in (1, 2, 5, 10) if factor * power >= smallest * (1 - 1e-9)))


def ticks(lowest: float, highest: float, most: int) -> list[float]:
    """Round numbers in a range."""
    step = round_step(highest - lowest, most)
    return [
        float(step * k) for k in range(int(np.ceil(lowest / step - 1e-9)), int(np.floor(highest / step + 1e-9)) + 1)
    ]


def number(value: float) -> str:
    """Without needless digits, and with a thin space between thousands."""
    return f"{value:,.10g}".replace(",", "\u2009") if abs(value) >= 10_000 else f"{value:.6g}"


def _short(value: object) -> str:
    return f"{value:.2f}".rstrip("0").rstrip(".") if isinstance(value, float) else str(value)
