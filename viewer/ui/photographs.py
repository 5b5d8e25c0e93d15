"""The photographs of a scene: their poses, and textures that are read in the background when they are first shown."""

from __future__ import annotations

from collections import OrderedDict
from collections.abc import Sequence
from concurrent.futures import Future, ThreadPoolExecutor, wait

import moderngl
import numpy as np
from jaxtyping import Float, UInt8

from pansplat.errors import InputError
from pansplat.images.image_files import read_height, read_panorama
from pansplat.inputs.panorama_sets import Note, Panorama
from pansplat.inputs.photographs import read_notes
from pansplat.tours.route import STOP_REACH

MAX_HEIGHT = 2048  # pixels; sharper than the image at fields of view above 65 degrees on 720 rows
_MAX_TEXTURES = 4  # 25 MB each
_VIEW_HEIGHT = 64  # pixels, of a panorama in which a view is chosen


class Photographs:
    """Posed panoramas, and the textures of those that were shown last."""

    def __init__(self, ctx: moderngl.Context) -> None:
        """There are no photographs before `open`."""
        self._ctx = ctx
        self._reader = ThreadPoolExecutor(1, "photograph-reader")
        self._panoramas: tuple[Panorama, ...] = ()
        self._positions: Float[np.ndarray, "photograph 3"] = np.zeros((0, 3))
        self._reading: dict[int, Future[UInt8[np.ndarray, "height width 3"]]] = {}
        self._failed: set[int] = set()
        self._notes: dict[int, tuple[Note, ...]] = {}  # of panoramas that were shown
        self._textures: OrderedDict[int, moderngl.Texture] = OrderedDict()

    def __len__(self) -> int:
        return len(self._panoramas)

    @property
    def panoramas(self) -> tuple[Panorama, ...]:
        """The panoramas of all photographs."""
        return self._panoramas

    @property
    def is_reading(self) -> bool:
        """Whether a photograph is being read."""
        return any(not reading.done() for reading in self._reading.values())

    def open(self, panoramas: Sequence[Panorama]) -> None:
        """Replace the photographs; the same objects are kept, those of a folder that is read again are not."""
        if tuple(panoramas) == self._panoramas:  # panoramas are compared by identity
            return
        self._clear()
        self._panoramas = tuple(panoramas)
        self._positions = np.array([panorama.cam2world[:3, 3].numpy() for panorama in panoramas]).reshape(-1, 3)

    def pose(self, index: int) -> Float[np.ndarray, "4 4"]:
        """Camera to world of a photograph, OpenCV axes, metres."""
        return self._panoramas[index].cam2world.double().numpy()

    def find_nearest(self, position: Float[np.ndarray, "3"]) -> int | None:
        """The photograph whose camera is nearest to a position; the first on ties, None without photographs."""
        if not len(self):
            return None
        return int(np.argmin(np.linalg.norm(self._positions - position, axis=1)))

    def find_stop(self, position: Float[np.ndarray, "3"]) -> int | None:
        """The photograph at whose camera a position is, within `STOP_REACH`; None if there is none."""
        index = self.find_nearest(position)
        is_near = index is not None and np.linalg.norm(self._positions[index] - position) <= STOP_REACH
        return index if is_near else None

    def list_notes(self, index: int) -> tuple[Note, ...]:
        """The notes of a photograph, which are read from its links.json when they are first shown."""
        if index not in self._notes:
            self._notes[index] = read_notes(self._panoramas[index])
        return self._notes[index]

    def change_notes(self, index: int, notes: tuple[Note, ...]) -> None:
        """Replace the notes of a photograph until they are read again."""
        self._notes[index] = notes

    def get(self, index: int) -> moderngl.Texture | None:
        """The texture of a photograph, top row first; None while it is being read, or if it cannot be read."""
        if index in self._textures:
            self._textures.move_to_end(index)
            return self._textures[index]
        if index in self._failed:
            return None
        if index not in self._reading:
            self._reading[index] = self._reader.submit(_read_pixels, self._panoramas[index])
        if not self._reading[index].done():
            return None
        future = self._reading.pop(index)
        try:
            pixels = future.result()
        except InputError:
            self._failed.add(index)
            raise
        while len(self._textures) >= _MAX_TEXTURES:
            self._textures.popitem(last=False)[1].release()
        texture = self._ctx.texture(pixels.shape[1::-1], 3, pixels.tobytes(), alignment=1)
        texture.filter = (moderngl.LINEAR, moderngl.LINEAR)
        texture.repeat_x, texture.repeat_y = True, False
        self._textures[index] = texture
        return texture

    def wait(self, index: int) -> None:
        """Wait until a photograph has been read, or cannot be."""
        if index not in self._textures and index not in self._failed:
            if index not in self._reading:
                self._reading[index] = self._reader.submit(_read_pixels, self._panoramas[index])
            wait([self._reading[index]])

    def release(self) -> None:
        """Stop the reader and free the textures."""
        self._clear()
        self._reader.shutdown(cancel_futures=True)

    def _clear(self) -> None:
        for future in self._reading.values():
            future.cancel()
        for texture in self._textures.values():
            texture.release()
        self._reading.clear()
        self._failed.clear()
        self._notes.clear()
        self._textures.clear()


def find_open_view(panorama: Panorama) -> float:
    """The yaw with the most edges around it: a wide view rather than a bare wall. Radians right of the centre."""
    gray = read_panorama(panorama.image, _VIEW_HEIGHT)[0].mean(dim=0).numpy()
    around = np.concatenate((gray, gray[:, :1]), axis=1)[_VIEW_HEIGHT // 4 : -_VIEW_HEIGHT // 4]  # within 45 degrees
    edges = np.abs(np.diff(around, axis=1))[:-1] + np.abs(np.diff(around, axis=0))[:, :-1]
    angles = np.arange(2 * _VIEW_HEIGHT) * (np.pi / _VIEW_HEIGHT)  # from edge to edge, of a column to the first one
    window = np.exp(4 * (np.cos(angles) - 1))  # half of its height at 34 degrees
    nearby = np.fft.irfft(np.fft.rfft(edges.sum(axis=0)) * np.fft.rfft(window).conj(), len(angles))
    return float(angles[nearby.argmax()] - np.pi)


def _read_pixels(panorama: Panorama) -> UInt8[np.ndarray, "height width 3"]:
    image, _ = read_panorama(panorama.image, min(read_height(panorama.image), MAX_HEIGHT))
    return (image.permute(1, 2, 0).numpy() * 255 + 0.5).astype(np.uint8)
