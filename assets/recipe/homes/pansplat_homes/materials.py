"""Random materials of homes: walls, woods, tiles, fabrics, pictures. Functions return the index of a new material."""

from __future__ import annotations

import colorsys

import numpy as np

from pansplat_homes.scene import SceneBuilder
from pansplat_homes.textures import Pattern

Color = tuple[float, float, float]


def random_color(rng: np.random.Generator, saturation: float = 0.6, dark: float = 0.1, light: float = 0.9) -> Color:
    """A linear-light colour of random hue; its sRGB brightness is between `dark` and `light`."""
    hue, value = rng.random(), rng.uniform(dark, light)
    red, green, blue = colorsys.hsv_to_rgb(hue, saturation * rng.random() ** 1.3, value)
    return red**2.2, green**2.2, blue**2.2


def foliage_color(rng: np.random.Generator) -> Color:
    """Green to brown, as grass, hedges and woods."""
    value = rng.uniform(0.05, 0.25)
    return value * rng.uniform(0.5, 1.1), value, value * rng.uniform(0.15, 0.5)


def shade(color: Color, factor: float) -> Color:
    """A colour multiplied by a factor."""
    red, green, blue = (min(0.95, channel * factor) for channel in color)
    return red, green, blue


def grey(value: float) -> Color:
    """A colour with three equal channels."""
    return value, value, value


def paint_color(rng: np.random.Generator) -> Color:
    """White, beige or grey, as on most walls."""
    kind = rng.choice(3, p=(0.4, 0.35, 0.25))
    hue, saturation = rng.uniform(0.06, 0.15), rng.uniform(0.0, (0.04, 0.17, 0.03)[kind])
    if kind == 2 and rng.random() < 0.4:
        hue, saturation = rng.uniform(0.3, 0.65), rng.uniform(0.0, 0.08)
    value = rng.uniform(*((0.86, 0.97), (0.74, 0.93), (0.6, 0.9))[kind])
    red, green, blue = colorsys.hsv_to_rgb(hue, saturation, value)
    return red**2.2, green**2.2, blue**2.2


def random_wood_colors(rng: np.random.Generator) -> tuple[Color, Color]:
    """A light and a dark tone of a wood, or of a grey laminate."""
    hue, value, saturation = rng.uniform(0.05, 0.11), rng.uniform(0.25, 0.85), rng.uniform(0.25, 0.7)
    if rng.random() < 0.25:
        saturation, value = rng.uniform(0.02, 0.2), rng.uniform(0.35, 0.7)
    red, green, blue = colorsys.hsv_to_rgb(hue, saturation, value)
    base = (red**2.2, green**2.2, blue**2.2)
    return base, shade(base, rng.uniform(0.35, 0.75))


def paint(builder: SceneBuilder, color: Color) -> int:
    """A single colour with hardly any texture."""
    return builder.add_material(Pattern.PLAIN, color, mottle=builder.rng.uniform(0.0, 0.06))


def trim(builder: SceneBuilder) -> int:
    """White paint, mostly; wood or another colour."""
    rng, kind = builder.rng, builder.rng.random()
    if kind < 0.25:
        return upright_wood(builder)
    value = rng.uniform(0.85, 0.98) ** 2.2 if kind < 0.94 else rng.uniform(0.1, 0.5) ** 2.2
    return paint(builder, (value, value, value * rng.uniform(0.9, 1.0)))


def frame(builder: SceneBuilder) -> int:
    """White, dark or wooden frames of windows."""
    kind = builder.rng.random()
    if kind < 0.2:
        return upright_wood(builder)
    value = builder.rng.uniform(0.02, 0.1) if kind < 0.35 else builder.rng.uniform(0.7, 0.92)
    return paint(builder, (value, value, value))


def metal(builder: SceneBuilder) -> int:
    """Steel, chrome, brass or black metal."""
    rng, value = builder.rng, builder.rng.uniform(0.2, 0.75)
    kind = rng.choice(3, p=(0.65, 0.2, 0.15))
    colors = ((value, value, 0.98 * value), (0.05, 0.05, 0.05), (value, 0.75 * value, 0.35 * value))
    return paint(builder, colors[kind])


def carpet(builder: SceneBuilder) -> int:
    """Wall-to-wall carpet: beige, grey or brown, flecked."""
    rng = builder.rng
    red, green, blue = colorsys.hsv_to_rgb(rng.uniform(0.05, 0.12), rng.uniform(0.02, 0.3), rng.uniform(0.4, 0.8))
    if rng.random() < 0.12:
        red, green, blue = colorsys.hsv_to_rgb(rng.random(), rng.uniform(0.1, 0.6), rng.uniform(0.25, 0.7))
    base, size = (red**2.2, green**2.2, blue**2.2), rng.uniform(0.012, 0.05)
    return builder.add_material(
        Pattern.STONE, base, shade(base, rng.uniform(0.5, 0.85)), size=size, fraction=0, mottle=rng.uniform(0.02, 0.12)
    )


def boards(builder: SceneBuilder) -> int:
    """A wooden floor."""
    return wood(builder, (builder.rng.uniform(0.06, 0.22), builder.rng.uniform(0.6, 2.2)))


def floor_tiles(builder: SceneBuilder) -> int:
    """Square or long floor tiles; sometimes chequered."""
    rng = builder.rng
    base = paint_color(rng) if rng.random() < 0.6 else random_color(rng, 0.4, 0.25, 0.85)
    size, joint = rng.uniform(0.15, 0.65), shade(base, rng.uniform(0.4, 0.9))
    other, mottle = shade(base, rng.uniform(0.7, 0.95)), rng.uniform(0.03, 0.45)
    if rng.random() < 0.12:
        other, mottle = random_color(rng, 0.3, 0.15, 0.9), 0.55
    sides = (size, size) if rng.random() < 0.75 else (1.9 * size, 0.9 * size)
    fraction = rng.uniform(0.003, 0.008) / size
    gloss = rng.uniform(0.1, 1.0)
    return builder.add_material(
        Pattern.TILES, base, other, joint, size=sides, fraction=fraction, mottle=mottle, gloss=gloss
    )


def wall_tiles(builder: SceneBuilder) -> int:
    """Glazed wall tiles of bathrooms and backsplashes."""
    rng = builder.rng
    base = paint_color(rng) if rng.random() < 0.75 else random_color(rng, 0.5, 0.3, 0.95)
    size = rng.uniform(0.05, 0.3)
    sides = (size, size) if rng.random() < 0.5 else (2 * size, size)
    joint = shade(base, rng.uniform(0.6, 1.1))
    return builder.add_material(
        Pattern.TILES,
        base,
        shade(base, rng.uniform(0.8, 0.97)),
        joint,
        size=sides,
        fraction=0.03,
        mottle=0.04,
        gloss=0.7,
    )


def upright_wood(builder: SceneBuilder) -> int:
    """Wood with faint upright grain, for doors and cabinets."""
    light, _ = random_wood_colors(builder.rng)
    dark, gloss = shade(light, builder.rng.uniform(0.6, 0.92)), builder.rng.uniform(0.0, 0.6)
    return builder.add_material(Pattern.PLANKS, light, dark, size=(5.0, 3.0), fraction=0.0, mottle=0.08, gloss=gloss)


def wood(builder: SceneBuilder, size: tuple[float, float] | None = None) -> int:
    """Wood with grain; boards of that size with joints if `size` (width and length, metres) is given."""
    light, dark = random_wood_colors(builder.rng)
    gloss = builder.rng.uniform(0.0, 0.8)
    if size is None:
        return builder.add_material(
            Pattern.PLANKS, light, dark, size=(3.0, 5.0), fraction=0.0, mottle=0.15, gloss=0.6 * gloss
        )
    return builder.add_material(
        Pattern.PLANKS, light, dark, size=size, fraction=builder.rng.uniform(0.01, 0.04), mottle=0.15, gloss=gloss
    )


def plain(builder: SceneBuilder, saturation: float = 0.7, dark: float = 0.15, light: float = 0.9) -> int:
    """A single colour with wear."""
    mottle = builder.rng.uniform(0.05, 0.4)
    return builder.add_material(Pattern.PLAIN, random_color(builder.rng, saturation, dark, light), mottle=mottle)


def wall(builder: SceneBuilder) -> int:
    """Light plain paint, mostly; strong colours, wallpaper with stripes, bricks, tiles, plaster, panels."""
    rng = builder.rng
    base = random_color(rng, 0.08 if rng.random() < 0.5 else 0.28, 0.5, 0.97)
    kind = rng.choice(7, p=(0.09, 0.03, 0.03, 0.02, 0.06, 0.02, 0.75))
    if kind == 6:
        return paint(builder, paint_color(rng))
    if kind == 0:
        color = random_color(rng, 0.5, 0.35, 0.9)
        return builder.add_material(Pattern.PLAIN, color, mottle=rng.uniform(0.0, 0.15))
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
        size = rng.uniform(0.03, 0.4)
        return builder.add_material(Pattern.STONE, base, shade(base, rng.uniform(0.7, 0.95)), size=size, fraction=0)
    return wood(builder, (rng.uniform(0.08, 0.2), 2.6))


def floor(builder: SceneBuilder) -> int:
    """Boards, carpet, tiles, stone, terrazzo."""
    rng = builder.rng
    kind = rng.choice(5, p=(0.42, 0.28, 0.22, 0.04, 0.04))
    if kind < 3:
        return (boards, carpet, floor_tiles)[kind](builder)
    base = paint_color(rng) if rng.random() < 0.7 else random_color(rng, 0.4, 0.2, 0.7)
    if kind == 3:
        return builder.add_material(Pattern.STONE, base, random_color(rng, 0.3), size=rng.uniform(0.5, 1.5), fraction=1)
    return builder.add_material(Pattern.TERRAZZO, base, random_color(rng, 0.3), base, size=rng.uniform(0.01, 0.03))


def ceiling(builder: SceneBuilder) -> int:
    """White paint, smooth or textured; sometimes boards or square panels."""
    rng = builder.rng
    white = random_color(rng, 0.06, 0.85, 1.0)
    kind = rng.random()
    if kind < 0.65:
        return paint(builder, white)
    if kind < 0.9:
        size = rng.uniform(0.02, 0.08)
        return builder.add_material(Pattern.STONE, white, shade(white, rng.uniform(0.8, 0.93)), size=size, fraction=0)
    if kind < 0.92:
        return wood(builder, (0.12, 3.0))
    return builder.add_material(
        Pattern.TILES, white, shade(white, 0.95), shade(white, 0.6), size=0.6, fraction=0.03, mottle=0.1
    )


def fabric(builder: SceneBuilder) -> int:
    """Plain, striped, checked or flecked fabric."""
    rng = builder.rng
    base = random_color(rng, 0.7, 0.15, 0.9)
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


def countertop(builder: SceneBuilder) -> int:
    """Laminate, stone with flecks or veins, or wood."""
    rng = builder.rng
    kind = rng.choice(4, p=(0.35, 0.35, 0.15, 0.15))
    base = paint_color(rng) if rng.random() < 0.7 else random_color(rng, 0.2, 0.1, 0.5)
    if kind == 0:
        return paint(builder, base)
    if kind == 1:
        size = rng.uniform(0.01, 0.05)
        return builder.add_material(Pattern.STONE, base, shade(base, rng.uniform(0.2, 0.7)), size=size, fraction=0)
    if kind == 2:
        other = shade(base, rng.uniform(0.3, 0.7))
        return builder.add_material(Pattern.STONE, base, other, size=rng.uniform(0.3, 0.9), fraction=1)
    return wood(builder)


def stone_wall(builder: SceneBuilder) -> int:
    """Bricks, painted bricks, stone or plaster."""
    rng = builder.rng
    red = (rng.uniform(0.2, 0.5), rng.uniform(0.08, 0.2), rng.uniform(0.05, 0.15))
    base = red if rng.random() < 0.5 else paint_color(rng)
    if rng.random() < 0.7:
        joint = shade(base, rng.uniform(0.5, 1.3))
        return builder.add_material(
            Pattern.TILES, base, shade(base, 0.6), joint, size=(0.24, 0.075), fraction=0.15, mottle=0.3
        )
    return builder.add_material(Pattern.STONE, base, shade(base, 0.6), size=rng.uniform(0.1, 0.5), fraction=0)


def mirror(builder: SceneBuilder) -> int:
    """A mirror of silvered glass."""
    value = builder.rng.uniform(0.75, 0.92)
    return builder.add_material(Pattern.PLAIN, (value, value, value), mottle=0, mirror=value)
