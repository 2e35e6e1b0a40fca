"""Compiled kernels: small, in the paper's letters, one compile policy (`policy`). Status codes out, the shell raises.

Times are int64 ms, blocks flat indices. Reservations and holds are half-open [enter, exit).
"""
