"""The command line, `oasis`: one module a command."""

import atexit
import contextlib
import os
import sys
from collections.abc import Sequence
from typing import NoReturn


def main(arguments: Sequence[str] | None = None) -> int:
    """Run the command that `arguments` (the process's own when not given) ask for; the exit code."""
    # NumPy's threads spin while they wait, as torch's do (`core.processes`); read when NumPy is loaded.
    os.environ.setdefault("OPENBLAS_NUM_THREADS", "1")
    try:
        try:
            from oasis_warp.cli.app import main as run  # its imports take a while, in which Ctrl-C may come
        except OSError as error:  # too few files may be open, say
            print(f"oasis: cannot be loaded ({error.strerror}); check `ulimit -a`, or reinstall.", file=sys.stderr)
            return 1
        code = run(arguments)
    except KeyboardInterrupt:
        print("oasis: stopped, nothing was written.", file=sys.stderr)
        code = 130
    except BrokenPipeError:  # whoever read our output has gone, as `head` does
        os.dup2(os.open(os.devnull, os.O_WRONLY), 1)  # or Python complains when it flushes the rest
        return 141  # as shells count it: 128 + SIGPIPE
    if code == 130 and arguments is None:
        _leave(code)
    return code


def _leave(code: int) -> NoReturn:
    """End the process, but do not take apart what an interrupt has left half-loaded: that may crash."""
    atexit._run_exitfuncs()  # folders and processes that are to go
    for stream in (sys.stdout, sys.stderr):
        with contextlib.suppress(OSError, ValueError):
            stream.flush()
    os._exit(code)
