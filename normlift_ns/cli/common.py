"""Shared parts of the commands: flags and their help, output, error messages and exit codes."""

from __future__ import annotations

import ast
import atexit
import inspect
import io
import os
import re
import shlex
import shutil
import signal
import sys
import threading
import time
import warnings
from argparse import ArgumentError, ArgumentParser
from collections.abc import Callable, Collection, Iterator, Sequence
from contextlib import AbstractContextManager, contextmanager, nullcontext, redirect_stderr, suppress
from dataclasses import fields, is_dataclass
from datetime import datetime
from functools import cache
from itertools import pairwise
from pathlib import Path
from types import FrameType
from typing import IO, Annotated, Any, NamedTuple, NoReturn, Protocol, TextIO, TypeVar, cast, get_type_hints

import tyro
from rich.console import Console
from rich.text import Text

import normlift_ns
from normlift_ns.errors import EXIT_USER_ERROR, InputError, OutputError, describe_error, escape_unprintable
from normlift_ns.io.guard import forget_inputs, open_regular, protect_inputs, refuse_inputs
from normlift_ns.io.memory import check_free_memory
from normlift_ns.options import VOTE_FLAGS, RefineConfig, named_as_flags, rename_flags, renamed_flags

_CORNERS = ("╭", "┏")
_REWRITES = (
    (r"Error parsing (--\S+): no type matching \S+ could be instantiated from \[(.*)\]\.", r"\1 cannot be \2."),
    (r"Error parsing (--\S+): (?:invalid literal|could not convert).*?: ('.*')$", r"\1 cannot be \2."),
    (r"Error parsing \S+: (?=--)", r""),
    (r"invalid choice ('.*?') for argument '(--\S+)'\.", r"\2 cannot be \1."),
    (r"Expected one of \((.*?),?\)\.", r"Expected one of \1."),
    (r"Missing value for argument '(--\S+)'\. Expected 1 values\.", r"\1 needs a value."),
    (r"Missing from (\S+):", r"\1 needs:"),
    (r"Unrecognized options:", r"Unknown options:"),
    (r"\n+ *Got errors:(?:\n *- .*)*", r""),
    (r" *Argument helptext:\n", r""),
    (r"^ {3,}(--\S+ \S.*)\n +", r"\1: "),
    (r"For full helptext, (?:run|see):?\s+(\S.*?) --help", r"\n\nAll options: \1 --help"),
)
"""Patterns of tyro's messages, with replacements. Messages that match no pattern stay unchanged."""


@contextmanager
def one_line_errors(program: str) -> Iterator[None]:
    """Raise InputError if tyro prints an error in a box and exits; print tyro's warnings at the end.

    Args:
        program: Program name that tyro prints. Messages show it without its folder.
    """
    stderr, columns = io.StringIO(), os.environ.get("COLUMNS")
    os.environ["COLUMNS"] = "1000"  # keeps tyro from wrapping lines
    try:
        with redirect_stderr(stderr):
            yield
        sys.stderr.write(stderr.getvalue())
    except SystemExit as stop:
        if stop.code in (None, 0):
            raise
        raise InputError(_unboxed(stderr.getvalue(), program)) from None
    finally:
        os.environ.pop("COLUMNS")
        if columns is not None:
            os.environ["COLUMNS"] = columns


def _unboxed(stderr: str, program: str) -> str:
    r"""Return the text inside a box of tyro, or below its dashed line if the terminal has no box characters.

    >>> print(_unboxed("╭─ Missing ─╮\n│ Missing value for argument '--data'. Expected 1 values. │\n╰─────╯", "/bin/x"))
    --data needs a value.
    >>> print(_unboxed(" Missing\n -----\n  Missing value for argument '--vote-k'. Expected 1 values.\n", "/bin/x"))
    --vote-k needs a value.
    """
    stderr = re.sub(r"\x1b\[[\d;]*m", "", stderr)  # terminal colors
    lines = stderr.splitlines()
    lines = lines[1:-1] if stderr.startswith(_CORNERS) else lines[2:]
    lines = [line.strip("│┃").removeprefix(" ").rstrip(" ─━") for line in lines]
    text = "\n".join("" if set(line) <= set(" -") else line for line in lines)
    text = text.replace(program, Path(program).name)
    for pattern, replacement in _REWRITES:
        text = re.sub(pattern, replacement, text, flags=re.MULTILINE)
    parts = [" ".join(part.split()) for part in text.split("\n\n")]
    return " ".join(part if part.endswith((".", ":", "--help")) else f"{part}." for part in parts if part)


OUTPUT_FLAGS_HELP = (
    "Every command accepts --quiet (print results, warnings and errors, but no progress), --log-file FILE (append all "
    "output to this file, including the warnings of other packages) and --version."
)
_ESCAPES = re.compile(r"\x1b\[[0-9;?]*[A-Za-z]")
"""Terminal escape sequences that set colors or move the cursor."""


_LOG_LINE = re.compile(rb"\d{4}-\d\d-\d\dT\d\d:\d\d:\d\d[+-]\d\d:\d\d .*normlift")
"""Pattern of the first line of a log, which has the time and the command."""


class OutputSettings(NamedTuple):
    """Output settings of a command."""

    quiet: bool = False
    log_file: Path | None = None


output_settings = [OutputSettings()]
"""Stack of output settings. The last entry belongs to the running command."""


def split_output_flags(words: Sequence[str]) -> tuple[list[str], OutputSettings]:
    """Split a command line into the words without output flags and the output settings.

    Raises:
        InputError: --log-file has no value, or --quiet is neither True nor False.

    >>> split_output_flags(["--vote-k", "8", "--quiet", "--log-file", "a.log"])
    (['--vote-k', '8'], OutputSettings(quiet=True, log_file=PosixPath('a.log')))
    """
    end = words.index("--") if "--" in words else len(words)  # the rest is for another command
    parser = ArgumentParser(add_help=False, allow_abbrev=False, exit_on_error=False)
    parser.add_argument("--quiet", nargs="?", const="True", default="False")
    parser.add_argument("--log-file", "--log_file", type=Path)
    try:
        flags, rest = parser.parse_known_args(words[:end])
    except ArgumentError:
        raise InputError("--log-file has no value; give a file name") from None
    if flags.quiet not in ("True", "False"):
        raise InputError(f"--quiet must be True or False, got {flags.quiet!r}")
    return [*rest, *words[end:]], OutputSettings(flags.quiet == "True", flags.log_file)


@contextmanager
def apply_output_settings(terminal: OutputSettings, command: str) -> Iterator[None]:
    """Apply output settings to everything that runs in this context.

    Raises:
        InputError: The log file cannot be written, or the path is not suitable for a log.
    """
    stdout, stderr = sys.stdout, sys.stderr
    with nullcontext() if terminal.log_file is None else _open_log(terminal.log_file) as log:
        if log is not None:
            log.write(f"{datetime.now().astimezone().isoformat(timespec='seconds')} normlift_ns: {command}\n")
        sys.stdout = cast(Any, _OutputStream(stdout, log, _output_errors))
        sys.stderr = cast(Any, _OutputStream(stderr, log, nullcontext))
        output_settings.append(terminal)
        try:
            yield
        finally:
            output_settings.pop()
            sys.stdout, sys.stderr = stdout, stderr


def _open_log(path: Path) -> IO[str]:
    """Open a log file to append to. It must be new, empty or an earlier log, and not an input of the command."""
    try:
        if os.path.lexists(path) and not path.is_file():
            raise InputError(f"{path}, given with --log-file, exists and is not a regular file; give another name")
        refuse_inputs([path], instead="--log-file")
        arguments = [os.path.realpath(word.partition("=")[2] or word) for word in sys.argv[1:]]
        if arguments.count(os.path.realpath(path)) > 1:
            raise InputError(f"{path}, given with --log-file, is also given as another argument; give another name")
        if path.exists():
            with open_regular(path) as file:
                first = file.readline(2**16)
            if first != b"" and _LOG_LINE.match(first) is None:
                raise InputError(f"{path}, given with --log-file, is not a log of normlift_ns; give another name")
        protect_inputs(path)
        return path.open("a", encoding="utf8", errors="backslashreplace")
    except OSError as error:
        raise InputError(
            f"{path}, given with --log-file, cannot be opened ({error.strerror}); give another name"
        ) from error


class _OutputStream:
    """Stream that also writes its output to the log file, if there is one, without escape sequences."""

    def __init__(
        self, stream: IO[str], log: IO[str] | None, errors: Callable[[], AbstractContextManager[None]]
    ) -> None:
        self._stream, self.log, self._errors = stream, log, errors

    def __getattr__(self, name: str) -> Any:
        return getattr(self._stream, name)

    def write(self, text: str) -> int:
        if self.log is not None:
            self.log.write(_ESCAPES.sub("", text))
        with self._errors():
            return self._stream.write(text)

    def flush(self) -> None:
        with self._errors():
            self._stream.flush()


@contextmanager
def _output_errors() -> Iterator[None]:
    """Raise OutputError if standard output cannot be written, but pass on errors of a closed pipe."""
    try:
        yield
    except BrokenPipeError:
        raise
    except OSError as error:
        raise OutputError(_OUTPUT_ERROR.format(error.strerror)) from error


_PLAIN: dict[str, Any] = {"width": 120, "markup": False, "emoji": False, "highlight": False}
CONSOLE = Console(**_PLAIN)
"""Console for results on standard output. It prints markup literally."""
if CONSOLE.is_terminal:  # tables fit the terminal; pipes and files get the full width
    CONSOLE.width = max(40, min(CONSOLE.width, shutil.get_terminal_size().columns))
ERROR_CONSOLE = Console(**_PLAIN, stderr=True)

_OUTPUT_ERROR = "The output of the command cannot be written: {}. Redirect it to another file."
_PACKAGE = str(Path(normlift_ns.__file__).parent)
_MIN_MEMORY = 2**28
"""Minimum free memory of a command in bytes. --help and --version need less."""


class CommandProtocol(Protocol):
    """Command, as a dataclass of its flags."""

    def main(self) -> object:
        """Run the command."""
        ...


_Command = TypeVar("_Command", bound=CommandProtocol)


class TerminatedError(BaseException):
    """Exception for SIGTERM, which a scheduler sends before preemption, for example."""


_SIGNALS: dict[type, signal.Signals] = {KeyboardInterrupt: signal.SIGINT, TerminatedError: signal.SIGTERM}


def run_command(command: type[CommandProtocol]) -> None:
    """Parse flags as nerfstudio's commands do (--flag True), run the command, and exit unless it succeeds.

    The exit code is 1 for user errors and for a full disk or memory, and 70 for internal errors. It is 130 for Ctrl-C
    and 143 for SIGTERM; both remove partial files first.
    """
    sys.stdout = sys.stdout or open(os.devnull, "w")  # noqa: SIM115 (closed by the caller)
    sys.stderr = sys.stderr or open(os.devnull, "w")  # noqa: SIM115
    streams: tuple[Any, ...] = (sys.stdout, sys.stderr)
    for stream in streams:
        if hasattr(stream, "reconfigure"):
            stream.reconfigure(errors="replace")  # for code pages that lack a character
    forget_inputs()
    try:
        words, flags = split_output_flags(sys.argv[1:])
        with apply_output_settings(flags, shlex.join(sys.argv)):
            code = _exit_code(command, words)
    except InputError as error:
        code = _report_error(error)
    for stream in streams:
        code = _flush(stream, report=code == 0) or code
    if code != 0:
        sys.exit(code)


def run_command_process(command: type[CommandProtocol]) -> NoReturn:
    """Run a command as the only task of this process, and exit without torch's teardown, which takes a second.

    Idle OpenMP threads of torch and of compiled kernels sleep instead of spinning, to leave the cores to other threads
    and processes. A policy that the user set in OMP_WAIT_POLICY takes precedence.
    """
    os.environ.setdefault("OMP_WAIT_POLICY", "passive")  # read when torch is imported
    _process_starts.append(time.perf_counter() - _process_age())
    code: Any = 0
    try:
        run_command(command)
    except SystemExit as stop:
        code = stop.code
    except KeyboardInterrupt:
        code = 128 + signal.SIGINT
    for number in (signal.SIGINT, signal.SIGTERM):
        signal.signal(number, signal.SIG_IGN)  # the command has ended
    atexit._run_exitfuncs()
    for stream in (sys.stdout, sys.stderr):
        _flush(stream, report=False)  # output of the exit functions
    os._exit(code)


_process_starts: list[float] = []
"""Start of the command's process as a value of `time.perf_counter`; empty if the command is called as a function."""


def command_start() -> float:
    """Return the time at which the process of this command started, as a value of `time.perf_counter`.

    Return the current time if the command is called as a function.
    """
    return _process_starts[-1] if len(_process_starts) > 0 else time.perf_counter()


def _process_age() -> float:
    """Return the seconds since the start of this process, or 0 if the system does not report it."""
    with suppress(OSError, AttributeError, ValueError, IndexError):
        ticks = int(Path("/proc/self/stat").read_text().rpartition(")")[2].split()[19])
        return time.clock_gettime(time.CLOCK_BOOTTIME) - ticks / os.sysconf("SC_CLK_TCK")
    return 0.0


def _exit_code(command: type[CommandProtocol], words: list[str]) -> int:
    """Run the command and return the exit code."""
    try:
        with _sigterm_raises(), _plain_warnings(), named_as_flags():
            if "--version" in words:
                info(f"normlift_ns {normlift_ns.__version__}")
            else:
                tyro.extras.set_accent_color("bright_yellow")
                parsed = parse_flags(command, words)
                check_free_memory(_MIN_MEMORY, "A command")
                parsed.main()
    except SystemExit as stop:  # from tyro after --help, or from rich if the output pipe is closed
        return stop.code if isinstance(stop.code, int) else 0 if stop.code is None else EXIT_USER_ERROR
    except (KeyboardInterrupt, TerminatedError) as stop:
        word, number = "Interrupted" if isinstance(stop, KeyboardInterrupt) else "Terminated", _SIGNALS[type(stop)]
        print_error(f"{word}. No partial outputs remain; rerun the command.")
        return 128 + number
    except Exception as error:  # print a message instead of a traceback
        return _report_error(error)
    return 0


def _report_error(error: Exception) -> int:
    """Print an error and return the exit code."""
    if isinstance(error, BrokenPipeError):  # the reader closed the pipe
        return EXIT_USER_ERROR
    message, code = (str(error), EXIT_USER_ERROR) if isinstance(error, OutputError) else describe_error(error)
    with suppress(OSError):
        ERROR_CONSOLE.print(Text("Error", style="bold red"))
    print_error(message)
    return code


def parse_flags(command: type[_Command], arguments: Sequence[str], name: str | None = None) -> _Command:
    """Parse the words after the name of a command.

    Args:
        command: Dataclass of the command.
        arguments: Words of the command line.
        name: Name of the command. If None, use the name that started this process.
    Raises:
        InputError: A flag or a value is not valid.
        SystemExit: The help was printed. The exit code is 0.
    """
    program = Path(sys.argv[0])
    if name is None and program.parent == Path(__file__).parent:  # started as a module
        name = f"python -m {__package__}.{program.stem}"
    flags: Any = tyro.conf.OmitArgPrefixes[tyro.conf.FlagConversionOff[add_help_texts(command)]]  # pyrefly: ignore[invalid-annotation]
    arguments = fill_boolean_values(rename_flags(arguments, renamed_flags(command)), boolean_flags(command))
    prints_help = {"-h", "--help"} & set(arguments)
    with _legible_help() if prints_help else one_line_errors(name or sys.argv[0]):
        return tyro.cli(flags, prog=name, args=arguments, description=f"{first_paragraph(command)} {OUTPUT_FLAGS_HELP}")


@contextmanager
def _legible_help() -> Iterator[None]:
    """Print help with at least 40 columns, because tyro never finishes a layout with fewer."""
    columns = os.environ.get("COLUMNS")
    os.environ["COLUMNS"] = str(max(40, shutil.get_terminal_size().columns))
    try:
        yield
    finally:
        os.environ.pop("COLUMNS")
        if columns is not None:
            os.environ["COLUMNS"] = columns


def boolean_flags(options: Any) -> set[str]:
    """Return the boolean flags of an options dataclass and its groups, such as --refine."""
    flags = set()
    for name, hint in get_type_hints(options).items():
        flags |= (
            boolean_flags(hint) if is_dataclass(hint) else {f"--{name.replace('_', '-')}"} if hint is bool else set()
        )
    return flags


def fill_boolean_values(words: Sequence[str], flags: Collection[str]) -> list[str]:
    """Insert True after every boolean flag that has no value.

    >>> fill_boolean_values(["--save-query", "--text", "a", "--stdin"], {"--save-query", "--stdin"})
    ['--save-query', 'True', '--text', 'a', '--stdin', 'True']
    """
    words_with_values = []
    for word, following in zip(words, [*words[1:], "--"]):
        words_with_values.append(word)
        if word.replace("_", "-") in flags and following.startswith("--"):
            words_with_values.append("True")
    return words_with_values


def plain_text(value: object) -> Text:
    """Return a prompt, path or name as rich text without markup."""
    return Text(escape_unprintable(str(value)))


def format_number(value: float | Sequence[float] | None) -> str:
    """Format a number or a vector as a table cell; None and an empty vector become a dash.

    >>> format_number(0.12345), format_number([1, 2.5]), format_number(None)
    ('0.123', '1.00 2.50', '-')
    """
    if isinstance(value, Sequence):
        return " ".join(f"{x:.2f}" for x in value) or "-"
    return "-" if value is None else f"{value:.3f}"


def info(text: str) -> None:
    """Print a line on standard output without wrapping."""
    CONSOLE.print(plain_text(text), soft_wrap=True)


def info_progress(text: str) -> None:
    """Print a progress message on standard output, unless --quiet is set."""
    if not output_settings[-1].quiet:
        info(text)


def info_opening(*paths: Path) -> None:
    """Print which files the command opens, unless --quiet is set.

    The message goes to standard error, which programs do not parse.
    """
    if not output_settings[-1].quiet:
        print_error("Opening " + ", ".join(map(str, paths)))


def print_error(text: str) -> None:
    """Print a message on standard error without wrapping."""
    with suppress(OSError):  # standard error is closed or full
        ERROR_CONSOLE.print(Text(escape_unprintable(text)), soft_wrap=True)


def _flush(stream: TextIO | None, report: bool) -> int:
    """Flush a stream; return exit code 1 if that fails, else 0.

    Args:
        stream: Stream to flush, or None.
        report: Print a message on failure, unless the reader closed the pipe.
    """
    try:
        if stream is not None and not stream.closed:
            stream.flush()
        return 0
    except OSError as error:
        with suppress(OSError):  # prevents a second flush at exit
            devnull = os.open(os.devnull, os.O_WRONLY)
            os.dup2(devnull, cast(TextIO, stream).fileno())
            os.close(devnull)
        if report and not isinstance(error, BrokenPipeError):
            print_error(_OUTPUT_ERROR.format(error.strerror))
        return EXIT_USER_ERROR


@contextmanager
def _sigterm_raises() -> Iterator[None]:
    """Raise TerminatedError in this context on SIGTERM, as Ctrl-C raises KeyboardInterrupt."""

    def terminate(number: int, _frame: FrameType | None) -> None:
        signal.signal(number, signal.SIG_IGN)  # do not interrupt the removal of partial files
        raise TerminatedError

    if threading.current_thread() is not threading.main_thread():
        yield
        return

    def report(ignored: Any) -> None:
        number = _SIGNALS.get(ignored.exc_type)
        if number is None:
            hook(ignored)
        else:  # raised during the deletion of an object; Python prints such exceptions and continues
            signal.signal(signal.SIGTERM, terminate)
            again.append(threading.Timer(0.01, signal.raise_signal, (number,)))
            again[-1].start()

    again, hook, sys.unraisablehook = list[threading.Timer](), sys.unraisablehook, report
    before = signal.signal(signal.SIGTERM, terminate)
    try:
        yield
    finally:
        try:
            for timer in again:  # their signals must not arrive after this context
                timer.join()
        finally:
            signal.signal(signal.SIGTERM, before or signal.SIG_DFL)
            sys.unraisablehook = hook


@contextmanager
def _plain_warnings() -> Iterator[None]:
    """Print each warning of this package as one line.

    Deprecation warnings of other packages go to the log file only. Other warnings of these packages stay unchanged.
    """
    with warnings.catch_warnings():
        default = warnings.showwarning

        def show(message: Warning | str, category: type[Warning], filename: str, *rest: Any, **more: Any) -> None:
            if filename.startswith(_PACKAGE):
                print_error(f"Warning: {message}")
            elif issubclass(category, DeprecationWarning | PendingDeprecationWarning | FutureWarning):
                if (log := getattr(sys.stderr, "log", None)) is not None:
                    log.write(warnings.formatwarning(message, category, filename, rest[0]))
            else:
                default(message, category, filename, *rest, **more)

        warnings.showwarning = show
        yield


@cache
def add_help_texts(options: Any, *, nested: bool = False) -> Any:
    """Add help texts from docstrings to an options dataclass, and return the dataclass.

    The docstring under each field becomes the help of its flag. The first paragraph of a class docstring becomes the
    help of its group. tyro reads docstrings itself, but keeps the line breaks of the source. Options nested in a group
    join that group.
    """
    hints = get_type_hints(options, include_extras=True)
    texts: dict[str, str] = {}
    for cls in filter(is_dataclass, reversed(options.__mro__)):  # a command may inherit flags
        texts |= field_docstrings(cls)
    for field in fields(options):
        hint, text = hints[field.name], texts.get(field.name, "")
        name = VOTE_FLAGS.get(field.name) if options is RefineConfig else None
        if is_dataclass(hint):
            add_help_texts(hint, nested=True)
            text, name = first_paragraph(hint), "" if nested else None
        default = "(default: none)" if field.default == () else None
        conf = tyro.conf.arg(name=name, help=" ".join(text.split()), help_behavior_hint=default)
        options.__annotations__[field.name] = Annotated[hint, conf]
    return options


@cache
def _class_definitions(module: str) -> dict[str, list[ast.stmt]]:
    """Return the statements of each top-level class of a loaded module, by class name; empty without its source."""
    with suppress(OSError, TypeError):  # TypeError: the module has no file
        tree = ast.parse(inspect.getsource(sys.modules[module]))
        return {node.name: node.body for node in tree.body if isinstance(node, ast.ClassDef)}
    return {}


def field_docstrings(options: Any) -> dict[str, str]:
    """Return the docstring under each field of a dataclass, by the name of the field."""
    texts: dict[str, str] = {}
    for field, text in pairwise(_class_definitions(options.__module__).get(options.__name__, [])):
        if isinstance(field, ast.AnnAssign) and isinstance(text, ast.Expr) and isinstance(text.value, ast.Constant):
            texts[ast.unparse(field.target)] = str(text.value.value)
    return texts


def first_paragraph(options: Any) -> str:
    """Return the first paragraph of the docstring of a class as one line."""
    return " ".join((options.__doc__ or "").split("\n\n")[0].split())
