"""Where work runs: on the processor, or by CUDA on a graphics card. `choose_device` decides for all of pansplat.

The choice of a call or command counts for all work inside of it. Imports no torch, so that `--help` is fast.
"""

from __future__ import annotations

import contextlib
import functools
import math
import re
import warnings
from collections.abc import Callable, Iterator
from contextvars import ContextVar
from pathlib import Path
from typing import TYPE_CHECKING, Any, Literal, TypeVar, get_args

from pansplat.errors import InputError, InputWarning

if TYPE_CHECKING:
    import torch

_T = TypeVar("_T")

Device = Literal["auto", "cpu", "cuda"]
_MIN_TRITON = 3, 2  # Triton's versions below this one do not compile the kernels, which join tuples
_MIN_CAPABILITY = 8, 0  # least compute capability of a card; a test compiles the kernels for it
_MIN_SECONDS = 5.0  # shortest work that `auto` gives to a card: CUDA and Triton's kernels take seconds to start

_Say = Callable[[str], None]
_current: ContextVar[tuple[Device, _Say | None]] = ContextVar("device", default=("auto", None))


def measure_free_memory() -> float:
    """Bytes of main memory that programs can use without swapping; infinite where the system does not state it."""
    with contextlib.suppress(OSError, AttributeError):
        found = re.search(r"MemAvailable: +(\d+) kB", Path("/proc/meminfo").read_text(encoding="utf-8"))
        return 1024.0 * int(found[1]) if found else math.inf
    return math.inf


@contextlib.contextmanager
def use_device(choice: Device | None, say: _Say | None = None) -> Iterator[None]:
    """The device of all work in the block.

    Args:
        choice: "auto" is a card if there is one and the work is long enough to gain; None keeps the choice outside.
        say: called with one line about each work; None keeps that outside.
    """
    if choice is not None and choice not in get_args(Device):
        raise InputError(f"`device` must be one of {', '.join(get_args(Device))}, got {choice!r}")
    if choice == "cuda" and find_card() is None:
        raise InputError("`device` cuda needs a graphics card that torch can use, got none; use auto")
    given_choice, given_say = _current.get()
    token = _current.set((choice or given_choice, say or given_say))
    try:
        yield
    finally:
        _current.reset(token)


def with_device(function: Callable[..., _T]) -> Callable[..., _T]:
    """The function with a further keyword, `device`: "auto", "cpu" or "cuda" (`use_device`)."""

    @functools.wraps(function)
    def call(*args: Any, device: Device | None = None, **options: Any) -> _T:
        with use_device(device):
            return function(*args, **options)

    return call


def choose_device(work: str, seconds: float = math.inf, *, kernels: bool = False) -> torch.device:
    """The device of some work.

    Args:
        work: its name.
        seconds: that it takes on a processor, about.
        kernels: whether it rasterises, for which a card needs Triton.
    """
    import torch

    (choice, _), card = _current.get(), find_card()
    is_short = choice == "auto" and seconds < _MIN_SECONDS
    is_chosen = card is not None and choice != "cpu" and not is_short
    problem = find_problem() if kernels and is_chosen else None
    if problem is not None:
        warnings.warn(f"refinement and films run on the processor: {problem}", InputWarning, stacklevel=2)
    device = torch.device("cuda" if is_chosen and problem is None else "cpu")
    if device.type == "cuda":
        torch.backends.cudnn.allow_tf32 = False  # convolutions round as those of a processor do
    reason = ", which is faster for short work" if card is not None and is_short else ""
    say_detail(work, f"on {'the processor' if device.type == 'cpu' else card}{reason}")
    return device


def say_detail(subject: str, text: str) -> None:
    """Say where some work runs, or the figures of a reason, for `--verbose`."""
    _, say = _current.get()
    if say is not None:
        say(f"{subject}: {text}")


def note_full_card(work: str, then: str = "it runs on the processor") -> None:
    """Warn that a card has too little memory for some work, and what is done then."""
    warnings.warn(f"{work}: the graphics card has too little memory; {then}", InputWarning, stacklevel=3)


def find_card() -> str | None:
    """The name of the graphics card that torch can use; None if there is none."""
    import torch

    return torch.cuda.get_device_name() if torch.cuda.is_available() else None


def find_problem() -> str | None:
    """Why Triton's kernels do not run on the card; None if they do."""
    import torch

    problem, capability = find_triton_problem(), torch.cuda.get_device_capability()
    if problem is None and capability < _MIN_CAPABILITY:
        numbers = *_MIN_CAPABILITY, *capability
        return "needed a graphics card of compute capability {}.{} or newer, got {}.{}".format(*numbers)
    return None if problem is None else f"a graphics card {problem}"


def find_triton_problem() -> str | None:
    """The Triton that kernels need, and what was found; None if it is installed."""
    try:
        import triton

        version, found = triton.__version__, f"has version {'.'.join(triton.__version__.split('.')[:2])}"
    except ImportError:
        version, found = "0", "is not installed"
    is_new = tuple(int(number) for number in version.split(".")[:2]) >= _MIN_TRITON
    return None if is_new else f"needs the package triton {'.'.join(map(str, _MIN_TRITON))} or newer, which {found}"


def describe_devices() -> list[str]:
    """Lines that say what runs where on this machine (docs/platforms.md)."""
    import torch

    card = find_card()
    if card is None:
        return [f"PyTorch {torch.__version__} can use no graphics card: all work runs on the processor"]
    problem = find_problem()
    return [
        f"on {card}: networks of --model; of many panoramas those of depth and matching",
        f"on {card if problem is None else 'the processor'}: refinement, films{f' ({problem})' if problem else ''}",
        "on the processor: the rest",
    ]
