"""What uses names of numba and LLVM that are not public; nothing of the kind is anywhere else.

`blocks`, `simd8` and `dual8` teach numba types of ours. The others make it compile in a quarter of the time, and keep
what it has compiled: without them it works too, see `closedloop.jit.plain_numba`.
"""
