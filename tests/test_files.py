"""Files are whole or not there."""

import subprocess
import sys

from physai.files import write_atomically

WRITE_UNDER_A_SIZE_LIMIT = """
import resource, sys
from pathlib import Path
from physai.files import write_atomically
path = Path(sys.argv[1])
write_atomically(path, b"old")
resource.setrlimit(resource.RLIMIT_FSIZE, (20_000, resource.getrlimit(resource.RLIMIT_FSIZE)[1]))
try:
    write_atomically(path, bytes(100_000))
except OSError as error:
    print("refused:", error.strerror)
"""


def test_when_the_disk_refuses_the_old_content_stays(tmp_path):
    path = tmp_path / "file"
    done = subprocess.run([sys.executable, "-c", WRITE_UNDER_A_SIZE_LIMIT, path], capture_output=True, text=True)
    assert done.stdout == "refused: File too large\n", done.stderr
    assert path.read_bytes() == b"old"
    assert list(tmp_path.iterdir()) == [path]


def test_folders_are_made_and_what_a_kill_left_is_no_obstacle(tmp_path):
    path = tmp_path / "a" / "b" / "file"
    write_atomically(path, b"one")
    (path.parent / ".file.tmp").write_bytes(b"half of tw")
    write_atomically(path, b"two")
    assert path.read_bytes() == b"two"
    assert list(path.parent.iterdir()) == [path]


def test_a_write_never_follows_a_link(tmp_path):
    (tmp_path / "other").write_text("untouched")
    for name in ("file", ".file.tmp"):
        (tmp_path / name).symlink_to(tmp_path / "other")
    write_atomically(tmp_path / "file", b"new")
    assert (tmp_path / "file").read_text() == "new"
    assert (tmp_path / "other").read_text() == "untouched"
