"""The command line, `oasis`: one module a command."""

from oasis_warp.cli.app import main as main
