"""Random materials of homes: walls, woods, tiles, fabrics, pictures. Functions return the index of a new material."""

from __future__ import annotations

import colorsys

import numpy as np

from pansplat.data.generated.scene import SceneBuilder
from pansplat.data.generated.textures import Pattern

Color = tuple[float, float, float]


def random_color(rng: np.random.Generator, saturation: float = 0.6, dark: float = 0.1, light: float = 0.9) -> Color:
    """A linear-light colour of random hue; its sRGB brightness is between `dark` and `light`."""
    hue, value = rng.random(), rng.uniform(dark, light)
    red, green, blue = colorsys.hsv_to_rgb(hue, saturation * rng.random() ** 0.7, value)
    return red**2.2, green**2.2, blue**2.2


def shade(color: Color, factor: float) -> Color:
    """A colour multiplied by a factor."""
    red, green, blue = (min(0.95, channel * factor) for channel in color)
    return red, green, blue


def random_wood_colors(rng: np.random.Generator) -> tuple[Color, Color]:
    """A light and a dark tone of a wood."""
    hue, value = rng.uniform(0.05, 0.11), rng.uniform(0.25, 0.85)
    red, green, blue = colorsys.hsv_to_rgb(hue, rng.uniform(0.25, 0.7), value)
    base = (red**2.2, green**2.2, blue**2.2)
    return base, shade(base, rng.uniform(0.35, 0.75))


def wood(builder: SceneBuilder, size: tuple[float, float] | None = None) -> int:
    """Wood with grain; boards of that size with joints if `size` (metres) is given."""
    light, dark = random_wood_colors(builder.rng)
    if size is None:
        return builder.add_material(Pattern.PLANKS, light, dark, size=(3.0, 5.0), fraction=0.0, mottle=0.15)
    return builder.add_material(
        Pattern.PLANKS, light, dark, size=size, fraction=builder.rng.uniform(0.01, 0.04), mottle=0.15
    )


def plain(builder: SceneBuilder, saturation: float = 0.7, dark: float = 0.15, light: float = 0.9) -> int:
    """A single colour with wear."""
    mottle = builder.rng.uniform(0.05, 0.4)
    return builder.add_material(Pattern.PLAIN, random_color(builder.rng, saturation, dark, light), mottle=mottle)


def wall(builder: SceneBuilder) -> int:
    """Paint, wallpaper with stripes, bricks, tiles, plaster, panels."""
    rng = builder.rng
    base = random_color(rng, 0.08 if rng.random() < 0.5 else 0.28, 0.5, 0.97)
    kind = rng.choice(6, p=(0.36, 0.18, 0.12, 0.12, 0.14, 0.08))
    if kind == 0:
        return builder.add_material(Pattern.PLAIN, base, mottle=rng.uniform(0.1, 0.5))
    if kind == 1:
        other = shade(base, rng.uniform(0.6, 0.92))
        size = rng.uniform(0.08, 0.5)
        line, fraction = random_color(rng), rng.uniform(0.3, 0.6)
        return builder.add_material(Pattern.STRIPES, base, other, line, size=size, fraction=fraction, mottle=0.15)
    if kind == 2:
        brick = (rng.uniform(0.2, 0.5), rng.uniform(0.08, 0.2), rng.uniform(0.05, 0.15)) if rng.random() < 0.6 else base
        joint = (0.5, 0.48, 0.45)
        return builder.add_material(
            Pattern.TILES, brick, shade(brick, 0.6), joint, size=(0.24, 0.075), fraction=0.15, mottle=0.4
        )
    if kind == 3:
        size = rng.uniform(0.1, 0.4)
        return builder.add_material(
            Pattern.TILES, base, shade(base, 0.8), random_color(rng, 0.2), size=size, fraction=0.04, mottle=0.1
        )
    if kind == 4:
        size = rng.uniform(0.2, 1.2)
        return builder.add_material(Pattern.STONE, base, shade(base, rng.uniform(0.55, 0.85)), size=size, fraction=0)
    return wood(builder, (rng.uniform(0.08, 0.2), 2.6))


def floor(builder: SceneBuilder) -> int:
    """Boards, tiles, carpet, stone, terrazzo."""
    rng = builder.rng
    kind = rng.choice(5, p=(0.4, 0.24, 0.16, 0.1, 0.1))
    base = random_color(rng, 0.5, 0.25, 0.8)
    if kind == 0:
        return wood(builder, (rng.uniform(0.06, 0.22), rng.uniform(0.6, 2.2)))
    if kind == 1:
        size, joint = rng.uniform(0.15, 0.7), random_color(rng, 0.2, 0.3, 0.8)
        other = random_color(rng, 0.4, 0.15, 0.9) if rng.random() < 0.4 else shade(base, 0.75)
        return builder.add_material(
            Pattern.TILES, base, other, joint, size=size, fraction=0.03, mottle=rng.uniform(0.1, 0.8)
        )
    if kind == 2:
        size = rng.uniform(0.03, 0.3)
        return builder.add_material(Pattern.STONE, base, shade(base, 0.6), size=size, fraction=0, mottle=0.5)
    if kind == 3:
        size = rng.uniform(0.5, 1.5)
        return builder.add_material(Pattern.STONE, base, random_color(rng, 0.3), size=size, fraction=1)
    return builder.add_material(Pattern.TERRAZZO, base, random_color(rng), random_color(rng), size=0.06)


def ceiling(builder: SceneBuilder) -> int:
    """White paint, boards or square panels."""
    rng = builder.rng
    white = random_color(rng, 0.1, 0.8, 1.0)
    if rng.random() < 0.7:
        return builder.add_material(Pattern.PLAIN, white, mottle=rng.uniform(0.1, 0.4))
    if rng.random() < 0.4:
        return wood(builder, (0.12, 3.0))
    return builder.add_material(
        Pattern.TILES, white, shade(white, 0.9), (0.3, 0.3, 0.3), size=0.6, fraction=0.03, mottle=0.2
    )


def fabric(builder: SceneBuilder) -> int:
    """Plain, striped, checked or flecked fabric."""
    rng = builder.rng
    base = random_color(rng, 0.8, 0.15, 0.9)
    kind = rng.integers(4)
    if kind == 0:
        return builder.add_material(Pattern.PLAIN, base, mottle=0.5)
    if kind == 1:
        size = rng.uniform(0.04, 0.3)
        return builder.add_material(
            Pattern.STRIPES, base, random_color(rng), random_color(rng), size=size, fraction=0.5
        )
    if kind == 2:
        size = rng.uniform(0.05, 0.2)
        return builder.add_material(
            Pattern.TILES, base, random_color(rng), random_color(rng), size=size, fraction=0.2, mottle=0.9
        )
    size = rng.uniform(0.03, 0.25)
    return builder.add_material(Pattern.STONE, base, random_color(rng), size=size, fraction=0)


def picture(builder: SceneBuilder) -> int:
    """Content of a frame: a painting, a printed page or a pattern."""
    rng = builder.rng
    kind = rng.random()
    if kind < 0.65:
        return builder.add_material(Pattern.PICTURE, random_color(rng), random_color(rng), mottle=0.1)
    paper, ink = random_color(rng, 0.2, 0.7, 1.0), random_color(rng, 0.8, 0.0, 0.3)
    if kind < 0.9:
        return builder.add_material(Pattern.TEXT, paper, ink, size=(rng.uniform(0.02, 0.12), 0.1), mottle=0.1)
    return builder.add_material(
        Pattern.RUG, random_color(rng), random_color(rng), random_color(rng), size=(rng.uniform(0.02, 0.06), 0.1)
    )


def random_material(builder: SceneBuilder) -> int:
    """Any of these materials."""
    makers = (plain, plain, fabric, picture, floor, wall)
    return makers[builder.rng.integers(len(makers))](builder) if builder.rng.random() < 0.75 else wood(builder)
