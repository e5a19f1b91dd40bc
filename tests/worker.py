"""What pytest-xdist starts instead of Python: the fork server of the session forks one, which has imported already.

``worker.py SOCKET -u -c CODE`` stays until that has ended, and that ends with it.
"""

import json
import os
import signal
import socket
import sys

if __name__ == "__main__":
    signal.signal(signal.SIGINT, signal.SIG_IGN)
    order = {"code": sys.argv[-1], "cwd": os.getcwd(), "env": dict(os.environ), "finalize": False}
    with socket.socket(socket.AF_UNIX, socket.SOCK_SEQPACKET) as server:
        server.connect(sys.argv[1])
        socket.send_fds(server, [json.dumps(order).encode()], [0, 1, 2])
        while said := server.recv(100).decode():
            what, pid, *code = said.split()
            if what == "ended":
                sys.exit(int(code[0]) % 256)
            signal.signal(signal.SIGINT, lambda *_, worker=int(pid): os.kill(worker, signal.SIGINT))
        sys.exit(1)
