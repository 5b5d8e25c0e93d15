"""Procedural pictures for the walls: landscapes in brush strokes, and a poster with text."""

from __future__ import annotations

import math
from pathlib import Path

import numpy as np
from PIL import Image, ImageDraw, ImageFont

Tone = tuple[int, int, int]

# Colours of the upper sky, the sky above the horizon, the sun, and the far, middle and near ground.
_PALETTES = {
    "evening": (
        (64, 88, 140), (244, 178, 110), (255, 232, 170), ((122, 96, 128), (96, 84, 70), (74, 92, 44)),
    ),
    "morning": (
        (112, 164, 200), (244, 226, 190), (255, 250, 220), ((120, 148, 160), (96, 132, 84), (150, 158, 62)),
    ),
    "sea": (
        (40, 96, 150), (236, 214, 190), (255, 244, 210), ((46, 104, 130), (32, 88, 118), (196, 168, 116)),
    ),
}  # fmt: skip


def _ridge(rng: np.random.Generator, width: int, base: float, height: float, roughness: float) -> np.ndarray:
    """A skyline as a sum of sines with decreasing amplitudes, in pixels from the top."""
    x = np.linspace(0, 1, width)
    line = np.zeros(width)
    for octave in range(1, 8):
        line += np.sin(2 * math.pi * (octave * 1.3 * x + rng.uniform())) * roughness ** (octave - 1)
    return base - height * line


def _stroke_over(base: Image.Image, rng: np.random.Generator) -> Image.Image:
    """Repaint an image with short strokes, from broad to fine."""
    width, height = base.size
    source = np.asarray(base).astype(np.int64)
    canvas = base.copy()
    draw = ImageDraw.Draw(canvas)
    for length, thickness, count in ((70, 16, 2500), (38, 9, 6000), (20, 5, 16000)):
        length, thickness = length * width / 1024, max(2, int(thickness * width / 1024))
        for x, y, tilt, *shift in rng.random((count, 6)):
            x, y = x * width, y * height
            tone = source[min(int(y), height - 1), min(int(x), width - 1)]
            tone = np.clip(tone + (np.array(shift) - 0.5) * 46, 0, 255).astype(int)
            angle = (tilt - 0.5) * 0.9 + 0.35 * math.sin(3 * x / width) + (0.9 if y > 0.7 * height else 0.0)
            dx, dy = math.cos(angle) * length / 2, math.sin(angle) * length / 2
            draw.line((x - dx, y - dy, x + dx, y + dy), fill=tuple(tone), width=thickness)
    return canvas


def landscape(seed: int, width: int, height: int, palette: str = "evening") -> Image.Image:
    """Hills with poplars, or a sea with sails, below a low sun. Palettes: evening, morning, sea."""
    rng = np.random.default_rng(seed)
    top, low, sun, hills = _PALETTES[palette]
    t = np.linspace(0, 1, height)[:, None, None] ** 0.8
    picture = np.array(top) * (1 - t) + np.array(low) * t
    picture = np.broadcast_to(picture, (height, width, 3)).copy()
    yy, xx = np.mgrid[0:height, 0:width]
    center = (rng.uniform(0.25, 0.75) * width, 0.42 * height)
    glow = np.exp(-np.hypot(xx - center[0], yy - center[1]) / (0.10 * width))[..., None]
    picture = picture * (1 - glow) + np.array(sun) * glow
    for k, (tone, base) in enumerate(zip(hills, (0.55, 0.66, 0.8), strict=True)):
        rough = 0.15 if palette == "sea" and k < 2 else 0.55
        line = _ridge(rng, width, base * height, 0.05 * height * (0.3 if palette == "sea" else 1), rough)
        shade = 0.75 + 0.5 * rng.random((height, width, 1))
        picture = np.where((yy > line[None, :])[..., None], np.array(tone) * shade, picture)
    image = Image.fromarray(picture.clip(0, 255).astype(np.uint8))
    draw = ImageDraw.Draw(image)
    for _ in range(9 if palette != "sea" else 0):
        x, foot = rng.uniform(0, width), rng.uniform(0.66, 0.9) * height
        tall = rng.uniform(0.12, 0.3) * height * (foot / height)
        dark = tuple(int(c * rng.uniform(0.35, 0.6)) for c in hills[-1])
        draw.ellipse((x - tall * 0.14, foot - tall, x + tall * 0.14, foot), fill=dark)
    for _ in range(5 if palette == "sea" else 0):
        x, y, s = (rng.uniform(0.05, 0.95) * width, rng.uniform(0.6, 0.74) * height, rng.uniform(0.02, 0.06) * width)
        draw.polygon([(x, y - 2 * s), (x, y), (x + s, y)], fill=(250, 246, 236))
        hull = [(x - s, y + 3), (x + s * 1.1, y + 3), (x + s * 0.6, y + s * 0.4), (x - s * 0.6, y + s * 0.4)]
        draw.polygon(hull, fill=(90, 40, 34))
    return _stroke_over(image, rng)


def poster(width: int, height: int, title: str, lines: tuple[str, ...], paper: Tone, ink: Tone) -> Image.Image:
    """A poster with a Fibonacci lattice on a sphere above text, which shows if the room is mirrored."""
    image = Image.new("RGB", (width, height), paper)
    draw = ImageDraw.Draw(image)
    cx, cy, radius = width / 2, height * 0.36, width * 0.34
    draw.ellipse((cx - radius, cy - radius, cx + radius, cy + radius), fill=tuple(int(0.8 * c) for c in paper))
    count = 420
    for j in range(count):
        z = 1 - 2 * (j + 0.5) / count
        angle = j * math.pi * (3 - math.sqrt(5))
        x, y = math.sqrt(1 - z * z) * math.cos(angle), math.sqrt(1 - z * z) * math.sin(angle)
        if y > 0:
            size = radius * 0.045 * (0.4 + y)
            tone = (ink, (196, 78, 52), (222, 160, 60))[j % 3]
            px, py = cx + x * radius, cy + z * radius
            draw.ellipse((px - size, py - size, px + size, py + size), fill=tone)
    draw.rectangle((width * 0.04, height * 0.03, width * 0.96, height * 0.97), outline=ink, width=width // 90)
    draw.text((cx, height * 0.74), title, fill=ink, font=ImageFont.load_default(width // 7), anchor="mm")
    for i, line in enumerate(lines):
        font = ImageFont.load_default(width // 14)
        draw.text((cx, height * (0.83 + 0.06 * i)), line, fill=ink, font=font, anchor="mm")
    return image


def paint_all(folder: Path, seed: int) -> dict[str, Path]:
    """Write the room's pictures into `folder` and return their paths by name."""
    folder.mkdir(parents=True, exist_ok=True)
    words = ("two panoramas in,", "a room to walk in")
    works = {
        "evening": landscape(seed * 10 + 1, 1280, 768, "evening"),
        "morning": landscape(seed * 10 + 2, 900, 1100, "morning"),
        "sea": landscape(seed * 10 + 3, 1100, 800, "sea"),
        "hills": landscape(seed * 10 + 4, 800, 800, "morning"),
        "coast": landscape(seed * 10 + 5, 800, 800, "sea"),
        "dusk": landscape(seed * 10 + 6, 800, 1000, "evening"),
        "poster": poster(900, 1260, "PANSPLAT", words, (238, 226, 200), (36, 62, 84)),
    }
    for name, image in works.items():
        image.save(folder / f"{name}.png")
    return {name: folder / f"{name}.png" for name in works}
