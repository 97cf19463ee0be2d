"""On the drone's Pi: submits what a detector prints, a number in uSv/h on each line.

my-detector | python3 producer.py /var/lib/rass-mav/rass-7.sock
"""

import json
import socket
import sys


def hand_in(reading: dict) -> dict:
    """One reading, one answer. The node may have been started again since the last one."""
    with socket.socket(socket.AF_UNIX) as node:
        node.settimeout(30)
        node.connect(sys.argv[1])
        node.sendall(json.dumps({"command": "measure", **reading}).encode() + b"\n")
        return json.loads(node.makefile().readline())


for line in map(str.strip, sys.stdin):
    try:
        answer = hand_in({"value": float(line), "unit": "uSv/h"})
    except (OSError, ValueError) as error:
        answer = {"ok": False, "error": str(error)}
    if not answer["ok"]:
        print(f"{line}: {answer['error']}", file=sys.stderr, flush=True)
