"""One seed for a run, one generator for each source of randomness in it."""

import zlib

import numpy as np


def derive(seed: int, *names: str | int) -> int:
    """Return the seed of one source of randomness, such as ``derive(seed, "train", "noise")``; 63 bits.

    Sources with different names are independent, as are equal names under different seeds.
    """
    words = [seed, *(zlib.crc32(str(name).encode()) for name in names)]
    return int(np.random.SeedSequence(words).generate_state(1, np.uint64)[0] >> 1)
