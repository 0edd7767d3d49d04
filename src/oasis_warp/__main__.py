"""`python -m oasis_warp` is `oasis`."""

import sys

from oasis_warp.cli import main

if __name__ == "__main__":
    sys.exit(main())
