"""Random materials that look like those of homes: pale walls, woods, tiles, fabrics, pictures."""

from __future__ import annotations

import colorsys

import numpy as np

from pansplat.data.generated.scene import SceneBuilder
from pansplat.data.generated.textures import Pattern

Color = tuple[float, float, float]


def any_color(rng: np.random.Generator, saturation: float = 0.6, dark: float = 0.1, light: float = 0.9) -> Color:
    """A colour of any hue; display brightness from `dark` to `light`, given as linear light."""
    hue, value = rng.random(), rng.uniform(dark, light)
    red, green, blue = colorsys.hsv_to_rgb(hue, saturation * rng.random() ** 0.7, value)
    return red**2.2, green**2.2, blue**2.2


def shade(color: Color, factor: float) -> Color:
    """A lighter or darker kind of a colour."""
    red, green, blue = (min(0.95, channel * factor) for channel in color)
    return red, green, blue


def wood_colors(rng: np.random.Generator) -> tuple[Color, Color]:
    """Two tones of one wood."""
    hue, value = rng.uniform(0.05, 0.11), rng.uniform(0.25, 0.85)
    red, green, blue = colorsys.hsv_to_rgb(hue, rng.uniform(0.25, 0.7), value)
    base = (red**2.2, green**2.2, blue**2.2)
    return base, shade(base, rng.uniform(0.35, 0.75))


def wood(build: SceneBuilder, size: tuple[float, float] | None = None) -> int:
    """Boards with grain; furniture without joints unless a size is given."""
    light, dark = wood_colors(build.rng)
    if size is None:
        return build.look(Pattern.PLANKS, light, dark, size=(3.0, 5.0), share=0.0, mottle=0.15)
    return build.look(Pattern.PLANKS, light, dark, size=size, share=build.rng.uniform(0.01, 0.04), mottle=0.15)


def plain(build: SceneBuilder, saturation: float = 0.7, dark: float = 0.15, light: float = 0.9) -> int:
    """One colour with wear."""
    mottle = build.rng.uniform(0.05, 0.4)
    return build.look(Pattern.PLAIN, any_color(build.rng, saturation, dark, light), mottle=mottle)


def wall(build: SceneBuilder) -> int:
    """Paint, wallpaper with stripes, bricks, tiles, plaster, panels."""
    rng = build.rng
    base = any_color(rng, 0.08 if rng.random() < 0.5 else 0.28, 0.5, 0.97)
    kind = rng.choice(6, p=(0.36, 0.18, 0.12, 0.12, 0.14, 0.08))
    if kind == 0:
        return build.look(Pattern.PLAIN, base, mottle=rng.uniform(0.1, 0.5))
    if kind == 1:
        other = shade(base, rng.uniform(0.6, 0.92))
        size = rng.uniform(0.08, 0.5)
        return build.look(
            Pattern.STRIPES, base, other, any_color(rng), size=(size, size), share=rng.uniform(0.3, 0.6), mottle=0.15
        )
    if kind == 2:
        brick = (rng.uniform(0.2, 0.5), rng.uniform(0.08, 0.2), rng.uniform(0.05, 0.15)) if rng.random() < 0.6 else base
        joint = (0.5, 0.48, 0.45)
        return build.look(Pattern.TILES, brick, shade(brick, 0.6), joint, size=(0.24, 0.075), share=0.15, mottle=0.4)
    if kind == 3:
        size = rng.uniform(0.1, 0.4)
        return build.look(
            Pattern.TILES, base, shade(base, 0.8), any_color(rng, 0.2), size=(size, size), share=0.04, mottle=0.1
        )
    if kind == 4:
        size = rng.uniform(0.2, 1.2)
        return build.look(Pattern.STONE, base, shade(base, rng.uniform(0.55, 0.85)), size=(size, size), share=0)
    return wood(build, (rng.uniform(0.08, 0.2), 2.6))


def floor(build: SceneBuilder) -> int:
    """Boards, tiles, carpet, stone, terrazzo."""
    rng = build.rng
    kind = rng.choice(5, p=(0.4, 0.24, 0.16, 0.1, 0.1))
    base = any_color(rng, 0.5, 0.25, 0.8)
    if kind == 0:
        return wood(build, (rng.uniform(0.06, 0.22), rng.uniform(0.6, 2.2)))
    if kind == 1:
        size, joint = rng.uniform(0.15, 0.7), any_color(rng, 0.2, 0.3, 0.8)
        other = any_color(rng, 0.4, 0.15, 0.9) if rng.random() < 0.4 else shade(base, 0.75)
        return build.look(
            Pattern.TILES, base, other, joint, size=(size, size), share=0.03, mottle=rng.uniform(0.1, 0.8)
        )
    if kind == 2:
        size = rng.uniform(0.03, 0.3)
        return build.look(Pattern.STONE, base, shade(base, 0.6), size=(size, size), share=0, mottle=0.5)
    if kind == 3:
        size = rng.uniform(0.5, 1.5)
        return build.look(Pattern.STONE, base, any_color(rng, 0.3), size=(size, size), share=1)
    return build.look(Pattern.TERRAZZO, base, any_color(rng), any_color(rng), size=(0.06, 0.06))


def ceiling(build: SceneBuilder) -> int:
    """Mostly white paint; sometimes boards or square panels."""
    rng = build.rng
    white = any_color(rng, 0.1, 0.8, 1.0)
    if rng.random() < 0.7:
        return build.look(Pattern.PLAIN, white, mottle=rng.uniform(0.1, 0.4))
    if rng.random() < 0.4:
        return wood(build, (0.12, 3.0))
    return build.look(Pattern.TILES, white, shade(white, 0.9), (0.3, 0.3, 0.3), size=(0.6, 0.6), share=0.03, mottle=0.2)


def fabric(build: SceneBuilder) -> int:
    """Covers of seats and beds: plain, striped, checked, flecked."""
    rng = build.rng
    base = any_color(rng, 0.8, 0.15, 0.9)
    kind = rng.integers(4)
    if kind == 0:
        return build.look(Pattern.PLAIN, base, mottle=0.5)
    if kind == 1:
        size = rng.uniform(0.04, 0.3)
        return build.look(Pattern.STRIPES, base, any_color(rng), any_color(rng), size=(size, size), share=0.5)
    if kind == 2:
        size = rng.uniform(0.05, 0.2)
        return build.look(Pattern.TILES, base, any_color(rng), any_color(rng), size=(size, size), share=0.2, mottle=0.9)
    size = rng.uniform(0.03, 0.25)
    return build.look(Pattern.STONE, base, any_color(rng), size=(size, size), share=0)


def picture(build: SceneBuilder) -> int:
    """What hangs in frames: paintings, printed pages, patterns."""
    rng = build.rng
    kind = rng.random()
    if kind < 0.65:
        return build.look(Pattern.PICTURE, any_color(rng), any_color(rng), mottle=0.1)
    paper, ink = any_color(rng, 0.2, 0.7, 1.0), any_color(rng, 0.8, 0.0, 0.3)
    if kind < 0.9:
        return build.look(Pattern.TEXT, paper, ink, size=(rng.uniform(0.02, 0.12), 0.1), mottle=0.1)
    return build.look(Pattern.RUG, any_color(rng), any_color(rng), any_color(rng), size=(rng.uniform(0.02, 0.06), 0.1))


def anything(build: SceneBuilder) -> int:
    """A material for things of any kind."""
    makers = (plain, plain, fabric, picture, floor, wall)
    return makers[build.rng.integers(len(makers))](build) if build.rng.random() < 0.75 else wood(build)
