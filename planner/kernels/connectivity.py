"""Which blocks the buildings leave connected."""

import numpy as np

from planner.airmatrix import Int32Array, IntArray
from planner.kernels.policy import allocating_kernel


@allocating_kernel
def label_components(open_links: Int32Array, offset: IntArray) -> IntArray:
    """Number the connected components of blocks under open links (26 bits a block), by flooding."""
    component = np.full(open_links.shape[0], -1, dtype=np.int64)
    waiting = np.empty(open_links.shape[0], dtype=np.int64)
    for seed in range(open_links.shape[0]):
        if component[seed] >= 0:
            continue
        component[seed] = seed
        waiting[0] = seed
        count = 1
        while count > 0:
            count -= 1
            p = waiting[count]
            for link in range(26):
                n = p + offset[link]
                if (open_links[p] >> link) & 1 and component[n] < 0:
                    component[n] = seed
                    waiting[count] = n
                    count += 1
    return component
