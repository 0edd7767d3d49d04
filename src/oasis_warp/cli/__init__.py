"""The command line, `oasis`: one module a command."""

import sys
from collections.abc import Sequence


def main(arguments: Sequence[str] | None = None) -> int:
    """Run the command that `arguments` (the process's own when not given) ask for; the exit code."""
    try:
        from oasis_warp.cli.app import main as run  # its imports take a while, in which Ctrl-C may come

        return run(arguments)
    except KeyboardInterrupt:
        print("oasis: stopped, nothing written.", file=sys.stderr)
        return 130
