"""Conflict-free 4D path planning on an AirMatrix: numpy in, numpy out.

No clock, no network, no database and no global state: the only I/O is reading and writing airspace and
aircraft files.
"""
