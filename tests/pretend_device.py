"""A device that is not there: its tensors are kept in this machine's memory, and may not meet those of the CPU.

It stands in for a GPU: whatever runs here has all its operands on one device wherever an operation needs that.
"""

import torch
from torch.utils._python_dispatch import TorchDispatchMode, return_and_correct_aliasing
from torch.utils._pytree import tree_iter, tree_map

DEVICE = torch.device("lazy")  # a name that PyTorch knows and needs no driver for

_CROSSING = {torch.ops.aten._to_copy.default, torch.ops.aten.copy_.default}


class There(torch.Tensor):
    """A tensor on the device; ``kept`` is what it holds."""

    @staticmethod
    def __new__(cls, kept):
        return torch.Tensor._make_wrapper_subclass(
            cls,
            kept.shape,
            strides=kept.stride(),
            storage_offset=kept.storage_offset(),
            dtype=kept.dtype,
            device=DEVICE,
        )

    def __init__(self, kept):
        self.kept = kept

    @classmethod
    def __torch_dispatch__(cls, func, types, args=(), kwargs=None):
        return _run(func, args, kwargs or {})

    def __repr__(self, **_):
        return f"There({self.kept})"


class PretendDevice(TorchDispatchMode):
    """While it lasts, tensors may be made on ``DEVICE`` and moved there."""

    def __enter__(self):
        # Tensors of Python's numbers are then made on the CPU and moved, which `_run` sees; else PyTorch makes them
        # on the device itself.
        torch._C._set_only_lift_cpu_tensors(True)
        return super().__enter__()

    def __exit__(self, *reason):
        torch._C._set_only_lift_cpu_tensors(False)
        return super().__exit__(*reason)

    def __torch_dispatch__(self, func, types, args=(), kwargs=None):
        return _run(func, args, kwargs or {})


def _run(func, args, kwargs):
    """An operation on what the tensors hold; its results are where its operands are, or where it is told to be."""
    given = [value for value in tree_iter((args, kwargs)) if isinstance(value, torch.Tensor)]
    there = any(isinstance(value, There) for value in given)
    here = [value for value in given if not isinstance(value, There) and value.dim() > 0]  # numbers may come along
    if there and here and func not in _CROSSING:
        raise RuntimeError(f"{func} was given tensors of the device and of the CPU")
    told = kwargs.get("device")
    there = there if told is None else torch.device(told).type == DEVICE.type
    plain = kwargs if told is None else kwargs | {"device": torch.device("cpu")}
    plain_args, plain = tree_map(lambda value: value.kept if isinstance(value, There) else value, (args, plain))
    result = func(*plain_args, **plain)
    if not there or result is None:
        return result
    wrapped = tree_map(lambda value: There(value) if isinstance(value, torch.Tensor) else value, result)
    return return_and_correct_aliasing(func, args, kwargs, wrapped)
