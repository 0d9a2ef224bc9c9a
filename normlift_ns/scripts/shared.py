"""Shared parts of the commands: flags and help, printing, warnings, exit codes."""

from __future__ import annotations

import atexit
import os
import shlex
import shutil
import signal
import sys
import threading
import warnings
from collections.abc import Collection, Iterator, Sequence
from contextlib import contextmanager, nullcontext, suppress
from dataclasses import fields, is_dataclass
from functools import cache
from pathlib import Path
from types import FrameType
from typing import Annotated, Any, NoReturn, Protocol, TextIO, TypeVar, cast, get_type_hints

import docstring_parser
import tyro
from rich.console import Console
from rich.text import Text

import normlift_ns
from normlift_ns.crash import USER, explain
from normlift_ns.errors import InputError, OutputError, visible
from normlift_ns.ranges import named_as_flags
from normlift_ns.scripts import terminal
from normlift_ns.scripts.mistyped import plain_errors

_PLAIN: dict[str, Any] = {"width": 120, "markup": False, "emoji": False, "highlight": False}
CONSOLE = Console(**_PLAIN)
"""Console for results, on standard output. Markup in texts is not interpreted."""
if CONSOLE.is_terminal:  # tables fit the terminal; pipes and files get the full width
    CONSOLE.width = min(CONSOLE.width, shutil.get_terminal_size().columns)
ERRORS = Console(**_PLAIN, stderr=True)

_OUTPUT_ERROR = "The output of the command cannot be written: {}. Redirect it elsewhere."
_PACKAGE = str(Path(normlift_ns.__file__).parent)


class Command(Protocol):
    """A command: a dataclass of its flags."""

    def main(self) -> object:
        """Run the command."""
        ...


_Command = TypeVar("_Command", bound=Command)


class Terminated(BaseException):
    """SIGTERM from the system, for example before preemption."""


def run_command(command: type[Command]) -> None:
    """Parse flags as nerfstudio's commands do (--flag True), run the command, and exit unless it succeeds.

    The exit code is 1 for user errors and for a full disk or memory, and 70 for internal errors. It is 130 for Ctrl-C
    and 143 for SIGTERM, after partial files are removed.
    """
    streams: tuple[Any, ...] = (sys.stdout, sys.stderr)
    for stream in streams:
        if hasattr(stream, "reconfigure"):
            stream.reconfigure(errors="replace")  # for code pages that lack a character
    try:
        words, flags = terminal.terminal_flags(sys.argv[1:])
        with terminal.talking(flags, shlex.join(sys.argv)):
            code = _exit_code(command, words)
    except InputError as error:
        code = _report_error(error)
    for stream in streams:
        code = _flush(stream, report=code == 0) or code
    if code != 0:
        sys.exit(code)


def run_process(command: type[Command]) -> NoReturn:
    """Run a command as the only task of this process, and exit without the second that torch's teardown takes.

    Idle OpenMP threads of torch and of compiled kernels sleep instead of spinning on cores that other threads and
    other lifts could use. A policy set by the user takes precedence.
    """
    os.environ.setdefault("OMP_WAIT_POLICY", "passive")  # read when torch is imported
    code: Any = 0
    try:
        run_command(command)
    except SystemExit as stop:
        code = stop.code
    atexit._run_exitfuncs()
    for stream in (sys.stdout, sys.stderr):
        _flush(stream, report=False)  # the output of those functions
    os._exit(code)


def _exit_code(command: type[Command], words: list[str]) -> int:
    """Run the command and return the exit code."""
    try:
        with _sigterm_raises(), _plain_warnings(), _checked_output(), named_as_flags():
            _parse_and_run(command, words)
    except SystemExit as stop:  # from tyro after --help, or from rich if the output pipe is closed
        return stop.code if isinstance(stop.code, int) else 0 if stop.code is None else USER
    except (KeyboardInterrupt, Terminated) as stop:
        number = signal.SIGINT if isinstance(stop, KeyboardInterrupt) else signal.SIGTERM
        word = "Interrupted" if number == signal.SIGINT else "Terminated"
        say_error(f"{word}. No partial files remain; rerun the command to resume.")
        return 128 + number
    except Exception as error:  # a traceback would not help the user
        return _report_error(error)
    return 0


def _report_error(error: Exception) -> int:
    """Print an error and return the exit code."""
    if isinstance(error, BrokenPipeError):  # the reader of the pipe has gone
        return USER
    message, code = (str(error), USER) if isinstance(error, OutputError) else explain(error)
    with suppress(OSError):
        ERRORS.print(Text("Error", style="bold red"))
    say_error(message)
    return code


def _parse_and_run(command: type[Command], words: list[str]) -> None:
    if "--version" in words:
        say(f"normlift_ns {normlift_ns.__version__}")
        return
    tyro.extras.set_accent_color("bright_yellow")
    read_flags(command, words).main()


def read_flags(command: type[_Command], words: Sequence[str], name: str | None = None) -> _Command:
    """Parse the words after the name of a command.

    Args:
        command: Dataclass of the command.
        words: Words of the command line.
        name: Name of the command; None: the name that this process was started with.
    Raises:
        InputError: The command does not know the words.
        SystemExit: The help was printed; the exit code is 0.
    """
    name = name or _module_name()
    flags: Any = tyro.conf.OmitArgPrefixes[tyro.conf.FlagConversionOff[with_help(command)]]
    words = with_values(words, switches(command))
    prints_help = {"-h", "--help"} & set(words)
    with nullcontext() if prints_help else plain_errors(name or sys.argv[0]):
        return tyro.cli(flags, prog=name, args=words, description=f"{summary(command)} {terminal.FLAGS}")


def _module_name() -> str | None:
    """Return how to start a command that runs as a module; None for installed commands."""
    program = Path(sys.argv[0])
    return f"python -m {__package__}.{program.stem}" if program.parent == Path(__file__).parent else None


def switches(options: Any) -> set[str]:
    """Return the boolean flags of an options dataclass."""
    flags = set()
    for name, hint in get_type_hints(options).items():
        flags |= switches(hint) if is_dataclass(hint) else {f"--{name.replace('_', '-')}"} if hint is bool else set()
    return flags


def with_values(words: Sequence[str], flags: Collection[str]) -> list[str]:
    """Insert True after every boolean flag that has no value.

    >>> with_values(["--save", "--text", "a", "--stdin"], {"--save", "--stdin"})
    ['--save', 'True', '--text', 'a', '--stdin', 'True']
    """
    words_with_values = []
    for word, following in zip(words, [*words[1:], "--"]):
        words_with_values.append(word)
        if word.replace("_", "-") in flags and following.startswith("--"):
            words_with_values.append("True")
    return words_with_values


def plain(value: object) -> Text:
    """Return a prompt, path or name as rich text without markup."""
    return Text(visible(str(value)))


def say(text: str) -> None:
    """Print a line on standard output without wrapping."""
    CONSOLE.print(plain(text), soft_wrap=True)


def say_progress(text: str) -> None:
    """Print a progress message on standard output, unless --quiet is set."""
    if not terminal.now[-1].quiet:
        say(text)


def say_opening(*paths: Path) -> None:
    """Print which files are being opened, unless --quiet is set; on standard error, which programs do not parse."""
    if not terminal.now[-1].quiet:
        say_error("Opening " + ", ".join(map(str, paths)))


def say_error(text: str) -> None:
    """Print a message on standard error without wrapping."""
    with suppress(OSError):  # standard error is closed or full
        ERRORS.print(Text(visible(text)), soft_wrap=True)


def _flush(stream: TextIO | None, report: bool) -> int:
    """Flush a stream; return exit code 1 if that fails.

    Args:
        stream: The stream, or None.
        report: Print a message on failure, unless the reader has closed the pipe.
    """
    try:
        if stream is not None and not stream.closed:
            stream.flush()
        return 0
    except OSError as error:
        with suppress(OSError):  # keeps Python from flushing again at exit
            devnull = os.open(os.devnull, os.O_WRONLY)
            os.dup2(devnull, cast(TextIO, stream).fileno())
            os.close(devnull)
        if report and not isinstance(error, BrokenPipeError):
            say_error(_OUTPUT_ERROR.format(error.strerror))
        return USER


class _CheckedStream:
    """Standard output that raises OutputError if it cannot be written."""

    def __init__(self, stream: TextIO) -> None:
        self._stream = stream

    def __getattr__(self, name: str) -> Any:
        return getattr(self._stream, name)

    def write(self, text: str) -> int:
        with _output_errors():
            return self._stream.write(text)

    def flush(self) -> None:
        with _output_errors():
            self._stream.flush()


@contextmanager
def _output_errors() -> Iterator[None]:
    try:
        yield
    except BrokenPipeError:
        raise
    except OSError as error:
        raise OutputError(_OUTPUT_ERROR.format(error.strerror)) from error


@contextmanager
def _checked_output() -> Iterator[None]:
    stream = sys.stdout
    if stream is not None:
        sys.stdout = cast(TextIO, _CheckedStream(stream))
    try:
        yield
    finally:
        sys.stdout = stream


@contextmanager
def _sigterm_raises() -> Iterator[None]:
    """Let SIGTERM end this context with an exception, as Ctrl-C does."""

    def terminate(number: int, _frame: FrameType | None) -> None:
        signal.signal(number, signal.SIG_IGN)  # partial files are being removed
        raise Terminated

    if threading.current_thread() is not threading.main_thread():
        yield
        return
    before = signal.signal(signal.SIGTERM, terminate)
    try:
        yield
    finally:
        signal.signal(signal.SIGTERM, before or signal.SIG_DFL)


@contextmanager
def _plain_warnings() -> Iterator[None]:
    """Print our warnings as one line, and write deprecation warnings of other packages to the log file only.

    Other warnings of other packages stay unchanged.
    """
    with warnings.catch_warnings():
        default = warnings.showwarning

        def show(message: Warning | str, category: type[Warning], filename: str, *rest: Any, **more: Any) -> None:
            if filename.startswith(_PACKAGE):
                say_error(f"Warning: {message}")
            elif issubclass(category, DeprecationWarning | PendingDeprecationWarning | FutureWarning):
                terminal.log_line(warnings.formatwarning(message, category, filename, rest[0]))
            else:
                default(message, category, filename, *rest, **more)

        warnings.showwarning = show
        yield


@cache
def with_help(options: Any, *, nested: bool = False) -> Any:
    """Return an options dataclass with help texts from its docstrings.

    The docstring under each field becomes the help of its flag, and the first paragraph of the class docstring the help
    of a group. tyro reads docstrings itself, but keeps the line breaks of the source. Options nested in a group join
    that group.
    """
    hints = get_type_hints(options, include_extras=True)
    texts: dict[str, str] = {}
    for cls in filter(is_dataclass, reversed(options.__mro__)):  # a command may inherit flags
        params = docstring_parser.parse_from_object(cls).params
        texts |= {param.arg_name: param.description or "" for param in params}
    for field in fields(options):
        hint, text, name = hints[field.name], texts.get(field.name, ""), None
        if is_dataclass(hint):
            with_help(hint, nested=True)
            text, name = summary(hint), "" if nested else None
        options.__annotations__[field.name] = Annotated[hint, tyro.conf.arg(name=name, help=" ".join(text.split()))]
    return options


def summary(options: Any) -> str:
    """Return the first paragraph of a docstring as one line."""
    return " ".join((options.__doc__ or "").split("\n\n")[0].split())
