"""The command line, `oasis`: read it, run the command, turn what goes wrong into one sentence and an exit code."""

import contextlib
import dataclasses
import importlib
import io
import logging
import os
import signal
import sys
import threading
import time
import traceback
from collections.abc import Sequence
from typing import Annotated, Any, NoReturn, Union, get_args

import tyro

from oasis_warp import __version__
from oasis_warp.cli import developer_options, options
from oasis_warp.cli.command_line import explain
from oasis_warp.cli.progress import BAD_INPUT, INTERRUPTED
from oasis_warp.cli.record import recorded, write_record
from oasis_warp.core.errors import InputError, did_you_mean, one_line, shortened

Command = (
    Annotated[options.Reconstruct, tyro.conf.subcommand("reconstruct")]
    | Annotated[options.Batch, tyro.conf.subcommand("batch")]
    | Annotated[options.Render, tyro.conf.subcommand("render")]
    | Annotated[options.Animate, tyro.conf.subcommand("animate")]
    | Annotated[options.Export, tyro.conf.subcommand("export")]
    | Annotated[options.Serve, tyro.conf.subcommand("serve")]
    | Annotated[options.View, tyro.conf.subcommand("view")]
    | Annotated[options.Edit, tyro.conf.subcommand("edit")]
    | Annotated[options.Info, tyro.conf.subcommand("info")]
    | Annotated[options.Compare, tyro.conf.subcommand("compare")]
    | Annotated[options.Text, tyro.conf.subcommand("text")]
    | Annotated[developer_options.Synthesize, tyro.conf.subcommand("synthesize")]
    | Annotated[developer_options.Pretrain, tyro.conf.subcommand("pretrain")]
    | Annotated[developer_options.Evaluate, tyro.conf.subcommand("evaluate")]
    | Annotated[developer_options.Gradcheck, tyro.conf.subcommand("gradcheck")]
    | Annotated[developer_options.Bench, tyro.conf.subcommand("bench")]
    | Annotated[developer_options.Doctor, tyro.conf.subcommand("doctor")]
)

STOPPED = "stopped, nothing was written."
OWN_JSON = (options.Info, developer_options.Gradcheck)
"""Commands whose --json holds what they found."""
SHORTAGES = {
    "the memory of {device} is full; use smaller sizes, or fewer at once.": (
        "MemoryError", "OutOfMemory", "out of memory", "can't allocate memory", "Cannot allocate memory",
        "Insufficient memory", "Failed to allocate", "failed to map segment", "bad allocation", "bad_alloc",
    ),
    "too many files are open; raise the limit (`ulimit -n 1024`).": ("Too many open files",),
    "a disk is full; free some space, also in the folder of temporary files.": ("No space left on device",),
    "the name of a file is too long for this disk; choose a shorter one.": ("File name too long",),
    "{device} failed, nothing was written; run `oasis doctor`.": ("CUDA error",),
}  # fmt: skip
"""Sentences, and what the system or packages say instead; the first counts, as CUDA calls full memory an error too."""
COMMANDS = tuple(get_args(command)[1].name for command in get_args(Command))


def main(arguments: Sequence[str] | None = None) -> int:
    """Run the command that `arguments` (the process's own when not given) ask for; the exit code."""
    arguments = sys.argv[1:] if arguments is None else list(arguments)
    open_standard_streams()
    if arguments == ["--version"]:
        print(f"oasis_warp {__version__}")
        return 0
    if arguments and not arguments[0].startswith("-") and arguments[0] not in COMMANDS:
        _refuse_command(arguments[0])
    chosen = _parse(arguments)
    logging.basicConfig(format="oasis: %(message)s")
    verbose = getattr(chosen, "verbose", False)
    logging.getLogger("oasis_warp").setLevel(logging.INFO if verbose else logging.WARNING)
    # A batch system's SIGTERM ends the work as Ctrl-C does: what is half-written is taken away.
    interrupted = threading.Event()

    def interrupt(number: int, frame: Any) -> NoReturn:
        interrupted.set()
        signal.default_int_handler(number, frame)

    before, start = {signal.SIGTERM: signal.signal(signal.SIGTERM, interrupt)}, time.monotonic()
    if signal.getsignal(signal.SIGINT) is signal.default_int_handler:  # else whoever started this ignores it
        before[signal.SIGINT] = signal.signal(signal.SIGINT, interrupt)
    try:
        with recorded(chosen, arguments) as record:
            code, message = _run(chosen, verbose, interrupted)
            if getattr(chosen, "json", None) is not None and not isinstance(chosen, OWN_JSON):
                write_record(chosen, record, code, message, start)
    except InputError as error:  # of the record
        code, message = BAD_INPUT, str(error)
    finally:
        for number, handler in before.items():
            signal.signal(number, handler)
    if message is not None:
        print(f"oasis: {message}", file=sys.stderr)
    return code


def _run(chosen: Any, verbose: bool, interrupted: threading.Event) -> tuple[int, str | None]:
    """Run a command; its exit code, and a sentence about what went wrong.

    Libraries of compiled code may turn Ctrl-C into another error, so every error after it counts as an interrupt.
    """
    try:
        # The command's module imports torch and Warp, which take seconds: only now.
        command = importlib.import_module(f"oasis_warp.cli.{type(chosen).__name__.lower()}")
        return command.run(chosen), None
    except KeyboardInterrupt:
        return INTERRUPTED, STOPPED
    except Exception as error:
        if interrupted.is_set():
            return INTERRUPTED, STOPPED
        if isinstance(error, InputError):
            if verbose:
                traceback.print_exc()
            return BAD_INPUT, str(error)
        if (message := what_ran_out(error)) is None:
            raise
        return BAD_INPUT, message.format(device=getattr(chosen, "device", "cpu"))


def _parse(arguments: Sequence[str]) -> Any:
    """The options of the command; exits after help, and with one sentence after a wrong command line."""
    said = io.StringIO()
    try:
        with contextlib.redirect_stderr(said):
            return tyro.cli(
                _overview() if arguments in (["--help"], ["-h"]) else Command,
                prog="oasis",
                description="One photo of a hand in, an animatable 3D Gaussian avatar out. Version "
                f"{__version__} (`oasis --version`). `oasis COMMAND --help` explains a command.",
                args=arguments,
                config=(tyro.conf.OmitArgPrefixes, tyro.conf.OmitSubcommandPrefixes, tyro.conf.FlagCreatePairsOff),
            )
    except SystemExit as stopped:
        if not stopped.code:
            raise
        print(f"oasis: {_explain(said.getvalue(), arguments)}", file=sys.stderr)
        raise SystemExit(BAD_INPUT) from None


def _explain(said: str, arguments: Sequence[str]) -> str:
    """One sentence about a wrong command line, from what tyro says about it."""
    kinds = {name.name: kind for kind, name in map(get_args, get_args(Command))}
    if not arguments or arguments[0] not in kinds:
        return explain(said, arguments, "oasis")
    parts = dataclasses.fields(kinds[arguments[0]])
    return explain(said, arguments, f"oasis {arguments[0]}", [f"--{part.name.replace('_', '-')}" for part in parts])


def _overview() -> Any:
    """`Command` with one line of help per command."""
    pairs = [get_args(command) for command in get_args(Command)]
    first = {named.name: (kind.__doc__ or "").split("\n\n")[0] for kind, named in pairs}
    short = [Annotated[kind, tyro.conf.subcommand(name.name, description=first[name.name])] for kind, name in pairs]
    return Union[tuple(short)]  # noqa: UP007 - a list of types


def _refuse_command(name: str) -> NoReturn:
    """Suggest the nearest command, or list all, and exit as after other wrong command lines."""
    hint = did_you_mean(name, COMMANDS).replace("Did", "did")
    answer = hint or f"expected one of {', '.join(COMMANDS)}."
    print(f"oasis: {one_line(shortened(name))!r} is not a command; {answer}", file=sys.stderr)
    raise SystemExit(BAD_INPUT)


def open_standard_streams() -> None:
    """Open the streams that whoever started this closed, or files opened next would get their numbers.

    Names of files that are no text can be printed.
    """
    for number, name in enumerate(("stdin", "stdout", "stderr")):
        try:
            os.fstat(number)
        except OSError:  # the lowest free number is taken
            os.open(os.devnull, os.O_RDWR)
        if getattr(sys, name) is None:
            setattr(sys, name, open(number, "r" if number == 0 else "w", closefd=False))
    if isinstance(sys.stdout, io.TextIOWrapper):
        sys.stdout.reconfigure(errors="backslashreplace")


def what_ran_out(error: BaseException | None) -> str | None:
    """A sentence about {device} on the missing resource (memory, disk, descriptors), if that made a library fail."""
    message = ""
    while error is not None:  # packages wrap what the system said
        message += f"{type(error).__name__} {error}\n"
        error = error.__cause__ or error.__context__
    return next((sentence for sentence, signs in SHORTAGES.items() if any(sign in message for sign in signs)), None)
