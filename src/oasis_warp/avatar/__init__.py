"""The canonical Gaussians of a hand: where they sit, how they look before any photo, how they follow a pose."""
