"""Files that ship with the package: the hand, the landmark networks, the learned prior, one photo."""

from importlib import resources
from importlib.resources.abc import Traversable


def asset(*parts: str) -> Traversable:
    """A bundled file, e.g. `asset("hand", "hand_right.npz")`; `importlib.resources.as_file` gives a path."""
    return resources.files(__package__).joinpath(*parts)
