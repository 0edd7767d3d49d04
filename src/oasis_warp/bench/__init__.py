"""Measure the operators: how fast they are, how exact, and what each threshold and option buys."""
