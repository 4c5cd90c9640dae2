#!/usr/bin/env python3
"""Reads recordings to their last byte with mcap from PyPI; prints the number of messages of each, one a line.

    venv/bin/python tests/record/read_all.py FILE.mcap...

Every chunk's checksum is verified, and the index must lead to as many messages as are there from beginning to end.
Exit code 0 if all is well, 1 with a message for each file that cannot be read.
"""

import sys

from mcap.reader import NonSeekingReader, SeekingReader


def count(path):
    with open(path, "rb") as stream:
        by_index = sum(1 for _ in SeekingReader(stream, validate_crcs=True).iter_messages())
    with open(path, "rb") as stream:
        in_order = sum(1 for _ in NonSeekingReader(stream, validate_crcs=True).iter_messages())
    with open(path, "rb") as stream:
        said = SeekingReader(stream).get_summary().statistics.message_count
    if not by_index == in_order == said:
        raise ValueError(f"{by_index} messages by the index, {in_order} in the file, {said} by its summary")
    return by_index


failed = False
for path in sys.argv[1:]:
    try:
        print(count(path))
    except Exception as error:  # Whatever it is, the recording does not open.
        failed = True
        print(f"{path}: {type(error).__name__}: {error}", file=sys.stderr)
sys.exit(failed)
