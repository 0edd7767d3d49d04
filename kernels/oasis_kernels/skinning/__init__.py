"""Joint transforms and linear blend skinning."""
