"""Terminal output of the commands: messages on standard error, exit statuses, tables."""

from __future__ import annotations

import contextlib
import warnings
from collections.abc import Callable, Iterator
from typing import TYPE_CHECKING

from pansplat.errors import InputError

if TYPE_CHECKING:
    from rich.console import Console

_COLORS = {"error": "red", "interrupted": "red", "note": "yellow"}


def run_command(command: Callable[[], int], *, memory_advice: str, interruption: str) -> int:
    """Run a command and return its exit status.

    Args:
        command: returns its exit status.
        memory_advice: advice for the case that memory runs out.
        interruption: message after Ctrl+C.

    Returns:
        The command's status; 2 for bad input or if memory runs out, 130 after Ctrl+C.
    """
    try:
        return command()
    except InputError as error:
        print_message("error", error)
        return 2
    except (MemoryError, RuntimeError) as error:
        if not is_out_of_memory(error):
            raise
        cause = "".join(f" ({line[:120]})" for line in str(error).splitlines()[:1])
        print_message("error", f"out of memory{cause}; {memory_advice}")
        return 2
    except KeyboardInterrupt:
        print_message("interrupted", interruption)
        return 130


def print_message(kind: str, text: object) -> None:
    """Print one line `kind: text` on standard error; `kind` is "error", "interrupted" or "note"."""
    from rich.console import Console
    from rich.text import Text

    line = Text.assemble((f"{kind}: ", f"bold {_COLORS[kind]}"), str(text))
    Console(stderr=True, soft_wrap=True, highlight=False).print(line)


def is_out_of_memory(error: BaseException) -> bool:
    """Whether Python, numpy or torch failed to allocate memory; torch's CPU allocator raises a RuntimeError."""
    return isinstance(error, MemoryError) or describes_out_of_memory(str(error))


def describes_out_of_memory(message: str) -> bool:
    """Whether an error message reports a failed allocation."""
    return "allocate" in message or "out of memory" in message.lower() or message.startswith("MemoryError")


@contextlib.contextmanager
def own_warnings() -> Iterator[None]:
    """Print warnings of pansplat as notes and hide those of other libraries."""
    with warnings.catch_warnings():
        warnings.simplefilter("ignore")
        warnings.filterwarnings("always", category=UserWarning, module=r"pansplat(\.|$)")
        warnings.showwarning = lambda message, *_: print_message("note", message)
        yield


def make_table_console(width: int = 140) -> Console:
    """A console of the terminal's width, or of `width` characters if standard output is not a terminal."""
    from rich.console import Console

    console = Console(highlight=False)
    return console if console.is_terminal else Console(highlight=False, width=width)
