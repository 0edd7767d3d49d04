"""Detect whether torch is tracing, so that tensors may be fake."""

import torch


def is_traced() -> bool:
    """Whether torch.compile, a dispatch or function mode (fake tensors, make_fx), functorch or a tracer is active.

    Then tensors may have no memory, and calls must be recorded; else shortcuts are allowed. Takes 0.5 us.
    """
    return bool(
        torch.compiler.is_compiling()
        or torch._C._len_torch_dispatch_stack()
        or torch._C._is_torch_function_mode_enabled()
        or torch._C._are_functorch_transforms_active()
        or torch._C._is_tracing()
    )
