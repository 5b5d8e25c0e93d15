"""The C library's allocator, set for programs that allocate large arrays again and again."""

import ctypes
import sys

_TRIM_THRESHOLD, _MMAP_THRESHOLD, _ARENA_MAX = -1, -3, -8  # parameter numbers of mallopt (glibc, malloc.h)
_KEPT = 1 << 30  # bytes; smaller arrays are taken from memory that the process keeps


def keep_freed_memory() -> None:
    """Reuse the memory of freed arrays, up to 1 GiB, for the next ones; nothing on systems without glibc.

    By default glibc returns each array above 32 MB, and in threads above 64 MB at once, to the system, which clears the
    pages again at the next operation. A third of the time of ALIKED in two threads was that (docs/poses.md).
    For commands only: an allocator belongs to the program, not to a library.
    """
    if not sys.platform.startswith("linux"):
        return
    mallopt = getattr(ctypes.CDLL(None), "mallopt", None)
    if mallopt is not None:
        for name, value in ((_MMAP_THRESHOLD, _KEPT), (_TRIM_THRESHOLD, _KEPT), (_ARENA_MAX, 1)):
            mallopt(name, value)
