"""What each command does; `oasis_warp.cli` reads the command line and calls `run(options)` of the one that is meant."""
