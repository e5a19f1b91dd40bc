"""What pytest-xdist starts instead of Python: one that the session's forge forks, which has imported already.

``worker.py SOCKET -u -c CODE`` stays until that has ended, and that ends with it.
"""

import json
import os
import signal
import socket
import sys

if __name__ == "__main__":
    signal.signal(signal.SIGINT, signal.SIG_IGN)  # Ctrl-C is for who started it
    order = {"code": sys.argv[-1], "cwd": os.getcwd(), "env": dict(os.environ)}
    with socket.socket(socket.AF_UNIX, socket.SOCK_SEQPACKET) as forge:
        forge.connect(sys.argv[1])
        socket.send_fds(forge, [json.dumps(order).encode()], [0, 1, 2])
        while said := forge.recv(100):
            what, _, *code = said.split()
            if what == b"ended":
                sys.exit(int(code[0]) % 256)
        sys.exit(1)
