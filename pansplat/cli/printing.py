"""Where commands print their tables."""

from rich.console import Console


def table_console(width: int = 140) -> Console:
    """The terminal; where there is none, lines of `width` characters, so that tables keep their columns."""
    console = Console(highlight=False)
    return console if console.is_terminal else Console(highlight=False, width=width)
