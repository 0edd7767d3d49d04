"""The operators written out in plain float64 torch, a formula a line; gradients come from autograd."""
