"""What the commands have in common: flags with their help, text that is shown as it is, and how they end."""

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
"""Results, on standard output. Nothing in a text is markup."""
if CONSOLE.is_terminal:  # tables fit into a narrower one; pipes and files get the full width
    CONSOLE.width = min(CONSOLE.width, shutil.get_terminal_size().columns)
ERRORS = Console(**_PLAIN, stderr=True)
STAGES = {"neighbors": "neighbours"}
"""Stages whose names are spelled otherwise in what people read."""
_TERMINATED = ("Terminated", signal.SIGTERM)
_CANNOT = "The output of the command cannot be written: {}. Send it to another place."
_PACKAGE = str(Path(normlift_ns.__file__).parent)


class Command(Protocol):
    """A command: a dataclass of its flags."""

    def main(self) -> object:
        """Does it."""
        ...


_Command = TypeVar("_Command", bound=Command)


class Terminated(BaseException):
    """The system wants the process to end: SIGTERM, as before a pre-emption."""


def run_command(command: type[Command]) -> None:
    """Reads the flags in the form of nerfstudio's commands (--flag True), runs the command and ends the process.

    Exit code 1: a mistake in flags or files, a full disk or memory. 70: a mistake of ours. 130 and 143: Ctrl-C and
    SIGTERM, after everything half-written is removed.
    """
    streams: tuple[Any, ...] = (sys.stdout, sys.stderr)
    for stream in streams:
        if hasattr(stream, "reconfigure"):
            stream.reconfigure(errors="replace")  # a code page without the character
    try:
        words, flags = terminal.terminal_flags(sys.argv[1:])
        with terminal.talking(flags, shlex.join(sys.argv)):
            code = _ended(command, words)
    except InputError as error:
        code = _explained(error)
    for stream in streams:
        code = _flushed(stream, tell=code == 0) or code
    if code != 0:
        sys.exit(code)


def run_process(command: type[Command]) -> NoReturn:
    """`run_command` for a process that does nothing else, and ends at once: taking torch down takes a second.

    OpenMP's threads, of torch and of compiled kernels, sleep while they wait. By default they run on without work, on
    cores that other threads and other lifts could use. A policy that the user has set stays.
    """
    os.environ.setdefault("OMP_WAIT_POLICY", "passive")  # read when torch is imported
    code: Any = 0
    try:
        run_command(command)
    except SystemExit as stop:
        code = stop.code
    atexit._run_exitfuncs()
    for stream in (sys.stdout, sys.stderr):
        _flushed(stream, tell=False)  # what those functions have printed
    os._exit(code)


def _ended(command: type[Command], words: list[str]) -> int:
    """Runs the command; the exit code."""
    try:
        with _terminable(), _plain_warnings(), _named_output(), named_as_flags():
            _run(command, words)
    except SystemExit as stop:  # tyro's own, after a help; rich's, where nobody reads the output
        return stop.code if isinstance(stop.code, int) else 0 if stop.code is None else USER
    except (KeyboardInterrupt, Terminated) as stop:
        word, number = ("Interrupted", signal.SIGINT) if isinstance(stop, KeyboardInterrupt) else _TERMINATED
        say_error(f"{word}. No partial files remain; rerun the command to resume.")
        return 128 + number
    except Exception as error:  # whatever it is: a traceback helps no user
        return _explained(error)
    return 0


def _explained(error: Exception) -> int:
    """Tells of an error; the exit code."""
    if isinstance(error, BrokenPipeError):  # nobody reads any more
        return USER
    message, code = (str(error), USER) if isinstance(error, OutputError) else explain(error)
    with suppress(OSError):
        ERRORS.print(Text("Error", style="bold red"))
    say_error(message)
    return code


def _run(command: type[Command], words: list[str]) -> None:
    if "--version" in words:
        say(f"normlift_ns {normlift_ns.__version__}")
        return
    tyro.extras.set_accent_color("bright_yellow")
    read_flags(command, words).main()


def read_flags(command: type[_Command], words: Sequence[str], name: str | None = None) -> _Command:
    """A command from the words behind its name.

    Args:
        name: of the command; None: as this process was started.
    Raises:
        InputError: words that it does not know.
        SystemExit: its help, with code 0.
    """
    name = name or _module_name()
    flags: Any = tyro.conf.OmitArgPrefixes[tyro.conf.FlagConversionOff[with_help(command)]]
    words = with_values(words, switches(command))
    helping = {"-h", "--help"} & set(words)
    with nullcontext() if helping else plain_errors(name or sys.argv[0]):
        return tyro.cli(flags, prog=name, args=words, description=f"{summary(command)} {terminal.FLAGS}")


def _module_name() -> str | None:
    """What starts a command that has no name of its own; None: the name under which it was started."""
    started = Path(sys.argv[0])
    return f"python -m {__package__}.{started.stem}" if started.parent == Path(__file__).parent else None


def switches(options: Any) -> set[str]:
    """The flags that are True or False."""
    found = set()
    for name, hint in get_type_hints(options).items():
        found |= switches(hint) if is_dataclass(hint) else {f"--{name.replace('_', '-')}"} if hint is bool else set()
    return found


def with_values(words: Sequence[str], flags: Collection[str]) -> list[str]:
    """The words of a command line, with True behind every one of the flags that stands alone.

    >>> with_values(["--save", "--text", "a", "--stdin"], {"--save", "--stdin"})
    ['--save', 'True', '--text', 'a', '--stdin', 'True']
    """
    found = []
    for word, following in zip(words, [*words[1:], "--"]):
        found.append(word)
        if word.replace("_", "-") in flags and following.startswith("--"):
            found.append("True")
    return found


def plain(value: object) -> Text:
    """A text, a path or a name for a table, shown as it is."""
    return Text(visible(str(value)))


def say(text: str) -> None:
    """One line on standard output, as long as it is."""
    CONSOLE.print(plain(text), soft_wrap=True)


def say_progress(text: str) -> None:
    """A line on standard output that tells of work, not of its results; nothing with --quiet."""
    if not terminal.now[-1].quiet:
        say(text)


def say_opening(*paths: Path) -> None:
    """The first sign of life, on standard error, which no program reads; nothing with --quiet."""
    if not terminal.now[-1].quiet:
        say_error("Opening " + ", ".join(map(str, paths)))


def say_error(text: str) -> None:
    """A message on standard error, as it is."""
    with suppress(OSError):  # nobody can be told
        ERRORS.print(Text(visible(text)), soft_wrap=True)


def _flushed(stream: TextIO | None, tell: bool) -> int:
    """Exit code 1 if what was printed cannot be written, with a message unless the reader has closed a pipe."""
    try:
        if stream is not None and not stream.closed:
            stream.flush()
        return 0
    except OSError as error:
        with suppress(OSError):  # so that Python does not try again at its end
            nowhere = os.open(os.devnull, os.O_WRONLY)
            os.dup2(nowhere, cast(TextIO, stream).fileno())
            os.close(nowhere)
        if tell and not isinstance(error, BrokenPipeError):
            say_error(_CANNOT.format(error.strerror))
        return USER


class _Output:
    """Standard output, whose errors say that they are of it."""

    def __init__(self, stream: TextIO) -> None:
        self._stream = stream

    def __getattr__(self, name: str) -> Any:
        return getattr(self._stream, name)

    def write(self, text: str) -> int:
        with _of_the_output():
            return self._stream.write(text)

    def flush(self) -> None:
        with _of_the_output():
            self._stream.flush()


@contextmanager
def _of_the_output() -> Iterator[None]:
    try:
        yield
    except BrokenPipeError:
        raise
    except OSError as error:
        raise OutputError(_CANNOT.format(error.strerror)) from error


@contextmanager
def _named_output() -> Iterator[None]:
    stream = sys.stdout
    if stream is not None:
        sys.stdout = cast(TextIO, _Output(stream))
    try:
        yield
    finally:
        sys.stdout = stream


@contextmanager
def _terminable() -> Iterator[None]:
    """SIGTERM ends what runs within as Ctrl-C does."""

    def terminate(number: int, _frame: FrameType | None) -> None:
        signal.signal(number, signal.SIG_IGN)  # what is half-written is being removed
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
    """Warnings of ours are one line. Of those of other packages, what concerns their programmers is for the log file
    alone; the rest stays as it is."""
    with warnings.catch_warnings():
        others = warnings.showwarning

        def show(message: Warning | str, category: type[Warning], filename: str, *rest: Any, **more: Any) -> None:
            if filename.startswith(_PACKAGE):
                say_error(f"Warning: {message}")
            elif issubclass(category, DeprecationWarning | PendingDeprecationWarning | FutureWarning):
                terminal.log_line(warnings.formatwarning(message, category, filename, rest[0]))
            else:
                others(message, category, filename, *rest, **more)

        warnings.showwarning = show
        yield


@cache
def with_help(options: Any, *, nested: bool = False) -> Any:
    """The dataclass, with the docstring under each field as the help of its flag, and the first paragraph of its own as
    the help of all of them.

    tyro reads docstrings itself, but keeps the line breaks that are there because lines of code are short. Options in
    the options of a command join their group.
    """
    hints = get_type_hints(options, include_extras=True)
    texts: dict[str, str] = {}
    for part in filter(is_dataclass, reversed(options.__mro__)):  # a command may have the flags of another
        found = docstring_parser.parse_from_object(part).params
        texts |= {param.arg_name: param.description or "" for param in found}
    for field in fields(options):
        hint, text, name = hints[field.name], texts.get(field.name, ""), None
        if is_dataclass(hint):
            with_help(hint, nested=True)
            text, name = summary(hint), "" if nested else None
        options.__annotations__[field.name] = Annotated[hint, tyro.conf.arg(name=name, help=" ".join(text.split()))]
    return options


def summary(options: Any) -> str:
    """The first paragraph of a docstring, in one line."""
    return " ".join((options.__doc__ or "").split("\n\n")[0].split())
