"""The machinery behind the public operators: launching, registration, checks, back ends. Private to `ops`."""
