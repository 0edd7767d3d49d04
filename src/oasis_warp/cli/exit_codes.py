"""What the process tells the shell; 0 is success."""

FAULT = 1
"""`oasis doctor` found something broken, `oasis gradcheck` an error beyond its bound."""
BAD_INPUT = 2
"""Something the user gave cannot be used; one sentence on stderr says what. Also for a wrong command line."""
INTERRUPTED = 130
"""Stopped by Ctrl-C, as shells count: 128 + SIGINT."""
