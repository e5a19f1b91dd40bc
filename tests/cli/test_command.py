"""How commands end."""

import signal
import subprocess
import sys


def test_what_nohup_started_goes_on_when_its_terminal_is_closed():
    program = (
        "import os, signal; from physai import cli; signal.signal(signal.SIGHUP, signal.SIG_IGN)\n"
        "with cli.guard(): os.kill(os.getpid(), signal.SIGHUP); print('goes on', flush=True)\n"
        "with cli.guard(): os.kill(os.getpid(), signal.SIGTERM); print('is lost', flush=True)"
    )
    done = subprocess.run([sys.executable, "-c", program], capture_output=True, text=True, timeout=60)
    assert done.returncode == 128 + signal.SIGTERM
    assert done.stdout == "goes on\n"


def test_a_reader_that_has_had_enough_ends_a_command_in_silence(tmp_path):
    line = [sys.executable, "-m", "physai.train", "--help"]
    process = subprocess.Popen(line, cwd=tmp_path, stdout=subprocess.PIPE, stderr=subprocess.PIPE, text=True)
    process.stdout.close()
    assert process.stderr.read() == ""
    assert process.wait() == 128 + signal.SIGPIPE
