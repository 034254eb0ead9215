"""The command ``colmap-tco``: flags, logging, progress and exit codes; the work is imported lazily."""

from __future__ import annotations

import argparse
import contextlib
import errno
import importlib
import json
import logging
import os
import signal
import sys
import threading
from collections.abc import Iterator, Mapping, Sequence
from datetime import datetime, timezone
from types import FrameType, TracebackType
from typing import Any, NoReturn

from colmap_tco import flags
from colmap_tco.commands import COMMANDS, Command
from colmap_tco.errors import (
    DensifyError,
    InputError,
    OutOfMemoryError,
    PartlyDoneError,
    UsageError,
    is_out_of_memory,
)
from colmap_tco.kernel_cache import ensure_kernel_cache
from colmap_tco.progress import Progress

logger = logging.getLogger(__name__)

INTERRUPTED = 130


class _Terminated(KeyboardInterrupt):
    """SIGTERM, which is treated as Ctrl-C is."""


def main(argv: Sequence[str] | None = None, commands: Mapping[str, Command] = COMMANDS) -> int:
    """Run the command line ``argv`` (without the program's name) and return the exit code.

    0 done, 1 unexpected error, 2 usage, 3 bad input, 4 out of memory, 5 weights or device missing,
    6 partly done, 130 interrupted.
    """
    words = flags.normalise(sys.argv[1:] if argv is None else argv)
    idle_threads_sleep()
    outcome = _Outcome()
    with outcome:
        options, _ = _global_options().parse_known_args(words)
        outcome.show_traceback = options.verbose > 0
        configure_logging(options.verbose - options.quiet, options.log_json)
        ensure_kernel_cache()
        name, given, config = _parse(words, commands)
        draw = _on_terminal() and not options.log_json and not options.quiet
        with _sigterm_interrupts(), Progress(bar=draw) as progress, _logging_beside_bar(draw):
            function = _load(commands[name].function)
            result = function(*given, config, progress)
        if result is not None:
            print(result.summary(), flush=True)
    return outcome.exit_code


def idle_threads_sleep() -> None:
    """Let OpenMP's threads soon sleep while they wait for work, unless the user has said otherwise.

    GNU's runtime lets a waiting thread spin for milliseconds. Where other programs want the cores too, each
    short parallel loop then waits for a thread that the system has stopped, and a run can take ten times as
    long; threads that sleep at once have to be woken for each loop. The runtime reads the variable when torch
    loads it, so this must come before.
    """
    if not {"OMP_WAIT_POLICY", "GOMP_SPINCOUNT"} & os.environ.keys():
        os.environ["GOMP_SPINCOUNT"] = SPINS


SPINS = "1000"
"""Turns of the loop in which a thread waits before it sleeps, some microseconds. With none, an idle machine
waits for threads to wake; with many, a busy one waits for threads that only wait. ``GOMP_SPINCOUNT`` in the
environment takes others, to compare."""


REFUSED = (errno.EACCES, errno.EPERM, errno.EROFS, errno.ENOSPC)
"""Errors of the system that the user can do something about."""


def exit_code(error: BaseException) -> int:
    """The exit code that tells a script what kind of failure ``error`` is."""
    if isinstance(error, DensifyError):
        return error.exit_code
    if isinstance(error, OSError) and error.errno in REFUSED and error.filename:
        return InputError.exit_code
    if isinstance(error, KeyboardInterrupt):
        return INTERRUPTED
    return OutOfMemoryError.exit_code if is_out_of_memory(error) else 1


def configure_logging(verbosity: int, log_json: bool) -> None:
    """Send log records to stderr: warnings below 0, INFO of this project at 0, DEBUG and COLMAP's log above.

    With ``log_json`` each record is one JSON object on a line, with ``time`` (UTC, ISO 8601),
    ``level``, ``logger``, ``message`` and what the record's ``data`` holds.
    """
    handler = logging.StreamHandler(sys.stderr)
    handler.setFormatter(_JsonFormatter() if log_json else _TextFormatter(verbosity > 0))
    logging.captureWarnings(True)
    logging.basicConfig(level=logging.WARNING, handlers=[handler], force=True)
    level = logging.DEBUG if verbosity > 0 else logging.INFO if verbosity == 0 else logging.WARNING
    for package in ("colmap_tco", "tco"):
        logging.getLogger(package).setLevel(level)
    # COLMAP writes to stderr by itself, and not in JSON.
    talkative = verbosity > 0 and not log_json
    logging.getLogger("pycolmap").setLevel(logging.INFO if talkative else logging.WARNING)


class _TextFormatter(logging.Formatter):
    """Plain sentences; the level in front from WARNING on, time and logger too where asked for."""

    def __init__(self, detailed: bool) -> None:
        super().__init__("%(asctime)s %(name)s: %(message)s" if detailed else "%(message)s")

    def format(self, record: logging.LogRecord) -> str:
        text = super().format(record)
        return f"{record.levelname.lower()}: {text}" if record.levelno >= logging.WARNING else text


class _JsonFormatter(logging.Formatter):
    """One JSON object a record."""

    def format(self, record: logging.LogRecord) -> str:
        entry: dict[str, Any] = {
            **getattr(record, "data", {}),
            "time": datetime.fromtimestamp(record.created, timezone.utc).isoformat(timespec="milliseconds"),
            "level": record.levelname.lower(),
            "logger": record.name,
            "message": record.getMessage(),
        }
        if record.exc_info:
            entry["traceback"] = self.formatException(record.exc_info)
        return json.dumps(entry, default=str)


class _Outcome:
    """The boundary at which every error becomes one sentence and an exit code."""

    def __init__(self) -> None:
        self.exit_code = 0
        self.show_traceback = False

    def __enter__(self) -> _Outcome:
        return self

    def __exit__(
        self, kind: type[BaseException] | None, error: BaseException | None, trace: TracebackType | None
    ) -> bool:
        if error is None or isinstance(error, SystemExit):
            return False
        self.exit_code = exit_code(error)
        # A mistyped flag needs no traceback.
        traceback = error if self.show_traceback and not isinstance(error, UsageError) else None
        logger.log(
            logging.WARNING if isinstance(error, PartlyDoneError) else logging.ERROR,
            _sentence(error, self.exit_code),
            exc_info=traceback,
            extra={"data": {"exit_code": self.exit_code}},
        )
        return True


def _sentence(error: BaseException, code: int) -> str:
    if isinstance(error, DensifyError):
        return str(error)
    if isinstance(error, OSError) and error.errno in REFUSED and error.filename:
        return (
            f"{error.filename}: the system refuses it ({error.strerror}); give the right to it or make room, "
            "or name another place for results (--output_path)"
        )
    if isinstance(error, _Terminated):
        return "stopped by SIGTERM"
    if code == INTERRUPTED:
        return "interrupted"
    told = f"{type(error).__name__}: {error}" if str(error) else type(error).__name__
    if code == OutOfMemoryError.exit_code:
        return f"out of memory ({told}); smaller images (--max_image_size) need less"
    return f"unexpected error, {told}; the option -v shows where it came from"


class _Parser(argparse.ArgumentParser):
    """A parser that raises instead of exiting, and takes no abbreviated flags."""

    def __init__(self, **settings: Any) -> None:
        super().__init__(**settings, allow_abbrev=False)

    def error(self, message: str) -> NoReturn:
        raise UsageError(f"{message}; see {self.prog} --help")


class _Version(argparse.Action):
    """Print the installed version and exit; the lookup is slow, so it is done only when asked for."""

    def __call__(
        self,
        parser: argparse.ArgumentParser,
        namespace: argparse.Namespace,
        values: str | Sequence[Any] | None,
        option_string: str | None = None,
    ) -> None:
        from importlib import metadata

        try:
            version = metadata.version("colmap-tco")
        except metadata.PackageNotFoundError:
            version = "of an uninstalled source tree"
        print(f"colmap-tco {version}")
        parser.exit()


def _global_options() -> _Parser:
    """The options of every command, accepted before and after its name."""
    parser = _Parser(prog="colmap-tco", add_help=False)
    parser.add_argument("-v", "--verbose", action="count", default=0, help="log details, show tracebacks")
    parser.add_argument("-q", "--quiet", action="count", default=0, help="log only warnings and errors")
    parser.add_argument("--log_json", action="store_true", help="log one JSON object a line on stderr")
    return parser


def _parse(words: list[str], commands: Mapping[str, Command]) -> tuple[str, list[Any], Any]:
    """(command, arguments, configuration) of a command line.

    Only the command that is named gets its flags, so that only its configuration is imported.

    Raises:
        UsageError: an unknown command, flag or value.
    """
    common = _global_options()
    parser = _Parser(
        prog="colmap-tco",
        description="The dense step after COLMAP, by test-time constrained optimisation.",
        epilog="Flags may be spelt with _ or -. 'colmap-tco COMMAND --help' tells those of a command.",
        parents=[common],
    )
    parser.add_argument(HELP_ALL, action="help", help=argparse.SUPPRESS)
    parser.add_argument("--version", action=_Version, nargs=0, help="print the version and exit")
    subparsers = parser.add_subparsers(dest="command", metavar="COMMAND", required=True)
    subs = {name: _add_command(subparsers, name, command, common) for name, command in commands.items()}
    # No global option takes a value, so the first bare word is the command.
    chosen = next((word for word in words if not word.startswith("-")), None)
    config_type: type | None = None
    known = ["--verbose", "--quiet", "--log_json", "--version", "--help", HELP_ALL]
    if chosen is not None and chosen in commands:
        config_type = _load(commands[chosen].config)
        told = () if HELP_ALL in words else commands[chosen].common.split()
        more = flags.add_flags(subs[chosen], config_type, told)
        if more:
            subs[chosen].epilog = f"{more} more flags, which most runs leave alone: {HELP_ALL}."
        known += [flag for setting in flags.settings(config_type) for flag in setting.flags]

    namespace, unknown = parser.parse_known_args(words)
    if unknown:
        raise UsageError(_unknown_message(unknown[0], known))
    given = [getattr(namespace, _STORED + a.name) for a in commands[namespace.command].arguments]
    return namespace.command, given, _build(config_type, namespace)


def _add_command(subparsers: Any, name: str, command: Command, common: _Parser) -> _Parser:
    """The parser of one command, without the flags of its configuration."""
    usage = " ".join(["%(prog)s", *(argument.shown for argument in command.arguments), "[flags]"])
    description = command.help[:1].upper() + command.help[1:] + "."
    sub: _Parser = subparsers.add_parser(
        name, help=command.help, description=description, usage=usage, parents=[common]
    )
    told = "show this help message with all flags and exit" if command.common else argparse.SUPPRESS
    sub.add_argument(HELP_ALL, action="help", help=told)
    for argument in command.arguments:
        sub.add_argument(
            _STORED + argument.name,
            metavar="{" + ",".join(argument.choices) + "}" if argument.choices else argument.name.upper(),
            type=argument.kind,
            choices=argument.choices,
            nargs="?" if argument.optional else None,
            help=argument.help,
        )
    return sub


HELP_ALL = "--help_all"
"""Where ``--help`` lists the common flags of a command alone, this lists all."""

_STORED = "positional "
"""Begins the names under which arguments are stored; the blank keeps them apart from those of settings."""


def _build(config_type: type | None, namespace: argparse.Namespace) -> Any:
    assert config_type is not None, "argparse accepts no command that is not in the table"
    try:
        return flags.build(config_type, namespace)
    except ValueError as error:
        raise UsageError(str(error)) from error


def _unknown_message(word: str, known: Sequence[str]) -> str:
    if not word.startswith("-"):
        return f"unexpected argument {word!r}"
    flag = word.partition("=")[0]
    match = flags.closest(flag, known)
    return f"unknown flag {flag}" + (f"; did you mean {match}?" if match else "")


def _on_terminal() -> bool:
    """Whether stderr is a terminal that a bar fits on; some containers give one of no width."""
    return sys.stderr.isatty() and os.get_terminal_size(sys.stderr.fileno()).columns > 0


def _load(path: str) -> Any:
    """The object that ``module:name`` names."""
    module, _, name = path.partition(":")
    return getattr(importlib.import_module(module), name)


@contextlib.contextmanager
def _sigterm_interrupts() -> Iterator[None]:
    """Let SIGTERM unwind the stack as Ctrl-C does, so that temporary files are removed."""
    if threading.current_thread() is not threading.main_thread():
        yield
        return

    def interrupt(number: int, frame: FrameType | None) -> NoReturn:
        raise _Terminated

    before = signal.signal(signal.SIGTERM, interrupt)
    try:
        yield
    finally:
        signal.signal(signal.SIGTERM, before)


@contextlib.contextmanager
def _logging_beside_bar(draw: bool) -> Iterator[None]:
    """Write log lines above the bar instead of through it."""
    if not draw:
        yield
        return
    from tqdm.contrib.logging import logging_redirect_tqdm

    with logging_redirect_tqdm():
        yield
