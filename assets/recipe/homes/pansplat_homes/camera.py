"""Photographs of generated scenes as 360-degree cameras take them: exposure, tone, lenses, stitching, tripod, JPEG.

`photograph` turns linear light into 8-bit sRGB. Lenses, seams, tone curve and tripod are those of one camera and are
equal in all views of a tour; exposure, white balance, rotation and noise differ between the views.
"""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass, fields
from functools import lru_cache
from typing import Any, NamedTuple

import cv2
import numba
import numpy as np
from numpy.typing import NDArray

from pansplat.images.image_files import srgb_from_linear

Array = NDArray[Any]  # float32
Mask = NDArray[np.bool_]
Draw = Callable[[Array, Mask, float], None]
"""Draws on an image (h w 3) and its mask (h w), in place, given the height of the camera in metres."""

_EXPONENTS = -14, 6  # of 2: darkest and brightest light of the tone table; 1 is display white without tone mapping
_LEAST_LIGHT, _MAX_LIGHT = 2.0 ** _EXPONENTS[0], 2.0 ** _EXPONENTS[1]
_STEPS = 64  # entries of the tone table per octave
_REDUCTION = 4  # factor by which images are reduced for wide blurs
_JPEG = (cv2.IMWRITE_JPEG_QUALITY, cv2.IMWRITE_JPEG_SAMPLING_FACTOR)
_SUBSAMPLING = (cv2.IMWRITE_JPEG_SAMPLING_FACTOR_420, cv2.IMWRITE_JPEG_SAMPLING_FACTOR_444)


@dataclass(frozen=True)
class CameraEffects:
    """Strengths of the effects of `photograph`: mostly the largest value of a random one.

    Zero or None switches an effect off; `NO_EFFECTS` has all off. "Relative" is a fraction of 1.
    """

    grey: tuple[float, float] | None = (0.14, 0.38)  # light to which exposure maps a tour's metered light; None: kept
    exposure_stops: float = 0.7  # difference of exposure between two views of a tour, apart from `room_stops`
    room_stops: float | None = 1.25  # difference of an exposed view's metered light from its tour's; None: no limit
    tour_white_balance: float = 0.15  # relative error of a tour's red and blue gains, more often warm than cold
    view_white_balance: float = 0.04  # relative deviation of a view's red and blue gains from those of its tour
    flare: float = 0.08  # fraction of the light that the lens scatters: bloom around windows and lamps, and a veil
    local_contrast: float = 0.65  # compression of the contrast between regions; 1 makes all regions equal
    gamma: float = 0.12  # relative deviation of the tone curve's exponent from sRGB
    shoulder: float = 0.6  # part of the tone curve, from white down, that compresses highlights instead of clipping
    contrast: float = 0.35  # strength of an S-shaped tone curve, with either sign; below 1
    saturation: float = 0.35  # relative change, more often up than down
    pale_probability: float = 0.03  # that a tour is almost grey
    vignetting: float = 0.25  # relative loss of light at the seams between lenses
    lens_exposure: float = 0.05  # relative deviation of one lens's exposure
    seam_softness: float = 0.4  # fraction of fine detail that is lost near the seams
    softness: float = 0.2  # fraction of fine detail that is lost everywhere
    sharpening: float = 1.2  # gain of fine detail by sharpening, which makes halos
    seam_shift_degrees: float = 1.0  # misalignment of the images of two lenses at their seam
    pose_degrees: float = 0.3  # rotation of a view against its pose
    nadir_probability: float = 0.85  # that a tripod, patch or cap covers the nadir of a tour
    zenith_probability: float = 0.12  # that a patch or cap covers the zenith of a tour
    cap_degrees: float = 25.0  # radius of patches and caps around the poles
    operator_probability: float = 0.04  # that a person stands below and behind the camera in all views of a tour
    noise: float = 0.008  # standard deviation at mid-grey, of 1
    jpeg_quality: tuple[int, int] | None = (60, 98)  # range, with quantisation to 8 bits and often chroma subsampling


_NONE_IS_OFF = ("grey", "room_stops", "jpeg_quality")
_OFF: dict[str, Any] = {f.name: None if f.name in _NONE_IS_OFF else 0.0 for f in fields(CameraEffects)}
NO_EFFECTS = CameraEffects(**_OFF)


class Photographs(NamedTuple):
    """Photographs of one tour.

    Attributes:
        images: (view h w 3) float32, sRGB in [0, 1].
        masks: (view h w), False where something fixed to the camera hides the scene. Blurred poles count as scene.
        exposures: (view), factors from light to exposed light.
    """

    images: Array
    masks: Mask
    exposures: NDArray[np.float64]


def photograph(
    light: Array, depth: Array, rng: np.random.Generator, effects: CameraEffects = CameraEffects()
) -> Photographs:
    """Photographs of the views of one tour.

    Args:
        light: (view h w 3) float32, linear light, equirectangular.
        depth: (view h w), radial depth in metres, 0 where unknown; the camera's height and the operator's visibility
            follow from it.
        rng: supplies all random numbers; equal states give equal photographs.
        effects: strengths.
    """
    height = light.shape[1]
    exposed, exposures = _expose(light, rng, effects)
    lenses = _sample_lenses(height, rng, effects)
    exposed = _warp(exposed, lenses, rng, effects)
    exposed = _scatter(exposed, rng, effects)
    images = _develop(exposed, lenses, rng, effects)
    masks = np.ones(light.shape[:3], dtype=bool)
    _add_operator(images, masks, depth, rng, effects)
    _cover_poles(images, masks, depth, rng, effects)
    images = _sharpen(images, lenses, rng, effects)
    return Photographs(_compress(images, rng, effects), masks, exposures)


# ---- exposure and white balance


def _expose(light: Array, rng: np.random.Generator, effects: CameraEffects) -> tuple[Array, NDArray[np.float64]]:
    """Light times the exposure and white balance of each view, and the exposures."""
    views = len(light)
    quantile, adaptation = rng.uniform(0.4, 0.7), rng.random()
    luminance = light[:, ::2, ::2] @ np.full(3, 1 / 3, np.float32)
    metered = np.quantile(luminance.reshape(views, -1), quantile, axis=1, method="nearest").clip(1e-6, 1e6)
    middle = np.exp(np.log(metered).mean())
    brightness = np.log2(metered / middle)
    stops = rng.normal(0, 0.15 * adaptation, views) - adaptation * brightness
    stops = np.clip(stops - stops.mean(), -effects.exposure_stops / 2, effects.exposure_stops / 2)
    if effects.room_stops is not None:
        stops = np.clip(brightness + stops, -effects.room_stops, effects.room_stops) - brightness
    exposures = 2**stops
    grey = rng.uniform()
    if effects.grey is not None:
        exposures *= (effects.grey[0] + grey * (effects.grey[1] - effects.grey[0])) / middle
    tour = rng.uniform((-0.5, -1), (1, 0.5)) * effects.tour_white_balance
    balance = np.ones((views, 3))
    balance[:, (0, 2)] = 1 + tour + rng.uniform(-1, 1, (views, 2)) * effects.view_white_balance
    gains = (exposures[:, None] * balance).astype(np.float32)
    with np.errstate(over="ignore"):
        return np.clip(light * gains[:, None, None], 0, _MAX_LIGHT), exposures


# ---- lenses, seams and pose


class _Lenses(NamedTuple):
    """Maps of one camera: relative exposure (h w), loss of detail (h w), shifts in azimuth and latitude (h w 2)."""

    exposure: Array | None
    softness: Array | None
    shift: Array | None


def _sample_lenses(height: int, rng: np.random.Generator, effects: CameraEffects) -> _Lenses:
    """A camera with two fisheye lenses, or a rotating camera with four to six sectors. Seams are meridians."""
    count = 2 if rng.random() < 0.6 else int(rng.integers(4, 7))
    azimuth = (np.arange(2 * height) + 0.5) * np.pi / height
    latitude = np.pi / 2 - (np.arange(height) + 0.5)[:, None] * np.pi / height
    seams = rng.uniform(0, 2 * np.pi) + (np.arange(count) + rng.uniform(-0.05, 0.05, count)) * 2 * np.pi / count
    offset = (azimuth - seams[:, None] + np.pi) % (2 * np.pi) - np.pi  # (seam column), radians
    distance = np.abs(np.cos(latitude) * np.sin(np.abs(offset).min(axis=0)))  # sine of the angle to the nearest seam

    vignetting, width = rng.uniform(0, effects.vignetting), np.sin(np.pi / count) * rng.uniform(0.3, 0.8)
    hard = rng.uniform(-1, 1, count)[((azimuth - seams[:, None]) % (2 * np.pi)).argmin(axis=0)]
    blend = np.exp(-((np.radians(rng.uniform(0.5, 8.0)) * np.arange(height + 1)) ** 2) / 2)
    lens = 1 + effects.lens_exposure * np.fft.irfft(np.fft.rfft(hard) * blend, 2 * height)
    exposure = None
    if effects.vignetting or effects.lens_exposure:
        exposure = ((1 - vignetting * np.exp(-((distance / width) ** 2))) * lens).astype(np.float32)

    width, loss = np.sin(np.radians(rng.uniform(5, 20))), rng.uniform(0, effects.seam_softness)
    softness = (loss * np.exp(-((distance / width) ** 2))).astype(np.float32) if effects.seam_softness else None

    decay, torn = np.radians(rng.uniform(3, 12)), rng.random() < 0.3
    profile = np.sign(offset) / 2 * np.exp(-np.abs(offset) / decay) if torn else np.exp(-((offset / decay) ** 2))
    amplitude = np.radians(effects.seam_shift_degrees) * rng.uniform(0, 1) ** 1.5
    along = rng.uniform(-1, 1, (2, 2, count)) * np.array(((1.0,), (0.5,)))[:, None] / 2
    waves = along[:, 0, None] + along[:, 1, None] * np.sin(2 * latitude + rng.uniform(0, 2 * np.pi, count))
    shift = None
    if effects.seam_shift_degrees:
        shift = np.ascontiguousarray(np.moveaxis(amplitude * waves @ profile, 0, -1), dtype=np.float32)
    return _Lenses(exposure, softness, shift)


def _warp(light: Array, lenses: _Lenses, rng: np.random.Generator, effects: CameraEffects) -> Array:
    """Light of views that are slightly rotated, with the misalignment of the seams."""
    tour = rng.uniform(0, 1)
    if not effects.pose_degrees and lenses.shift is None:
        return light
    height, width = light.shape[1:3]
    shift = np.zeros((height, width, 2), np.float32) if lenses.shift is None else lenses.shift
    sines, margin = _sines(height), 3 + int(np.abs(shift).max() * height / np.pi)
    warped, coordinates = np.empty_like(light), np.empty((2, height, width), np.float32)
    columns, rows = coordinates
    for image, out in zip(light, warped, strict=True):
        axis = rng.normal(size=3)
        angle = np.radians(effects.pose_degrees) * tour * rng.uniform(0, 1)
        rotation = cv2.Rodrigues(axis / np.linalg.norm(axis) * angle)[0].astype(np.float32)
        _source_coordinates(rotation, sines, shift, margin, coordinates)
        cv2.remap(
            _wrap_columns(image, margin), columns, rows, cv2.INTER_CUBIC, dst=out, borderMode=cv2.BORDER_REPLICATE
        )
    return np.clip(warped, 0, _MAX_LIGHT, out=warped)


@lru_cache(maxsize=4)
def _sines(height: int) -> tuple[Array, Array, Array, Array]:
    """Sine and cosine of the latitudes (h) and azimuths (2 h) of the pixels; azimuth 0 is the image centre."""
    latitude = np.pi / 2 - (np.arange(height) + 0.5) * np.pi / height
    azimuth = (np.arange(2 * height) + 0.5) * np.pi / height - np.pi
    tables = np.sin(latitude), np.cos(latitude), np.sin(azimuth), np.cos(azimuth)
    return tuple(table.astype(np.float32) for table in tables)  # type: ignore[return-value]


@numba.njit(cache=True, fastmath=True)
def _source_coordinates(rotation, sines, shift, margin, out):  # type: ignore[no-untyped-def]  # pragma: no cover
    """Write columns and rows (2 h w) of the pixels in the unrotated image, which is wrapped by `margin` columns."""
    sin_latitude, cos_latitude, sin_azimuth, cos_azimuth = sines
    height, width = out.shape[1:]
    scale = np.float32(height / np.pi)
    for i in range(height):
        for j in range(width):
            x, y, z = cos_latitude[i] * sin_azimuth[j], -sin_latitude[i], cos_latitude[i] * cos_azimuth[j]
            u = rotation[0, 0] * x + rotation[0, 1] * y + rotation[0, 2] * z
            v = rotation[1, 0] * x + rotation[1, 1] * y + rotation[1, 2] * z
            w = rotation[2, 0] * x + rotation[2, 1] * y + rotation[2, 2] * z
            azimuth = np.arctan2(u, w) + shift[i, j, 0]
            colatitude = np.arctan2(np.sqrt(u * u + w * w), -v) - shift[i, j, 1]
            out[0, i, j] = azimuth * scale + np.float32(width / 2 - 0.5 + margin)
            out[1, i, j] = colatitude * scale - np.float32(0.5)


def _wrap_columns(image: Array, columns: int) -> Array:
    return cv2.copyMakeBorder(image, 0, 0, columns, columns, cv2.BORDER_WRAP)


def _blur(image: Array, sigma: float) -> Array:
    """Gaussian blur that wraps at +-180 degrees; `sigma` in pixels."""
    reach = min(int(4 * sigma) + 1, image.shape[1])
    blurred = cv2.GaussianBlur(_wrap_columns(image, reach), (0, 0), sigma, borderType=cv2.BORDER_REPLICATE)
    return blurred[:, reach:-reach]


def _enlarge(image: Array, height: int, width: int) -> Array:
    """The image at a larger size; interpolation wraps at +-180 degrees."""
    margin = round(2 * width / image.shape[1])
    large = cv2.resize(_wrap_columns(image, 2), (width + 2 * margin, height), interpolation=cv2.INTER_LINEAR)
    return large[:, margin : margin + width]


# ---- light to display values


def _scatter(light: Array, rng: np.random.Generator, effects: CameraEffects) -> Array:
    """Light of which a part is scattered by the lens: half of it nearby, half of it far."""
    fraction = np.float32(rng.uniform(0, 1) ** 2 * effects.flare)
    if not fraction:
        return light
    height, width = light.shape[1:3]
    out = light * (1 - fraction)
    for image, scattered in zip(light, out, strict=True):
        small = cv2.resize(image, (width // _REDUCTION, height // _REDUCTION), interpolation=cv2.INTER_AREA)
        tiny = cv2.resize(small, (16, 8), interpolation=cv2.INTER_AREA)
        halo = _blur(small, height / _REDUCTION / 40) + _enlarge(_blur(tiny, 1.5), *small.shape[:2])
        scattered += _enlarge(halo, height, width) * (fraction / 2)
    return out


def _develop(light: Array, lenses: _Lenses, rng: np.random.Generator, effects: CameraEffects) -> Array:
    """Display values of exposed light: lens exposure, noise, local tone mapping, tone curve and saturation."""
    height, width = light.shape[1:3]
    noise = rng.uniform(0, 1) ** 2 * effects.noise
    compression = effects.local_contrast * max(0.0, rng.uniform(-0.4, 1.0))
    smoothness, boost = rng.uniform(0.1, 2.0), 0.4 * compression * rng.uniform(0, 1)
    table = _tone_table(rng, effects)
    saturation = np.exp(rng.uniform(-0.6, 1) * effects.saturation)
    pale = rng.uniform(0.05, 0.4)
    if rng.random() < effects.pale_probability:
        saturation = pale
    exposure = np.ones((height, width), np.float32) if lenses.exposure is None else lenses.exposure
    out = np.empty_like(light)
    for image, display in zip(light, out, strict=True):
        grain = rng.standard_normal(image.shape, dtype=np.float32) if noise else np.zeros((1, 1, 3), np.float32)
        base = _base(image, smoothness) if compression else np.zeros((1, 1, 2), np.float32)
        settings = np.array((noise, compression, boost, saturation), np.float32)
        _develop_pixels(image, exposure, grain, base, settings, table, display)
    return out


def _base(light: Array, smoothness: float) -> Array:
    """Coefficients (h w 2) of the base layer of log2 luminance, which is smooth except at strong edges.

    Source: He and Sun, Fast Guided Filter, arXiv:1505.00996.
    """
    height, width = light.shape[:2]
    size = max(width // _REDUCTION, 16), max(height // _REDUCTION, 8)
    small = cv2.resize(light, size, interpolation=cv2.INTER_AREA)
    log = np.log2(np.maximum(small @ np.full(3, 1 / 3, np.float32), _LEAST_LIGHT))
    radius = max(size[1] // 8, 1)
    padded = cv2.copyMakeBorder(log, 0, 0, 3 * radius, 3 * radius, cv2.BORDER_WRAP)

    def mean(plane: Array) -> Array:
        return cv2.blur(plane, (2 * radius + 1, 2 * radius + 1), borderType=cv2.BORDER_REPLICATE)

    average = mean(padded)
    variance = np.maximum(mean(padded * padded) - average * average, 0)
    slope = variance / (variance + np.float32(smoothness))
    planes = np.dstack((mean(slope), mean(average * (1 - slope))))[:, 3 * radius : -3 * radius]
    return np.ascontiguousarray(_enlarge(planes, height, width))


def _tone_table(rng: np.random.Generator, effects: CameraEffects) -> Array:
    """Display values of light at `_STEPS` values per octave; the last entry is the value of more light."""
    knee = 1 - rng.uniform(0, effects.shoulder)
    exponent = np.exp(rng.uniform(-1, 1) * effects.gamma)
    contrast = rng.uniform(-1, 1) * effects.contrast
    count = (_EXPONENTS[1] - _EXPONENTS[0]) * _STEPS
    octave, step = np.divmod(np.arange(count + 1), _STEPS)
    light = np.ldexp(1 + step / _STEPS, octave + _EXPONENTS[0])
    if knee < 1:
        light = np.where(light > knee, knee + (1 - knee) * -np.expm1(np.minimum(knee - light, 0) / (1 - knee)), light)
    value = srgb_from_linear(light).astype(np.float64) ** exponent
    value += contrast * (value * value * (3 - 2 * value) - value)
    return value.astype(np.float32)


@numba.njit(cache=True, fastmath=True)
def _develop_pixels(light, exposure, grain, base, settings, table, out):  # type: ignore[no-untyped-def]  # pragma: no cover
    """Write display values of one image. `settings`: noise at mid-grey, compression, boost of detail, saturation."""
    noise, compression, boost, saturation = settings
    height, width = exposure.shape
    least, most = np.float32(_LEAST_LIGHT), np.float32(_MAX_LIGHT * (1 - 1e-6))
    for i in range(height):
        for j in range(width):
            gain = exposure[i, j]
            if compression > 0:
                luminance = gain * (light[i, j, 0] + light[i, j, 1] + light[i, j, 2]) / np.float32(3)
                log = np.log2(max(luminance, least))
                smooth = base[i, j, 0] * log + base[i, j, 1]
                anchor = np.float32(-2)  # log2 of the light that the compression keeps
                gain *= np.exp2(boost * (log - smooth) - compression * (smooth - anchor))
            luma = np.float32(0)
            for k in range(3):
                x = gain * light[i, j, k]
                if noise > 0:  # read noise, and shot noise with variance in proportion to the light
                    x += grain[i, j, k] * noise * np.sqrt(np.float32(0.1) + np.float32(4.5) * x)
                x = max(x, np.float32(0))
                if x < least:
                    value = table[0] * x / least
                else:
                    bits = np.float32(min(x, most)).view(np.int32)  # exponent and mantissa are the place in the table
                    index = (bits >> 17) - ((127 + _EXPONENTS[0]) << 6)
                    part = np.float32(bits & 0x1FFFF) * np.float32(2.0**-17)
                    value = table[index] * (1 - part) + table[index + 1] * part
                out[i, j, k] = value
                luma += value * np.float32(0.299 if k == 0 else 0.587 if k == 1 else 0.114)
            if saturation != 1:
                for k in range(3):
                    out[i, j, k] = min(max(luma + saturation * (out[i, j, k] - luma), np.float32(0)), np.float32(1))


# ---- what is fixed to the camera


class _PoleGrid(NamedTuple):
    """Rows near a pole: angle to the pole (n 1) and azimuth (w), radians; place on a plane across the axis at distance
    1 (n w 2), whose rows end at the pole."""

    angle: Array
    azimuth: Array
    plane: Array


@lru_cache(maxsize=4)
def _pole_grid(height: int) -> _PoleGrid:
    rows = int(0.26 * height)
    angle = ((np.arange(rows)[::-1] + 0.5) * np.pi / height)[:, None]
    azimuth = (np.arange(2 * height) + 0.5) * np.pi / height
    plane = np.tan(angle)[..., None] * np.stack((np.sin(azimuth), np.cos(azimuth)), axis=-1)
    return _PoleGrid(angle.astype(np.float32), azimuth.astype(np.float32), plane.astype(np.float32))


def _cover_poles(images: Array, masks: Mask, depth: Array, rng: np.random.Generator, effects: CameraEffects) -> None:
    """Draw what covers the nadir and zenith of a tour, in place."""
    kinds = ("tripod", "cap", "smear", "pixels", "ball", "logo")
    nadir = rng.choice(kinds, p=(0.5, 0.12, 0.2, 0.06, 0.04, 0.08))
    radius = np.radians(effects.cap_degrees * rng.uniform(0.3, 1, 2))
    covered = rng.random(2) < (effects.nadir_probability, effects.zenith_probability)
    zenith = nadir if nadir in ("cap", "smear") else "smear"
    for kind, size, up in ((nadir, radius[0], False), (zenith, radius[1], True)):
        if not covered[int(up)]:
            continue
        draw = _sample_cover(kind, size, images.shape[1], rng)
        for image, mask, far in zip(images, masks, depth, strict=True):
            rows = slice(None, None, -1) if up else slice(None)
            draw(image[rows], mask[rows], float(np.median(far[-2:])) or 1.5)


def _sample_cover(kind: str, radius: float, height: int, rng: np.random.Generator) -> Draw:
    """A cover around the lowest row of an image."""
    if kind == "tripod":
        return _sample_tripod(height, rng)
    grid = _pole_grid(height)
    inside = grid.angle[:, 0] < radius
    first = height - int(inside.sum())  # row of the image
    angle, plane = grid.angle[inside], grid.plane[inside]
    grey = 0.0 if rng.random() < 0.7 else rng.uniform(0.1, 0.9)
    cell = float(np.tan(radius) * rng.uniform(0.1, 0.25))
    colors = rng.uniform(0, 1, (2, 3)).astype(np.float32)
    colors[0] = rng.choice((colors[0].mean(), 0.05, 0.95))
    spokes, turns = int(rng.integers(1, 7)), rng.uniform(0.5, 3)

    def cap(image: Array, mask: Mask, camera_height: float) -> None:
        image[first:], mask[first:] = grey, False

    def smear(image: Array, mask: Mask, camera_height: float) -> None:
        ring = image[max(first - 2, 0) : first + 1].mean(axis=0)
        width = len(ring)
        sums = np.concatenate((np.zeros((1, 3)), np.cumsum(np.tile(ring, (3, 1)), axis=0)))
        reach = np.ceil((1 - angle / radius) * width / 2).astype(int) + 1
        columns = np.arange(width) + width
        image[first:] = (sums[columns + reach + 1] - sums[columns - reach]) / (2 * reach + 1)[..., None]

    def pixels(image: Array, mask: Mask, camera_height: float) -> None:
        x, y = np.moveaxis((np.floor(plane / cell) + 0.5) * cell, -1, 0)
        image[first:] = image[_pixel_at(np.arctan(np.hypot(x, y)), np.arctan2(x, y), height)]

    def ball(image: Array, mask: Mask, camera_height: float) -> None:
        away = np.pi - 2 * np.arcsin(np.minimum(np.tan(angle) / np.tan(radius), 1))  # reflected ray to the nadir
        image[first:] = 0.9 * image[_pixel_at(away * 0.98, grid.azimuth[None], height)]
        mask[first:] = False

    def logo(image: Array, mask: Mask, camera_height: float) -> None:
        distance = np.tan(angle) / np.tan(radius)
        drawn = (np.sin(spokes * grid.azimuth + 2 * np.pi * turns * distance) > 0.2) & (distance < 0.7)
        drawn |= np.abs(distance - 0.85) < 0.04
        image[first:], mask[first:] = colors[drawn.astype(int)], False

    return {"cap": cap, "smear": smear, "pixels": pixels, "ball": ball, "logo": logo}[kind]


def _pixel_at(angle: Array, azimuth: Array, height: int) -> tuple[NDArray[np.intp], NDArray[np.intp]]:
    """Rows and columns of the pixels at angles to the nadir and azimuths, radians."""
    rows = height - 1 - np.clip((angle * (height / np.pi)).astype(np.intp), 0, height - 1)
    columns = np.floor(azimuth * (height / np.pi)).astype(np.intp) % (2 * height)
    return rows, columns


def _sample_tripod(height: int, rng: np.random.Generator) -> Draw:
    """A dark head with a wavy outline, three legs or the knobs of their feet, and a shadow."""
    angle, azimuth, _ = _pole_grid(height)
    first = height - len(angle)
    monopod = rng.random() < 0.25
    start = rng.uniform(0, 2 * np.pi)
    head = np.radians(rng.uniform(2, 5) if monopod else rng.uniform(4, 13))
    bump, sharpness = head * rng.uniform(0, 1) * (not monopod), rng.uniform(0.5, 6)
    third = np.cos(3 * (azimuth - start))
    outline = head + bump * np.exp(sharpness * (third - 1))
    for wave in range(2, 9):
        outline += head * rng.normal(0, 0.12 / wave) * np.cos(wave * (azimuth + rng.uniform(0, 6.3)))
    legs = start + np.arange(3) * 2 * np.pi / 3
    spread = rng.uniform(0.2, 0.45)  # distance of the feet from the axis, metres
    has_legs, has_feet = rng.random(2) < (0.45, 0.6)
    thickness, foot = np.radians(rng.uniform(0.4, 1.2)), np.radians(rng.uniform(0.5, 1.3))
    color = (rng.uniform(0.02, 0.14) * np.array((1.1, 1, 0.92))).astype(np.float32)
    rough = np.interp(np.arange(2 * height), np.linspace(0, 2 * height, 33), np.resize(rng.normal(0, 0.25, 32), 33))
    shade = (color * (1 + rough[:, None])).clip(0, 1).astype(np.float32)
    shadow, penumbra = rng.uniform(0, 0.5), np.radians(rng.uniform(2, 8))
    pixel = np.pi / height
    sine, side = np.sin(angle), np.sin(np.abs(_turn(azimuth - legs[:, None])).min(axis=0).clip(0, np.pi / 2))

    def draw(image: Array, mask: Mask, camera_height: float) -> None:
        cover = outline - angle
        reach = np.arctan(spread / max(camera_height, 0.3))
        if not monopod and has_legs:
            cover = np.maximum(cover, np.minimum(thickness - sine * side, reach - angle))
        if not monopod and has_feet:
            cover = np.maximum(cover, foot - np.hypot(sine * side, (angle - reach) / 2))
        alpha = np.clip(cover / pixel + 0.5, 0, 1)[..., None]
        dark = 1 - shadow * np.exp(np.minimum(cover, 0) / penumbra)[..., None]
        region = image[first:]
        region *= dark * (1 - alpha)
        region += alpha * shade
        mask[first:] &= alpha[..., 0] < 0.1

    return draw


def _turn(angle: NDArray[np.float64]) -> NDArray[np.float64]:
    """Angles in [-pi, pi)."""
    return (angle + np.pi) % (2 * np.pi) - np.pi


def _add_operator(images: Array, masks: Mask, depth: Array, rng: np.random.Generator, effects: CameraEffects) -> None:
    """Draw a person who holds the camera on a stick, in place, where nothing of the scene is nearer."""
    if not rng.random() < effects.operator_probability:
        return
    height = images.shape[1]
    azimuth, away, down = rng.uniform(0, 2 * np.pi), rng.uniform(0.15, 0.6), rng.uniform(0.25, 0.6)
    colors = (rng.uniform(0.03, 0.6, (3, 1)) * rng.uniform(0.7, 1.3, (3, 3))).astype(np.float32)
    skin = np.array((0.75, 0.55, 0.42), np.float32) * rng.uniform(0.4, 1.1)
    sin_latitude, cos_latitude, sin_azimuth, cos_azimuth = _sines(height)
    across = cos_latitude[:, None] * (sin_azimuth * np.cos(azimuth) - cos_azimuth * np.sin(azimuth))
    ahead = cos_latitude[:, None] * (sin_azimuth * np.sin(azimuth) + cos_azimuth * np.cos(azimuth))
    rays = np.stack((across, np.broadcast_to(-sin_latitude[:, None], across.shape), ahead), axis=-1)
    body = (  # centre and half axes (across, down, ahead), metres, and color
        ((0, down, away), (0.08, 0.12, 0.1), skin),
        ((0, down - 0.03, away + 0.02), (0.085, 0.11, 0.1), colors[0]),
        ((0, down + 0.42, away + 0.03), (0.23, 0.32, 0.14), colors[1]),
        ((0.09, down + 1.05, away + 0.03), (0.09, 0.5, 0.1), colors[2]),
        ((-0.09, down + 1.05, away + 0.03), (0.09, 0.5, 0.1), colors[2]),
        ((0.2, down + 0.25, away - 0.1), (0.05, 0.12, 0.16), colors[1]),
    )
    nearest = np.full(across.shape, np.inf, np.float32)
    person = np.zeros((*across.shape, 3), np.float32)
    for centre, half, color in body:
        distance, normal = _hit_ellipsoid(rays, np.array(centre, np.float32), np.array(half, np.float32))
        hit = distance < nearest
        nearest[hit] = distance[hit]
        person[hit] = (color * (0.55 - 0.45 * normal[..., None]))[hit]
    for image, mask, far in zip(images, masks, depth, strict=True):
        hit = nearest < np.where(far > 0, far, np.inf)
        image[hit] = person[hit]
        mask[hit] = False


def _hit_ellipsoid(rays: Array, centre: Array, half: Array) -> tuple[Array, Array]:
    """Distances of an upright ellipsoid along rays from the origin, infinite without a hit, and the downward part of
    its unit normals."""
    direction, origin = rays / half, centre / half
    a, b = (direction * direction).sum(axis=-1), direction @ origin
    root = b * b - a * (origin @ origin - 1)
    distance = np.where((root > 0) & (b > 0), (b - np.sqrt(np.maximum(root, 0))) / a, np.inf).astype(np.float32)
    normal = (rays * np.where(np.isfinite(distance), distance, 0)[..., None] - centre) / (half * half)
    return distance, normal[..., 1] / np.linalg.norm(normal, axis=-1)


def _sharpen(images: Array, lenses: _Lenses, rng: np.random.Generator, effects: CameraEffects) -> Array:
    """Images with more or less fine detail, and less near the seams."""
    amount = rng.uniform(-effects.softness, effects.sharpening)
    sigma = rng.uniform(0.6, 1.2)
    if not amount and lenses.softness is None:
        return images
    detail = np.float32(amount) - (0 if lenses.softness is None else lenses.softness[..., None])
    out = np.empty_like(images)
    for image, sharp in zip(images, out, strict=True):
        np.subtract(image, _blur(image, sigma), out=sharp)
        sharp *= detail
        sharp += image
    return np.clip(out, 0, 1, out=out)


def _compress(images: Array, rng: np.random.Generator, effects: CameraEffects) -> Array:
    """Images after JPEG compression."""
    chance, subsampling = rng.random(), _SUBSAMPLING[int(rng.random() < 0.5)]
    if effects.jpeg_quality is None:
        return images
    low, high = effects.jpeg_quality
    quality = round(high - (high - low) * chance**3)
    out = np.empty_like(images)
    for image, decoded in zip(images, out, strict=True):
        pixels = cv2.convertScaleAbs(image, alpha=255)
        _, data = cv2.imencode(".jpg", pixels, (_JPEG[0], quality, _JPEG[1], subsampling))
        np.multiply(np.asarray(cv2.imdecode(data, cv2.IMREAD_COLOR)), np.float32(1 / 255), out=decoded)
    return out
