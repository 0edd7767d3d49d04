"""Whether torch merely follows what is called, so that tensors may be stand-ins."""

import torch


def is_traced() -> bool:
    """Whether torch.compile, a dispatch or function mode (fake tensors, make_fx), functorch or a tracer is at work.

    Then a call may see no memory, and has to leave its trace; else it may take any short way. Costs half a microsecond.
    """
    return bool(
        torch.compiler.is_compiling()
        or torch._C._len_torch_dispatch_stack()
        or torch._C._is_torch_function_mode_enabled()
        or torch._C._are_functorch_transforms_active()
        or torch._C._is_tracing()
    )
