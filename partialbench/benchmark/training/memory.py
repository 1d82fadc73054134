"""The C library's allocator, told to keep what a training step frees for the next one.

A step on the CPU allocates and frees the same tensors of many megabytes again and again. glibc
returns each to the kernel and gets it back page by page, zeroed: on two cores a step of
``papnet-steered`` took 1.8 times as long for it (``python -m benchmarks.memory``).
"""

from __future__ import annotations

import ctypes
import sys

# malloc.h: M_TRIM_THRESHOLD, M_TOP_PAD, M_MMAP_MAX.
_TRIM_THRESHOLD, _TOP_PAD, _MMAP_MAX = -1, -2, -4


def keep_freed_memory() -> bool:
    """Large blocks come from the heap, and the heap is not trimmed. For the whole process.

    Returns:
        whether the allocator took it: False where the C library is not glibc, which is no error.
    """
    if sys.platform != "linux":
        return False
    mallopt = getattr(ctypes.CDLL(None), "mallopt", None)
    if mallopt is None:
        return False
    settings = ((_MMAP_MAX, 0), (_TRIM_THRESHOLD, 2**31 - 1), (_TOP_PAD, 64 << 20))
    taken = [mallopt(name, value) == 1 for name, value in settings]
    return all(taken)
