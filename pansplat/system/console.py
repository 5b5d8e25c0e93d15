"""The frame of all commands: messages, exit statuses, signals, and the terminal (docs/errors.md)."""

from __future__ import annotations

import bisect
import contextlib
import errno
import functools
import io
import math
import os
import re
import shutil
import signal
import sys
import tempfile
import threading
import time
import traceback
import warnings
from collections.abc import Callable, Iterator, Sequence
from typing import TYPE_CHECKING, ParamSpec, TextIO, TypeVar

from pansplat.errors import InputError, InputWarning
from pansplat.system.allocator import keep_freed_memory
from pansplat.system.descriptions import describe_time_left
from pansplat.system.progress import is_progress_shown, show_progress, stage

if TYPE_CHECKING:
    from types import FrameType

    from rich.console import Console
    from rich.progress import Progress

BAD_INPUT, INTERNAL_ERROR, CLOSED_PIPE = 2, 70, 128 + 13  # exit statuses; 128 + signal number after a signal
DEBUG = "PANSPLAT_DEBUG"  # environment variable; 1 prints the traceback of every error

_T = TypeVar("_T")
_P = ParamSpec("_P")

_COLORS = {"error": 31, "interrupted": 31, "note": 33, "progress": 36}  # ANSI codes of red, yellow and cyan
_COMPLETION, _ALL_OPTIONS = "--tyro-print-completion", "--help-all"
_LINE_INTERVAL, _MAX_WHOLE = 30.0, 86_400.0  # seconds: between two lines; of the longest whole time stated
_MAX_RATIO = 1.5  # largest ratio of two estimates of a task's whole time, for the time left to be stated
_LONG_HELP = 60  # lines of a help text above which further options are listed by name only
_MIN_WIDTH = 40  # columns; in narrower terminals tyro's layout of help texts does not end
_REDRAW_INTERVAL = 0.25  # seconds between two states of a progress bar in a notebook
_SIGNALS = (signal.SIGINT, signal.SIGTERM)


def run_command(command: Callable[[], int], *, memory_advice: str, interruption: str) -> int:
    """Run a command and return its exit status. No exception leaves it but SystemExit.

    Args:
        command: returns its exit status.
        memory_advice: advice for the case that memory runs out.
        interruption: message after Ctrl+C or SIGTERM.

    Returns:
        The command's status; 2 for bad input, missing files and exhausted memory or disks, 70 for a defect of pansplat,
        130 after Ctrl+C, 143 after SIGTERM, 141 if the reader of standard output closed it.
    """
    keep_freed_memory()
    sys.stdout, sys.stderr = (stream or open(os.devnull, "w", encoding="utf-8") for stream in (sys.stdout, sys.stderr))  # noqa: SIM115
    for stream in (sys.stdout, sys.stderr):  # what the terminal's encoding lacks is written as escapes
        with contextlib.suppress(AttributeError, ValueError):
            stream.reconfigure(errors="backslashreplace")
    received: list[int] = []

    def interrupt(number: int) -> None:
        received.append(number)
        raise KeyboardInterrupt

    with call_at_first_signal(_SIGNALS, interrupt):
        try:
            try:
                status = command()
            except SystemExit as request:  # the parser of arguments ends in this way
                status = request
            sys.stdout.flush()
        except BaseException as error:
            if os.environ.get(DEBUG) == "1":
                traceback.print_exc()
            # After a signal, a compiled kernel that runs on raises a SystemError instead of the KeyboardInterrupt.
            if received or isinstance(error, KeyboardInterrupt):
                print_message("interrupted", interruption)
                return 128 + (received or [signal.SIGINT])[0]
            return _report(error, memory_advice)
    if isinstance(status, SystemExit):
        raise status
    return status


def _report(error: BaseException, memory_advice: str) -> int:
    """Print one line about an error and return the exit status."""
    if isinstance(error, InputError):
        print_message("error", error)
        return BAD_INPUT
    if isinstance(error, (MemoryError, RuntimeError, OSError)) and is_out_of_memory(error):
        cause = "".join(f" ({line[:120]})" for line in str(error).splitlines()[:1])
        print_message("error", f"out of memory{cause}; {memory_advice}")
        return BAD_INPUT
    if isinstance(error, OSError):
        return _report_system_error(error)
    log = _write_log(error)
    cause = f"{type(error).__name__}: {error}".splitlines()[0][:160]
    print_message("error", f"internal error ({cause}), please report it with {log}; {DEBUG}=1 shows more")
    return INTERNAL_ERROR


def _report_system_error(error: OSError) -> int:
    """Print one line about an error of the operating system, unless standard output was closed by its reader."""
    if error.filename is None:  # an error of standard output, whose unwritten text would fail again at the end
        _discard_output(sys.stdout)
        closed = errno.EINVAL if sys.platform == "win32" else errno.EPIPE  # the reader of a pipe closed it
        if error.errno == closed:
            return CLOSED_PIPE
    name, reason = error.filename or "standard output", error.strerror or str(error) or type(error).__name__
    print_message("error", f"{name}: needed a usable file or folder, got '{reason}'; check path, space and permissions")
    return BAD_INPUT


def _discard_output(stream: TextIO | None) -> None:
    """Send unwritten text to the null device, so that the interpreter's end does not fail to write it."""
    with contextlib.suppress(OSError, ValueError, AttributeError), open(os.devnull, "w", encoding="utf-8") as null:
        os.dup2(null.fileno(), stream.fileno())
        stream.flush()


def _write_log(error: BaseException) -> str:
    """Write the traceback of a defect to a temporary file; return words that name it."""
    from importlib.metadata import PackageNotFoundError, version

    try:
        release = version("pansplat")
    except PackageNotFoundError:
        release = "of a source folder"
    lines = [f"pansplat {release}, Python {sys.version}, {sys.platform}", f"arguments: {sys.argv!r}", ""]
    text = "\n".join(lines) + "\n" + "".join(traceback.format_exception(error))
    try:
        name = time.strftime("pansplat-error-%Y%m%d-%H%M%S-")
        with tempfile.NamedTemporaryFile(
            "w", prefix=name, suffix=".log", delete=False, encoding="utf-8", errors="backslashreplace"
        ) as file:
            file.write(text)
        return f"the log {file.name}"
    except OSError:
        return "its traceback (no log could be written)"


@contextlib.contextmanager
def call_at_first_signal(numbers: Sequence[int], act: Callable[[int], object]) -> Iterator[None]:
    """Call a function with the number of the first of some signals; the second one raises KeyboardInterrupt."""
    received = False

    def handle(number: int, _: FrameType | None) -> None:
        nonlocal received
        if received:
            raise KeyboardInterrupt
        received = True
        act(number)

    is_main = threading.current_thread() is threading.main_thread()  # others cannot set handlers
    numbers = [number for number in numbers if is_main and signal.getsignal(number) is not signal.SIG_IGN]
    previous = {number: signal.signal(number, handle) for number in numbers}
    try:
        yield
    finally:
        for number, handler in previous.items():
            signal.signal(number, handler)


def print_message(kind: str, text: object) -> None:
    """Print one line `kind: text` on standard error; `kind` is "error", "interrupted", "note" or "progress"."""
    start = f"{kind}: "
    try:
        if sys.stderr.isatty() and not os.environ.get("NO_COLOR") and _has_escapes():
            start = f"\x1b[1;{_COLORS[kind]}m{start}\x1b[0m"
        print(start + " ".join(str(text).splitlines()), file=sys.stderr, flush=True)
    except (OSError, ValueError, AttributeError):  # standard error is full or closed
        _discard_output(sys.stderr)


def _has_escapes() -> bool:
    """Whether the terminal interprets ANSI codes. The classic console of Windows prints them."""
    return sys.platform != "win32" or "WT_SESSION" in os.environ or "TERM" in os.environ


def is_out_of_memory(error: BaseException) -> bool:
    """Whether Python, numpy or torch failed to allocate memory; torch's CPU allocator raises a RuntimeError."""
    return isinstance(error, MemoryError) or describes_out_of_memory(str(error))


def describes_out_of_memory(message: str) -> bool:
    """Whether an error message reports a failed allocation."""
    return "allocate" in message or "out of memory" in message.lower() or message.startswith("MemoryError")


def can_print(text: str) -> bool:
    """Whether standard output has all characters of a text."""
    try:
        text.encode(getattr(sys.stdout, "encoding", None) or "ascii")
    except UnicodeEncodeError:
        return False
    return True


@contextlib.contextmanager
def own_warnings() -> Iterator[None]:
    """Print warnings of pansplat as notes and hide those of other libraries."""
    with warnings.catch_warnings():
        warnings.simplefilter("ignore")
        warnings.filterwarnings("always", category=InputWarning)
        warnings.filterwarnings("always", category=UserWarning, module=r"pansplat(_viewer)?(\.|$)")
        printed: set[str] = set()

        def print_once(message: Warning | str, *_: object) -> None:
            if str(message) not in printed:  # a picture may be read several times
                printed.add(str(message))
                print_message("note", message)

        warnings.showwarning = print_once
        yield


def parse_arguments(parse: Callable[[Sequence[str]], _T], program: str, arguments: Sequence[str] | None) -> _T:
    """The result of a parser of arguments, which prints help or an error and raises SystemExit.

    Args:
        parse: tyro's parser of some arguments.
        program: name of the command.
        arguments: None for those of the process. `--version` prints the version and exits, `--help-all` help of all
            options; `--tyro-print-completion SHELL` prints a script for the completion of arguments.
    """
    given = list(sys.argv[1:] if arguments is None else arguments)
    if given == ["--version"]:
        from pansplat import __version__

        print(f"{program} {__version__}")
        raise SystemExit(0)
    from pansplat.system.options import NUMBERS

    printed = io.TextIOWrapper(io.BytesIO(), encoding=getattr(sys.stdout, "encoding", None) or "utf-8")
    width = os.environ.get("COLUMNS")
    is_script, is_short = given[:1] == [_COMPLETION], not {"-h", "--help"}.isdisjoint(given)
    if shutil.get_terminal_size().columns < _MIN_WIDTH:
        os.environ["COLUMNS"] = str(_MIN_WIDTH)
    try:
        with NUMBERS, contextlib.redirect_stdout(printed if is_script or is_short else sys.stdout):
            return parse(["--help" if argument == _ALL_OPTIONS else argument for argument in given])
    finally:
        os.environ.pop("COLUMNS", None)
        os.environ |= {} if width is None else {"COLUMNS": width}
        # The shell would read the second line of a description as another word.
        printed.seek(0)
        text = re.sub(r"\\n(?=.*'type':)", " ", printed.read())
        print(_shorten_help(text) if is_short else text, end="")


def _shorten_help(text: str) -> str:
    """Long help with the required options first, and of each further group the names of its options."""
    if text.count("\n") <= _LONG_HELP:
        return text
    shown, names = "", ""
    for block in re.split(r"(?m)^(?=(?:╭─)? (?:[\w.-]+ )?(?:options|arguments)\b)", text):
        first, *entries = re.split(r"(?m)^(?=(?:│ |  )--?\w)", block)
        group = re.match(r"(?:╭─)? ([\w.-]+) options\b", block)
        if group is None:
            shown += first + "".join(sorted(entries[:-1], key=lambda entry: "(required)" not in entry) + entries[-1:])
        else:
            names += " ".join((f"  {group[1]}:", *re.findall(r"(?m)^(?:│ |  )(--?\w[\w.-]*)", block))) + "\n"
    return f"{shown}More options; {_ALL_OPTIONS} describes them:\n{names}" if names else shown


def is_notebook() -> bool:
    """Whether this process is the kernel of a notebook (Jupyter, VS Code, Colab)."""
    ipython = sys.modules.get("IPython")
    shell = None if ipython is None else ipython.get_ipython()
    return getattr(shell, "kernel", None) is not None


@contextlib.contextmanager
def progress_bar() -> Iterator[None]:
    """Show the progress of the block: the current step, the fraction done and the time left.

    A temporary bar on standard error shows them, or below the cell of a notebook. If standard error is not a terminal,
    a line is printed each half minute. In a block whose progress is shown, the block is a stage of it.
    """
    if is_progress_shown():
        with stage():
            yield
        return
    from rich.console import Console
    from rich.progress import BarColumn, Progress, ProgressColumn, Task, TextColumn, TimeElapsedColumn
    from rich.text import Text

    in_notebook, console = is_notebook(), Console(stderr=True)
    if not console.is_terminal and not in_notebook:
        with show_progress(_print_progress()):
            yield
        return
    columns = TextColumn("{task.description}", markup=False), BarColumn(), TextColumn("{task.percentage:>3.0f} %")
    time_left = _TimeLeft()

    class TimeLeftColumn(ProgressColumn):
        def render(self, task: Task) -> Text:
            return Text(time_left.describe(), "progress.remaining")

    times = TimeElapsedColumn(), TimeLeftColumn()
    # Standard output goes through the bar if it is on the same terminal, and stays what it is if it is a file.
    is_shared = sys.stdout.isatty() and not in_notebook
    bar = Progress(*columns, *times, console=console, transient=True, redirect_stdout=is_shared)
    with _draw_in_notebook(bar) if in_notebook else bar as redraw:
        task = bar.add_task("", total=1.0)

        def show(step: str, fraction: float) -> None:
            time_left.report(fraction)
            bar.update(task, description=step, completed=fraction)
            if callable(redraw):
                redraw()

        with show_progress(show):
            yield


class _TimeLeft:
    """The time that work will still take, from the fractions done.

    The rate so far and that of the last half of the time must agree on the whole time within a factor of `_MAX_RATIO`;
    the longer time is stated. It never exceeds `_MAX_RATIO` times a whole time that was stated before: nothing is then.
    """

    def __init__(self) -> None:
        """The work begins."""
        self._times, self._fractions = [time.monotonic()], [0.0]
        self._shortest = math.inf  # shortest whole time that was stated, seconds

    def report(self, fraction: float) -> None:
        """Note the fraction that is done now."""
        self._times.append(time.monotonic())
        self._fractions.append(fraction)

    def describe(self) -> str:
        """Such as "about 30 s left"; empty while it is not certain enough."""
        now, began, done = time.monotonic(), self._times[0], self._fractions[-1]
        half = bisect.bisect_right(self._times, (began + now) / 2) - 1
        rates = [(done - self._fractions[start]) / max(now - self._times[start], 1e-9) for start in (0, half)]
        if not 0 < done < 1 or min(rates) <= 0:
            return ""
        wholes = [now - began + (1 - done) / rate for rate in rates]
        whole = max(wholes)
        if whole > _MAX_RATIO * min(*wholes, self._shortest) or whole > _MAX_WHOLE:
            return ""
        self._shortest = min(self._shortest, whole)
        return describe_time_left(whole - (now - began))


def _print_progress() -> Callable[[str, float], None]:
    """A function that prints the progress on standard error, a line each half minute."""
    printed, time_left = time.monotonic(), _TimeLeft()

    def show(step: str, fraction: float) -> None:
        nonlocal printed
        now = time.monotonic()
        time_left.report(fraction)
        if now - printed < _LINE_INTERVAL:
            return
        printed = now
        rest = time_left.describe()
        print_message("progress", f"{step or 'working'}, {100 * fraction:.0f} %{rest and f', {rest}'}")

    return show


@contextlib.contextmanager
def _draw_in_notebook(bar: Progress) -> Iterator[Callable[[], None]]:
    """A function that draws the bar in its output, which is empty at the end; rich itself would need ipywidgets."""
    from IPython.display import HTML, display

    output = display(HTML(""), display_id=True)
    drawn = time.monotonic()

    def redraw() -> None:
        nonlocal drawn
        if output is not None and time.monotonic() - drawn >= _REDRAW_INTERVAL:
            drawn = time.monotonic()
            output.update(bar)

    try:
        yield redraw
    finally:
        if output is not None:
            output.update(HTML(""))


def with_progress_bar(function: Callable[_P, _T]) -> Callable[_P, _T]:
    """The function as a stage of the work around it; in a notebook it shows a bar, unless its progress is shown."""

    @functools.wraps(function)
    def call(*args: _P.args, **options: _P.kwargs) -> _T:
        with progress_bar() if is_notebook() else stage():
            return function(*args, **options)

    return call


def make_table_console(width: int = 140) -> Console:
    """A console of the terminal's width, or of `width` characters if standard output is not a terminal."""
    from rich.console import Console

    class TableConsole(Console):
        def on_broken_pipe(self) -> None:
            """Raise the error that is handled, instead of an exit with status 1."""
            raise

    console = TableConsole(highlight=False)
    return console if console.is_terminal else TableConsole(highlight=False, width=width)
