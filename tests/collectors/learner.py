"""A program that collects, tells which processes do so for it, and learns nothing."""

import sys

from tests.collectors import parts

if __name__ == "__main__":
    source = parts.source(sys.argv[1], parts.actor(), parts.robots(1, 0), 10**9)
    for _ in source:
        print(*(process.pid for process in source.procs), flush=True)
