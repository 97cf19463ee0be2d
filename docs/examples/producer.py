"""On the drone's Pi: submits what a detector prints, a number in uSv/h on each line.

my-detector | python3 producer.py /var/lib/rass-mav/rass-7.sock
"""

import json
import socket
import sys
import time


def submit(reading: dict) -> dict:
    """The answer. The node may be restarting: a reading without an answer is submitted again, with its time."""
    timed = {**reading, "time": time.time()}
    for pause_s, request in (0, reading), (1, timed), (2, timed), (4, timed):
        time.sleep(pause_s)
        try:
            with socket.socket(socket.AF_UNIX) as node:
                node.settimeout(30)
                node.connect(sys.argv[1])
                node.sendall(json.dumps({"command": "measure", **request}).encode() + b"\n")
                return json.loads(node.makefile().readline())
        except (OSError, ValueError) as error:
            answer = {"ok": False, "error": f"no answer: {error}"}
    return answer


for line in map(str.strip, sys.stdin):
    try:
        answer = submit({"value": float(line), "unit": "uSv/h"})
    except ValueError as error:
        answer = {"ok": False, "error": str(error)}
    if not answer["ok"]:
        print(f"{line}: {answer['error']}", file=sys.stderr, flush=True)
