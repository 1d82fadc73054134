"""LZF, as PCD files are packed with: LibLZF's format, read.

h5py has a decoder too, but it is sealed in an HDF5 filter, which does not say when the data end
early.
"""

from __future__ import annotations

from partialbench.errors import InputError


def decompress(packed: bytes, size: int) -> bytes:
    """The ``size`` bytes that were packed.

    Source: LibLZF 3.6, lzf_d.c: a control byte below 32 precedes that many bytes and one more; else
    its upper three bits (7: and the next byte) say how many are repeated, its lower five and the
    byte behind how far back they begin.

    Raises:
        InputError: the data end early, reach back before their beginning, or give another size.
    """
    out = bytearray()
    at, end = 0, len(packed)
    try:
        while at < end:
            control = packed[at]
            at += 1
            if control < 32:
                if at + control + 1 > end:
                    raise IndexError
                out += packed[at : at + control + 1]
                at += control + 1
                continue
            length = control >> 5
            if length == 7:
                length += packed[at]
                at += 1
            start = len(out) - ((control & 31) << 8) - packed[at] - 1
            at += 1
            length += 2
            if start < 0:
                raise InputError("the packed data are damaged: they reach back before their start")
            # What is repeated may reach into what the repeat itself writes.
            step = out[start : start + length]
            while len(step) < length:
                step += step[: length - len(step)]
            out += step
            if len(out) > size:
                break
    except IndexError:
        raise InputError("the packed data end early") from None
    if len(out) != size:
        raise InputError(f"the packed data give {len(out)} bytes, {size} were said")
    return bytes(out)
