#!/usr/bin/env python3
"""Runs a command on a terminal of its own and tells what it wrote there: its exit code, then its output."""

import os
import pty
import sys

process, terminal = pty.fork()
if process == 0:
    os.environ["TERM"] = "xterm"
    os.execv(sys.argv[1], sys.argv[1:])
seen = b""
while True:
    try:
        data = os.read(terminal, 65536)
    except OSError:
        # So Linux says that the other end is closed.
        break
    if not data:
        break
    seen += data
_, status = os.waitpid(process, 0)
sys.stdout.buffer.write(f"{os.waitstatus_to_exitcode(status)}\n".encode() + seen)
