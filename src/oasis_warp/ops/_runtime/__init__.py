"""The machinery behind the public operators: declarations, launching, checks, backends. Private to `ops`."""
