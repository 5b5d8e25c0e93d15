"""The order of splats and their colours for one camera position, made in place or by a thread.

Both depend on where the camera is and not on where it looks (radial order), so turning needs neither.
"""

import threading
import time
from dataclasses import dataclass, field

import numpy as np
from jaxtyping import Float, UInt

from pansplat_viewer.splats import Splats


def radix_argsort(keys: Float[np.ndarray, "n"]) -> UInt[np.ndarray, "n"]:
    """Stable ascending order of float32 keys without NaN.

    Two passes over the halves of bit patterns that sort as the numbers do; numpy's stable sort of 16-bit
    integers is a counting sort, four times as fast as one of floats.
    """
    bits = np.ascontiguousarray(keys, dtype=np.float32).view(np.uint32)
    if np.signbit(keys).any():
        bits = (keys.astype(np.float32) + np.float32(0)).view(np.uint32)  # + 0 makes -0 and 0 equal
        bits = np.where(bits >> 31, ~bits, bits | np.uint32(1 << 31))
    low = np.argsort((bits & 0xFFFF).astype(np.uint16), kind="stable").astype(np.uint32)
    high = (bits >> 16).astype(np.uint16)
    return low[np.argsort(high[low], kind="stable")]


@dataclass(frozen=True, eq=False)
class Ordering:
    """What a camera position decides.

    Attributes:
        splats: the scene it was made for.
        position: camera centre in the splats' shifted frame.
        radius: distance of each mean, metres.
        order: indices by ascending radius, ties by index.
        colors: RGB and padding in the direction from here, or None when they never change.
        milliseconds: what making it took.
    """

    splats: Splats
    position: tuple[float, float, float]
    radius: Float[np.ndarray, "n"]
    order: UInt[np.ndarray, "n"]
    colors: Float[np.ndarray, "n 4"] | None
    milliseconds: float = field(default=0.0)


def make_ordering(splats: Splats, position: tuple[float, float, float]) -> Ordering:
    """Sort the splats and evaluate their colours for a camera position."""
    start = time.perf_counter()
    x, y, z = (splats.means[:, axis] - np.float32(position[axis]) for axis in range(3))
    squared = x * x
    squared += y * y
    squared += z * z
    order = radix_argsort(squared)
    colors = splats.colors_from(position) if splats.has_view_dependent_colors else None
    milliseconds = 1e3 * (time.perf_counter() - start)
    return Ordering(splats, position, np.sqrt(squared), order, colors, milliseconds)


class Sorter:
    """Makes orderings in a thread of its own; a new request replaces one that waits."""

    def __init__(self) -> None:
        """The thread starts with the first request."""
        self._condition = threading.Condition()
        self._request: tuple[Splats, tuple[float, float, float]] | None = None
        self._result: Ordering | BaseException | None = None
        self._thread: threading.Thread | None = None
        self._closed = False

    def request(self, splats: Splats, position: tuple[float, float, float]) -> None:
        """Ask for an ordering; returns at once."""
        with self._condition:
            if self._closed:
                raise RuntimeError("the sorter is closed")
            self._request = (splats, position)
            if self._thread is None:
                self._thread = threading.Thread(target=self._run, name="splat-sorter", daemon=True)
                self._thread.start()
            self._condition.notify()

    def take(self) -> Ordering | None:
        """The newest finished ordering, once, or None; what failed in the thread is raised here."""
        with self._condition:
            result, self._result = self._result, None
        if isinstance(result, BaseException):
            raise result
        return result

    def close(self) -> None:
        """Stop the thread and wait for it."""
        with self._condition:
            self._closed = True
            self._condition.notify()
        if self._thread is not None:
            self._thread.join()
            self._thread = None

    def _run(self) -> None:
        while True:
            with self._condition:
                self._condition.wait_for(lambda: self._closed or self._request is not None)
                if self._closed or self._request is None:
                    return
                splats, position = self._request
                self._request = None
            try:
                result: Ordering | BaseException = make_ordering(splats, position)
            except Exception as error:
                result = error
            with self._condition:
                self._result = result
