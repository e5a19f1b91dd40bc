"""How commands end."""

import io
import signal
import subprocess
import sys

import pytest

from physai.cli import command as cli
from physai.errors import UserError


def test_what_nohup_started_goes_on_when_its_terminal_is_closed():
    program = (
        "import os, signal; from physai import cli; signal.signal(signal.SIGHUP, signal.SIG_IGN)\n"
        "with cli.guard(): os.kill(os.getpid(), signal.SIGHUP); print('goes on', flush=True)\n"
        "with cli.guard(): os.kill(os.getpid(), signal.SIGTERM); print('is lost', flush=True)"
    )
    done = subprocess.run([sys.executable, "-c", program], capture_output=True, text=True, timeout=60)
    assert done.returncode == 128 + signal.SIGTERM
    assert done.stdout == "goes on\n"


def test_a_signal_that_a_library_swallows_ends_a_command_all_the_same():
    """As some do while they are imported: a bare except around an import of what may not be there."""
    program = (
        "import os, signal, time; from physai import cli\n"
        "with cli.guard():\n"
        "    try: os.kill(os.getpid(), signal.SIGTERM); time.sleep(0.1)\n"
        "    except: print('swallowed', flush=True)\n"
        "    try: time.sleep(30)\n"
        "    finally: time.sleep(1.5); print('in order', flush=True)\n"
    )
    done = subprocess.run([sys.executable, "-c", program], capture_output=True, text=True, timeout=60)
    assert done.returncode == 128 + signal.SIGTERM
    assert done.stdout == "swallowed\nin order\n"


def test_a_reader_that_has_had_enough_ends_a_command_in_silence(tmp_path):
    line = [sys.executable, "-m", "physai.train", "--help"]
    process = subprocess.Popen(line, cwd=tmp_path, stdout=subprocess.PIPE, stderr=subprocess.PIPE, text=True)
    process.stdout.close()
    assert process.stderr.read() == ""
    assert process.wait() == 128 + signal.SIGPIPE


@pytest.mark.parametrize("terminal", [True, False])
def test_a_terminal_shows_how_far_the_check_of_a_sweep_is(monkeypatch, terminal):
    shown = io.StringIO()
    shown.isatty = lambda: terminal
    monkeypatch.setattr("sys.stderr", shown)
    monkeypatch.setenv("TERM", "xterm")
    combinations = [["seed=0"], ["seed=1"], ["seed=2"]]
    seen = []

    def check():
        with cli._shown(combinations) as jobs:
            for one in jobs:
                seen.append(one)
                if len(seen) == 3:
                    raise UserError("bad")

    with pytest.raises(UserError):
        check()
    assert seen == combinations
    assert ("checking 3 jobs" in shown.getvalue() and "67%" in shown.getvalue()) == terminal
    assert bool(shown.getvalue()) == terminal
    before = shown.getvalue()
    print("error: " + 100 * "bad ", file=sys.stderr)  # the bar is gone, and the line is whole
    assert shown.getvalue() == before + "error: " + 100 * "bad " + "\n"
