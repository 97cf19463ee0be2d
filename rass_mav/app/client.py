"""The client's end of the control socket. It blocks and is light: it needs no event loop."""

from __future__ import annotations

import contextlib
import socket
from pathlib import Path
from typing import Any

from rass_mav.errors import ControlError, MalformedError, RefusedError, why

from .jsonlines import dump_line, load_line

#: How long an answer may take, seconds: `put` waits for the disk.
ANSWER_S = 30.0


class ControlClient:
    """A connection to a running node."""

    def __init__(self, path: str | Path, *, timeout_s: float = ANSWER_S) -> None:
        """Raises `ControlError` if no node listens at `path`."""
        self.path = Path(path)
        self._socket = socket.socket(socket.AF_UNIX, socket.SOCK_STREAM)
        self._socket.settimeout(timeout_s)
        try:
            self._socket.connect(str(path))
        except OSError as error:
            self._socket.close()
            raise ControlError(f"{path}: no running node ({why(error)})") from None
        self._file = self._socket.makefile("rb")

    def ask(self, command: str, **fields: Any) -> dict[str, Any]:
        """One request, one answer. Bytes travel as base64. Raises `ControlError`; `RefusedError` if the node
        refuses."""
        try:
            # A node that has disconnected this client may have said why.
            with contextlib.suppress(BrokenPipeError, ConnectionResetError):
                self._socket.sendall(dump_line({"command": command, **fields}))
            line = self._file.readline()
            if not line.endswith(b"\n"):
                raise ControlError(f"{self.path}: the node closed the connection")
            answer = load_line(line)
        except TimeoutError:
            raise ControlError(f"{self.path}: the node does not answer") from None
        except OSError as error:
            raise ControlError(f"{self.path}: {why(error)}") from None
        except MalformedError as error:
            raise ControlError(f"{self.path}: not a rass-mav node ({error})") from None
        if not answer.pop("ok"):
            raise RefusedError(answer["error"])
        return answer

    def close(self) -> None:
        """Close the connection."""
        self._file.close()
        self._socket.close()

    def __enter__(self) -> ControlClient:
        return self

    def __exit__(self, *raised: object) -> None:
        self.close()
