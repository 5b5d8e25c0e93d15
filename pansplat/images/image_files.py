"""Reading panoramas, masks and depth from image files, and writing images.

Images are RGB in [0, 1] with the sRGB curve, as in JPG and PNG. EXR files hold linear light and are converted.
"""

from __future__ import annotations

import contextlib
import dataclasses
import io
import logging
import math
import struct
import warnings
from collections.abc import Iterator
from dataclasses import dataclass
from pathlib import Path
from typing import Any, Literal

import cv2
import numpy as np
import torch
from jaxtyping import Bool, Float, UInt8
from numpy import ndarray as Array
from numpy.typing import NDArray
from PIL import Image, ImageOps
from PIL.PngImagePlugin import PngInfo
from torch import Tensor

from pansplat.errors import InputError, InputWarning
from pansplat.images.blur_masks import (
    BLUR_SUFFIX,
    MASK_SUFFIX,
    blur_hidden,
    find_blur_mask,
    find_mask_beside,
    locate_panorama,
    resize_hidden,
    widen_hidden,
)
from pansplat.images.cube_images import CUBE_SUFFIX, DENSE_FACE, CubeImage
from pansplat.images.panorama_metadata import SOFTWARE_XMP, find_stated_problem, find_xmp, make_gpano_xmp
from pansplat.images.rig_images import RIG_SUFFIX, RigImage
from pansplat.system.atomic import replacing
from pansplat.system.files import SOFTWARE, read_file, require_file
from pansplat.system.strict_json import read_json

WRITABLE_SUFFIXES = (".jpg", ".jpeg", ".png", ".webp", ".exr")
READABLE_SUFFIXES = (*WRITABLE_SUFFIXES, ".tif", ".tiff")

_PILLOW_FORMATS = ("JPEG", "PNG", "WEBP", "TIFF")
_TIFF_MAGIC = (b"II*\0", b"MM\0*", b"II+\0", b"MM\0+")
_MAX_BYTES = 1 << 31  # bytes of the largest file that is read
_MAX_PIXELS = 178_956_970  # Pillow's limit: twice Image.MAX_IMAGE_PIXELS
_EXR_MAGIC = b"\x76\x2f\x31\x01"
_JPEG_MAGIC, _JPEG_END, _PNG_MAGIC = b"\xff\xd8", b"\xff\xd9", b"\x89PNG"
warnings.filterwarnings("ignore", category=Image.DecompressionBombWarning)  # panoramas of 100 megapixels are normal
logging.getLogger("PIL").setLevel(logging.CRITICAL)  # a damaged file is an error of one line
_TAIL = 4096  # bytes at the end of a file that are read to find the end of a JPEG
_ORIENTATION, _TURNED = 0x0112, (5, 6, 7, 8)  # tag of EXIF; its values for quarter turns
_ORIENT = {
    2: lambda a: a[:, ::-1], 3: lambda a: a[::-1, ::-1], 4: lambda a: a[::-1], 5: lambda a: a.swapaxes(0, 1),
    6: lambda a: np.rot90(a, -1), 7: lambda a: a[::-1, ::-1].swapaxes(0, 1), 8: lambda a: np.rot90(a),
}  # fmt: skip
_DAMAGED = (  # what Pillow raises for damaged files; InputError is a ValueError
    OSError, SyntaxError, ValueError, EOFError, TypeError, LookupError, AttributeError, ArithmeticError, AssertionError,
    RuntimeError, struct.error,
)  # fmt: skip
_BITS_PER_SAMPLE = 258  # number of the TIFF tag
_DARK_CORNER, _LIT_CIRCLE = 30, 60  # grey values: darkest corners and dimmest circles of a fisheye picture
_WRAP = 16  # pixels of the target: margin of the wrap-around at +-180 degrees for the resampling filter


@dataclass(frozen=True, eq=False)
class _DecodedImage:
    """Pixels of a file: `color` (H W 3) uint8 or float32 in [0, 1]; `alpha` (H W) in [0, 1] or None.

    Attributes:
        hole: what pixels without alpha are.
    """

    color: NDArray[Any]
    alpha: NDArray[Any] | None
    hole: str = "is transparent; these pixels are masked. Remove the alpha channel if they show the scene"


def srgb_from_linear(linear: NDArray[Any]) -> NDArray[Any]:
    """sRGB values of linear light, both in [0, 1]; values outside are clipped. Source: IEC 61966-2-1."""
    x = np.clip(linear, 0, 1)
    return np.where(x <= 0.0031308, 12.92 * x, 1.055 * np.power(x, 1 / 2.4) - 0.055).astype(np.float32)


def linear_from_srgb(srgb: NDArray[Any]) -> NDArray[Any]:
    """Linear light of sRGB values, both in [0, 1]. Source: IEC 61966-2-1."""
    x = np.clip(srgb, 0, 1)
    return np.where(x <= 0.04045, x / 12.92, ((x + 0.055) / 1.055) ** 2.4).astype(np.float32)


def read_panorama(
    path: Path | str, height: int
) -> tuple[Float[Tensor, "3 height width"], Bool[Tensor, "height width"]]:
    """A panorama at (height, 2 height), and a mask of its opaque pixels. Warns when pixels are transparent.

    The image is resampled by Pillow's Lanczos filter with wrap-around at +-180 degrees. What its blur mask hides
    (`pansplat.images.blur_masks`) is blurred before.

    Args:
        path: JPG, PNG and TIFF (8 or 16 bit), WebP or EXR file, 2:1; or a file that stands for cube faces or
            perspective pictures (pansplat.images.cube_images, .rig_images).
        height: pixels.
    """
    decoded = _decode_panorama(path, height)
    image = resize_panorama(decoded.color, height)
    if decoded.alpha is None or decoded.alpha.min() == 1:
        return image, torch.ones(height, 2 * height, dtype=torch.bool)
    opaque = _resize_plane(decoded.alpha, height, Image.Resampling.BOX) >= 0.5
    warnings.warn(
        f"{path}: {100 * (1 - opaque.mean()):.1f}% of the image {decoded.hole}.",
        category=InputWarning,
        stacklevel=2,
    )
    return image, torch.from_numpy(opaque)


def read_height(path: Path | str) -> int:
    """Height of an image file, pixels; of cube faces that of the panorama that they give. No pixels are decoded."""
    return read_size(path)[1]


def read_face_size(path: Path | str) -> int:
    """Size of a cube face that has the detail of an image file, pixels: that of the file's faces, else with as many
    pixels for an angle in its middle as the panorama, width / pi. No pixels are decoded."""
    path = Path(path)
    cube = _read_assembled(path) if is_assembled(path) else None
    return cube.levels[-1].size if isinstance(cube, CubeImage) else int(DENSE_FACE * read_height(path))


def read_size(path: Path | str) -> tuple[int, int]:
    """Width and height of an image file, pixels; see `read_height`."""
    path = Path(path)
    if is_assembled(path):
        height = _read_assembled(path).height
        return 2 * height, height
    return _read_shape(path)[:2]


def is_two_to_one(path: Path) -> bool:
    """Whether an image file has the proportions of a panorama; False if it cannot be read."""
    try:
        width, height = read_size(path)
    except InputError:
        return False
    return width == 2 * height


def _read_shape(path: Path) -> tuple[int, int, str | None]:
    """Width and height of an image file, and what it is by its metadata instead of a full panorama."""
    require_file(path, "a readable image file")
    try:
        with open(path, "rb") as file:
            head = file.read(len(_EXR_MAGIC))
        if head.startswith(_EXR_MAGIC):
            with _open_exr(path, header_only=True) as file:
                (left, top), (right, bottom) = np.array(file.header()["dataWindow"]).tolist()
            return right - left + 1, bottom - top + 1, None
        with Image.open(path, formats=_PILLOW_FORMATS) as image:
            size = image.size
            # Pillow would decode the pixels of a PNG to look for EXIF behind them, and turns the size of a TIFF itself.
            is_done = image.format == "TIFF" or (image.format == "PNG" and "exif" not in image.info)
            if not is_done and image.getexif().get(_ORIENTATION) in _TURNED:
                size = size[::-1]
            return (*size, find_stated_problem(find_xmp(image), *size))
    except (*_DAMAGED, Image.DecompressionBombError) as error:
        if isinstance(error, InputError):
            raise
        return (*_open_with_pillow(path, _read_bytes(path), load=False).size, None)  # its error names the reason


def _require_full(path: Path) -> None:
    """Check that the metadata of an image file do not state that it is no full panorama."""
    problem = _read_shape(path)[2]
    if problem is not None:
        raise InputError(f"{path}: needed a full equirectangular panorama, got {problem}.")


def is_assembled(path: Path) -> bool:
    """Whether a file stands for the cube faces or perspective pictures of a panorama."""
    return path.name.endswith((CUBE_SUFFIX, RIG_SUFFIX))


def _read_assembled(path: Path) -> CubeImage | RigImage:
    return read_json(path, RigImage if path.name.endswith(RIG_SUFFIX) else CubeImage)


def list_pictures(path: Path) -> list[Path]:
    """The image file, or those of the pictures that it stands for."""
    return list(_read_assembled(path).list_files()) if is_assembled(path) else [path]


def require_complete(path: Path | str) -> None:
    """Check that an image file is not damaged, by its structure; it is decoded only if the structure is in doubt.

    That of a JPG or WebP shows whether the file is whole, and that of a PNG has check sums. An EXR is decoded.
    """
    path = Path(path)
    require_file(path, "a readable image file")
    for file in list_pictures(path):
        if not _is_complete(file):
            _decode(file)


def require_panorama(path: Path | str) -> None:
    """Check that a file is a 2:1 image that is not damaged (`require_complete`)."""
    path = Path(path)
    if not is_assembled(path):
        _require_full(path)
    require_two_to_one(path, *read_size(path))
    require_complete(path)


def _is_complete(path: Path) -> bool:
    """Whether the structure of a JPG, PNG or WebP file is whole; False if it is in doubt."""
    try:
        with open(path, "rb") as file:
            head = file.read(12)
            size = file.seek(0, io.SEEK_END)
            file.seek(max(size - _TAIL, 0))
            tail = file.read()
        if head.startswith(_PNG_MAGIC):
            with Image.open(path, formats=("PNG",)) as image:
                image.verify()
            return True
    except (OSError, SyntaxError, ValueError, Image.DecompressionBombError):
        return False
    if head.startswith(b"RIFF"):
        return size >= 8 + int.from_bytes(head[4:8], "little")
    return head.startswith(_JPEG_MAGIC) and tail.rstrip(b"\0").endswith(_JPEG_END)


def read_thumbnail(path: Path | str, height: int) -> Float[Tensor, "3 height width"]:
    """A panorama at a small size; faster than `read_panorama`, because JPEGs are decoded at reduced size. No alpha."""
    path = Path(path)
    return resize_panorama(_decode_panorama(path, height, reduced=find_blur_mask(path) is None).color, height)


def list_masks(path: Path, *, check: bool = False) -> list[Path]:
    """The files of the blur mask and of the scene mask of a panorama."""
    place = locate_panorama(path)
    found = [find_mask_beside(place, kind) for kind in (BLUR_SUFFIX, MASK_SUFFIX)]
    masks = [mask for mask in found if mask is not None]
    for mask in masks if check else ():
        _require_fit(mask, read_size(mask), read_size(path))
        require_complete(mask)
    return masks


def _require_fit(mask: Path, size: tuple[int, int], picture: tuple[int, int]) -> None:
    """Check the proportions of a mask by its width and height, and those of its picture."""
    if abs(size[0] * picture[1] - size[1] * picture[0]) >= max(*size, *picture):  # not mere rounding
        raise InputError(
            f"{mask}: needed a mask of the proportions of its picture, {picture[0]}x{picture[1]}, got {size[0]}x"
            f"{size[1]} (width x height); draw it on the whole picture."
        )


def read_blur_mask(mask: Path, height: int) -> Bool[Array, "height width"]:
    """A blur mask at (height, 2 height), without the margin: each pixel that its white touches."""
    decoded = _decode(mask)
    _require_fit(mask, decoded.color.shape[1::-1], (2 * height, height))
    hidden = decoded.color.astype(np.float32).mean(axis=2) / (255 if decoded.color.dtype == np.uint8 else 1) >= 0.5
    if decoded.alpha is not None:
        hidden &= decoded.alpha >= 0.5
    if hidden.all():
        raise InputError(f"{mask}: needed a blur mask with black where the panorama is shown, got white only.")
    return resize_hidden(hidden, height, 2 * height)


def read_pixels(path: Path) -> UInt8[Array, "rows columns 3"]:
    """Pixels of an image file of any proportions, 8 bit, without alpha."""
    color = _decode(path).color
    return color if color.dtype == np.uint8 else np.rint(color * 255).astype(np.uint8)


def resize_panorama(pixels: NDArray[Any], height: int) -> Float[Tensor, "3 height width"]:
    """Pixels (H W 3) of a panorama, resampled to (height, 2 height) as in `read_panorama`."""
    return torch.from_numpy(_resize_color(pixels, height)).permute(2, 0, 1).contiguous()


def read_mask(path: Path | str, height: int) -> Bool[Tensor, "height width"]:
    """A mask image at (height, 2 height): True where it is white (the scene)."""
    color = _decode_panorama(path, height).color
    scale = 255.0 if color.dtype == np.uint8 else 1.0
    grey = color.astype(np.float32).mean(axis=2) / np.float32(scale)
    return torch.from_numpy(_resize_plane(grey, height, Image.Resampling.BOX) >= 0.5)


def read_depth(path: Path | str, height: int) -> Float[Tensor, "height width"]:
    """Radial depth in metres at (height, 2 height), 0 where unknown; nearest-neighbour samples.

    Args:
        path: 16-bit PNG in millimetres (0 is unknown), or EXR in metres (channel Z or Y).
        height: pixels.
    """
    path = Path(path)
    _check_height(height)
    data = _read_bytes(path)
    if data.startswith(_EXR_MAGIC):
        channels = _read_exr(path)
        name = next((n for n in ("Z", "Y") if n in channels), None)
        if name is None:
            raise InputError(f"{path}: needed depth in channel Z or Y, got channels {sorted(channels)}; rename it.")
        depth = np.asarray(channels[name], dtype=np.float32)
    else:
        image = _open_with_pillow(path, data)
        if not image.mode.startswith("I"):
            raise InputError(
                f"{path}: needed depth as a one-channel 16-bit PNG in millimetres or an EXR in "
                f"metres, got pixels of type {image.mode}; convert it."
            )
        depth = np.asarray(image).astype(np.float32) / np.float32(1000)
    require_two_to_one(path, depth.shape[1], depth.shape[0])
    depth = np.where(np.isfinite(depth) & (depth > 0), depth, np.float32(0))
    rows = ((np.arange(height) + 0.5) * depth.shape[0] / height).astype(int)
    columns = ((np.arange(2 * height) + 0.5) * depth.shape[1] / (2 * height)).astype(int)
    return torch.from_numpy(np.ascontiguousarray(depth[rows[:, None], columns[None]]))


def write_image(
    path: Path | str,
    image: Tensor | NDArray[Any],
    *,
    depth: Tensor | NDArray[Any] | None = None,
    panorama: bool | Literal["photograph"] | None = None,
) -> None:
    """Write an image atomically; the suffix selects PNG, JPG, WebP (8 bit) or EXR (linear float).

    Args:
        path: file to write.
        image: a tensor (3 H W) or an array (H W 3), sRGB in [0, 1] (clipped); an array may be uint8.
        depth: (H W) metres, written as channel Z of an EXR.
        panorama: whether the file is marked as an equirectangular panorama (GPano, in an EXR a latitude-longitude
            map); by default if it is 2:1. Other than photographs, it counts as a rendering.
    """
    path = Path(path)
    pixels = _as_pixels(path, image)
    suffix = path.suffix.lower()
    if suffix == ".exr":
        _write_exr(path, pixels, depth, panorama)
        return
    if suffix not in WRITABLE_SUFFIXES:
        raise InputError(f"cannot write {path}: needed a name ending in .png .jpg .webp or .exr; rename it.")
    if depth is not None:
        raise InputError(f"cannot write depth to {path}: needed an .exr, got '{suffix}'; change the suffix.")
    pixels = pixels if pixels.dtype == np.uint8 else np.rint(pixels.clip(0, 1) * 255).astype(np.uint8)
    options: dict[str, Any] = {"quality": 95, "subsampling": 0} if suffix in (".jpg", ".jpeg") else {}
    options = {"lossless": True} if suffix == ".webp" else options
    _encode(path, Image.fromarray(pixels), options, panorama)


def write_depth(path: Path | str, depth: Tensor | NDArray[Any], *, panorama: bool | None = None) -> None:
    """Write depth atomically as a 16-bit PNG in millimetres, as `read_depth` reads it.

    0 means no depth. Larger depths than 65.534 m are written as 65535.

    Args:
        path: file to write, ending in .png.
        depth: (H W) metres, finite.
        panorama: see `write_image`.
    """
    path = Path(path)
    metres = depth.detach().cpu().numpy() if isinstance(depth, Tensor) else np.asarray(depth)
    if path.suffix.lower() != ".png":
        raise InputError(f"cannot write {path}: needed a name ending in .png for 16-bit depth; rename it.")
    if metres.ndim != 2 or not np.isfinite(metres).all():
        raise InputError(f"cannot write {path}: needed finite depth (H W), got shape {metres.shape} or NaN values.")
    millimetres = np.rint(metres.astype(np.float64) * 1000).clip(0, 65535).astype(np.uint16)
    _encode(path, Image.fromarray(millimetres), {}, panorama, "radial depth in millimetres, 0: unknown")


def _encode(
    path: Path, image: Image.Image, options: dict[str, Any], panorama: bool | str | None, description: str = ""
) -> None:
    """Write an image by Pillow with its metadata."""
    suffix = path.suffix.lower()
    chunks = PngInfo()
    if description:
        chunks.add_text("Description", description)
    is_panorama = image.width == 2 * image.height if panorama is None else panorama
    is_photograph = panorama == "photograph"
    xmp = make_gpano_xmp(image.width, image.height, is_photograph=is_photograph) if is_panorama else SOFTWARE_XMP
    chunks.add_itxt("XML:com.adobe.xmp", xmp.decode())
    options = {"pnginfo": chunks} if suffix == ".png" else options | {"xmp": xmp}
    encoded = io.BytesIO()  # Pillow's own writing to a file misses a disk that becomes full
    image.save(encoded, Image.registered_extensions()[suffix], **options)
    with replacing(path) as temporary:
        temporary.write_bytes(encoded.getbuffer())


def _as_pixels(path: Path, image: Tensor | NDArray[Any]) -> NDArray[Any]:
    """The image as an array (H W 3), uint8 or finite float32."""
    if isinstance(image, Tensor):
        pixels = image.detach().cpu().movedim(0, -1).numpy() if image.ndim == 3 else image.detach().cpu().numpy()
    else:
        pixels = np.asarray(image)
    if pixels.ndim != 3 or pixels.shape[2] != 3 or 0 in pixels.shape:
        shape = tuple(image.shape)
        raise InputError(f"cannot write {path}: needed a tensor (3 H W) or an array (H W 3), got shape {shape}.")
    if pixels.dtype == np.uint8:
        return np.ascontiguousarray(pixels)
    pixels = np.ascontiguousarray(pixels, dtype=np.float32)
    bad = int((~np.isfinite(pixels)).sum())
    if bad:
        raise InputError(
            f"cannot write {path}: needed finite colours, got {bad} NaN or infinite values; nothing was written."
        )
    return pixels


def _write_exr(
    path: Path, pixels: NDArray[Any], depth: Tensor | NDArray[Any] | None, panorama: bool | str | None
) -> None:
    import OpenEXR

    srgb = pixels.astype(np.float32) / np.float32(255) if pixels.dtype == np.uint8 else pixels
    channels: dict[str, Any] = {"RGB": linear_from_srgb(srgb)}
    if depth is not None:
        plane = depth.detach().cpu().numpy() if isinstance(depth, Tensor) else np.asarray(depth)
        plane = np.ascontiguousarray(plane, dtype=np.float32)
        if plane.shape != pixels.shape[:2] or not np.isfinite(plane).all():
            raise InputError(
                f"cannot write {path}: needed finite depth of shape {pixels.shape[:2]}, got shape {plane.shape} with "
                f"{int((~np.isfinite(plane)).sum())} NaN or infinite values; nothing was written."
            )
        channels["Z"] = plane
    header: dict[str, Any] = {"compression": OpenEXR.ZIP_COMPRESSION, "type": OpenEXR.scanlineimage}
    header["comments"] = SOFTWARE
    if pixels.shape[1] == 2 * pixels.shape[0] if panorama is None else panorama:
        header["envmap"] = OpenEXR.ENVMAP_LATLONG
    # OpenEXR raises a RuntimeError or worse when the disk is full.
    with replacing(path, failures=(Exception,)) as temporary, OpenEXR.File(header, channels) as file:
        file.write(str(temporary))


def _check_height(height: int) -> None:
    if height < 1:
        raise InputError(f"`height` must be at least 1 pixel, got {height}; choose one, such as 512.")


def require_two_to_one(path: Path, width: int, height: int) -> None:
    """Check the proportions of a picture; the InputError says what to do with pictures of other ones."""
    if width != 2 * height:
        raise InputError(
            f"{path}: needed a 2:1 equirectangular panorama, got {width}x{height} (width x height); "
            f"{_advise_on_shape(width, height)}."
        )


def _advise_on_shape(width: int, height: int) -> str:
    """What to do with a picture of other proportions than 2:1."""
    if width == height:
        return (
            "of six cube faces, name them NAME_f NAME_r NAME_b NAME_l NAME_u NAME_d; stitch a fisheye picture with the "
            "program of its camera; of a stereo panorama give the upper half"
        )
    if width > 2 * height:
        return "pad a part of a panorama to 2:1"
    return "crop or resample it first"


def _read_bytes(path: Path) -> bytes:
    data = read_file(path, "a readable image file", limit=_MAX_BYTES)
    if not data:
        raise InputError(f"{path}: needed an image, got a file of 0 bytes; copy or export it again.")
    return data


def _decode_panorama(path: Path | str, height: int, *, reduced: bool = False) -> _DecodedImage:
    """Pixels of a panorama, blurred where its blur mask hides them.

    `reduced`: whether a JPEG may be decoded at a smaller size, of at least `height`.
    """
    path = Path(path)
    _check_height(height)
    decoded = _decode_shown(path, height, reduced=reduced)
    mask = find_blur_mask(path)
    if mask is None:
        return decoded
    hidden = widen_hidden(read_blur_mask(mask, decoded.color.shape[0]))
    if hidden.mean() > 0.5:
        warnings.warn(
            f"{mask}: {100 * hidden.mean():.0f}% of the photograph is blurred; white is blurred, black is shown.",
            category=InputWarning,
            stacklevel=3,
        )
    return dataclasses.replace(decoded, color=blur_hidden(decoded.color, hidden))


def _decode_shown(path: Path, height: int, *, reduced: bool) -> _DecodedImage:
    """Pixels of a panorama as they are."""
    if is_assembled(path):
        color, shown = _read_assembled(path).read(height, read_pixels)
        return _DecodedImage(color, shown, hole="is in no picture; these pixels are masked")
    _require_full(path)
    decoded = _decode(path, height if reduced else None)
    require_two_to_one(path, decoded.color.shape[1], decoded.color.shape[0])
    if _is_dual_fisheye(decoded.color):
        raise InputError(
            f"{path}: needed an equirectangular panorama, got a dual fisheye picture; stitch it with the program of "
            "its camera, or by ffmpeg -i IN -vf v360=dfisheye:e:ih_fov=190:iv_fov=190 OUT."
        )
    return decoded


def _is_dual_fisheye(color: NDArray[Any]) -> bool:
    """Whether a 2:1 picture shows two circles side by side on black; no panorama is black at these places only."""
    step = max(color.shape[0] // 96, 1)
    grey = color[::step, ::step].max(axis=2).astype(np.float32) * (1 if color.dtype == np.uint8 else 255)
    rows, columns = (np.arange(count) + 0.5 for count in grey.shape)
    radius = grey.shape[0] / 2
    across, down = (columns % (2 * radius) - radius) / radius, ((rows - radius) / radius)[:, None]
    distance = np.hypot(across, down)
    corners, inside = grey[distance > 1.12], grey[distance < 0.85]
    tips = grey[(np.abs(across) < 0.2) & (np.abs(down) > 0.75) & (np.abs(down) < 0.92)]  # black, too, at black poles
    if min(len(corners), len(tips)) < 16:
        return False
    return bool(np.quantile(corners, 0.95) < _DARK_CORNER and min(np.mean(inside), np.median(tips)) > _LIT_CIRCLE)


def _decode(path: Path, at_least: int | None = None) -> _DecodedImage:
    """Pixels of an image file; the format follows from the content. `at_least`: least height of a reduced JPEG."""
    data = _read_bytes(path)
    if data.startswith(_EXR_MAGIC):
        return _decode_exr(path)
    if data.startswith(_PNG_MAGIC) and len(data) > 24 and data[24] == 16:
        return _decode_deep(path, data)
    if data.startswith(_TIFF_MAGIC) and _count_tiff_bits(data) > 8:
        return _decode_deep(path, data)
    image = _open_with_pillow(path, data, at_least)
    if "A" in image.getbands() or "transparency" in image.info:
        array = np.asarray(image.convert("RGBA"))
        return _DecodedImage(np.ascontiguousarray(array[..., :3]), array[..., 3].astype(np.float32) / np.float32(255))
    return _DecodedImage(np.asarray(image.convert("RGB")), None)


def _open_with_pillow(
    path: Path, data: bytes, at_least: int | None = None, *, load: bool = True, orient: bool = True
) -> Image.Image:
    """The fully decoded image, or with `load=False` its header. Unlike OpenCV, Pillow refuses truncated data.

    Args:
        at_least: least height of a reduced JPEG.
        orient: whether the orientation of EXIF is applied.
    """
    try:
        image = Image.open(io.BytesIO(data), formats=_PILLOW_FORMATS)
        if at_least is not None:
            image.draft("RGB", (2 * at_least, at_least))
        if load:
            image.load()
        return ImageOps.exif_transpose(image) if orient else image
    except Image.UnidentifiedImageError as error:
        if data.startswith(_TIFF_MAGIC):  # the directory of a TIFF may be at the end
            raise InputError(
                f"{path}: needed a complete image, got damaged or truncated data; copy or export it again."
            ) from error
        raise InputError(
            f"{path}: needed a JPG, PNG, TIFF, WebP or EXR image, got an unknown format "
            f"(it starts with {data[:8]!r}); convert it."
        ) from error
    except Image.DecompressionBombError as error:
        rows, megapixels = math.isqrt(_MAX_PIXELS // 2), _MAX_PIXELS / 1e6
        raise InputError(
            f"{path}: needed at most {megapixels:.0f} megapixels ({2 * rows}x{rows}), got more ({error}); shrink it."
        ) from error
    except _DAMAGED as error:
        raise InputError(
            f"{path}: needed a complete image, got damaged or truncated data ({error}); copy or export it again."
        ) from error


def _count_tiff_bits(data: bytes) -> int:
    """Bits of a sample of a TIFF; 1 if its header cannot be read, which is reported later."""
    try:
        with Image.open(io.BytesIO(data), formats=("TIFF",)) as image:
            value = image.tag_v2.get(_BITS_PER_SAMPLE, 1)  # type: ignore[attr-defined]
            return int(max(value) if isinstance(value, tuple) else value)
    except (*_DAMAGED, Image.DecompressionBombError):
        return 1


def _decode_deep(path: Path, data: bytes) -> _DecodedImage:
    """A 16-bit PNG or TIFF at full precision, decoded by OpenCV; Pillow reduces colour to 8 bits."""
    image = _open_with_pillow(path, data, orient=False)  # refuses truncated data
    flags = cv2.IMREAD_UNCHANGED | cv2.IMREAD_IGNORE_ORIENTATION
    level = cv2.utils.logging.getLogLevel()
    try:
        cv2.utils.logging.setLogLevel(cv2.utils.logging.LOG_LEVEL_SILENT)  # the error below is one line
        array = cv2.imdecode(np.frombuffer(data, np.uint8), flags)
    except cv2.error:
        array = None
    finally:
        cv2.utils.logging.setLogLevel(level)
    if array is None or array.dtype != np.uint16:
        raise InputError(
            f"{path}: needed a readable PNG or TIFF of 8 or 16 bits, got data that OpenCV cannot decode as such; "
            "export it again."
        )
    is_tiff = data.startswith(_TIFF_MAGIC)  # OpenCV turns a TIFF, whatever the flags, and Pillow removes its tag
    orient = None if is_tiff else _ORIENT.get(image.getexif().get(_ORIENTATION, 1))
    array = array if orient is None else orient(array)
    values = array.astype(np.float32) / np.float32(65535)
    if values.ndim == 2:
        return _DecodedImage(np.repeat(values[..., None], 3, axis=2), None)
    color = np.ascontiguousarray(values[..., 2::-1])
    return _DecodedImage(color, np.ascontiguousarray(values[..., 3]) if values.shape[2] == 4 else None)


def _read_exr(path: Path) -> dict[str, NDArray[Any]]:
    """The channels of an EXR by name."""
    with _open_exr(path) as file:
        return {name: np.array(channel.pixels) for name, channel in file.channels().items()}


@contextlib.contextmanager
def _open_exr(path: Path, *, header_only: bool = False) -> Iterator[Any]:
    """An open file of OpenEXR; the block reads it."""
    import OpenEXR

    try:
        with OpenEXR.File(str(path), header_only=header_only) as file:
            yield file
    except Exception as error:  # OpenEXR has no base class of its errors
        raise InputError(
            f"{path}: needed a complete EXR image, got damaged or truncated data ({error}); export it again."
        ) from error


def _decode_exr(path: Path) -> _DecodedImage:
    channels = _read_exr(path)
    alpha = channels.get("A")
    if "RGBA" in channels:
        linear, alpha = channels["RGBA"][..., :3], channels["RGBA"][..., 3]
    elif "RGB" in channels:
        linear = channels["RGB"]
    elif "Y" in channels:
        linear = np.repeat(channels["Y"][..., None], 3, axis=2)
    else:
        raise InputError(
            f"{path}: needed the channels R, G and B (or Y), got {sorted(channels)}; export the colour without layers."
        )
    linear = linear.astype(np.float32)
    bad = int((~np.isfinite(linear)).sum())
    if bad:
        raise InputError(
            f"{path}: needed finite colours, got {bad} NaN or infinite values; repair the file or render it again."
        )
    return _DecodedImage(srgb_from_linear(linear), None if alpha is None else alpha.astype(np.float32).clip(0, 1))


def _resize_color(color: NDArray[Any], height: int) -> NDArray[Any]:
    """Resample (H W 3) to (height, 2 height) with wrap-around; float32 in [0, 1]."""
    if color.dtype == np.uint8:
        if color.shape[0] != height:
            color = _resize_plane(color, height, Image.Resampling.LANCZOS)
        return color.astype(np.float32) / np.float32(255)
    if color.shape[0] == height:
        return color.astype(np.float32)
    planes = [_resize_plane(color[..., c], height, Image.Resampling.LANCZOS) for c in range(3)]
    return np.stack(planes, axis=-1).clip(0, 1)


def _resize_plane(array: NDArray[Any], height: int, method: Image.Resampling) -> NDArray[Any]:
    """Resample (H W) float32 or (H W 3) uint8 to (height, 2 height) with wrap-around."""
    rows, columns = array.shape[:2]
    margin = min(columns, max(_WRAP, _WRAP * rows // height))
    wrapped = np.concatenate((array[:, columns - margin :], array, array[:, :margin]), axis=1)
    box = (margin, 0, margin + columns, rows)
    return np.asarray(Image.fromarray(wrapped).resize((2 * height, height), method, box=box))
