"""Where numba keeps compiled kernels if neither the package's folder nor the user's cache folder is writable."""

import atexit
import os
import shutil
import tempfile
from collections.abc import MutableMapping

_VARIABLE = "NUMBA_CACHE_DIR"


def choose_kernel_cache(package: str, environment: MutableMapping[str, str]) -> None:
    """Set numba's cache folder to one that ends with the process if its own choices are not writable.

    Without a writable folder, numba refuses to define a kernel. Call this before numba is imported.

    Args:
        package: folder of the package, where numba keeps kernels first.
        environment: the environment variables.
    """
    if _VARIABLE in environment:
        return
    home = environment.get("HOME") or os.path.expanduser("~")
    user = environment.get("XDG_CACHE_HOME") or os.path.join(home, ".cache")
    if _can_make(os.path.join(package, "__pycache__")) or (os.path.isabs(user) and _can_make(user)):
        return
    environment[_VARIABLE] = folder = tempfile.mkdtemp(prefix="pansplat-kernels-")  # only this user can write it
    atexit.register(shutil.rmtree, folder, ignore_errors=True)


def _can_make(folder: str) -> bool:
    """Whether a folder is writable or can be made."""
    while not os.path.lexists(folder) and folder != os.path.dirname(folder):  # a whole drive may be missing
        folder = os.path.dirname(folder)
    return os.path.isdir(folder) and os.access(folder, os.W_OK | os.X_OK) and not _is_read_only(folder)


def _is_read_only(folder: str) -> bool:
    """Whether the file system refuses to write, also for the superuser."""
    try:
        with tempfile.TemporaryFile(dir=folder):
            return False
    except OSError:
        return True
