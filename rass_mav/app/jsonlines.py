"""JSON lines for the control socket: bytes as base64, NaN and infinity as null."""

from __future__ import annotations

import base64
import json
import math
from typing import Any

from rass_mav.errors import MalformedError


def dump_line(value: dict[str, Any]) -> bytes:
    """One object on one line."""
    return json.dumps(_jsonable(value), separators=(",", ":"), allow_nan=False).encode() + b"\n"


def load_line(line: bytes) -> dict[str, Any]:
    """The object on a line. Raises `MalformedError`."""
    try:
        value = json.loads(line.decode("utf-8-sig"))
    except RecursionError:
        raise MalformedError("nested too deeply") from None
    except UnicodeDecodeError:
        raise MalformedError("not UTF-8") from None
    except json.JSONDecodeError as error:
        raise MalformedError(str(error)) from None
    except ValueError:
        raise MalformedError("a number with too many digits") from None
    if not isinstance(value, dict):
        raise MalformedError("expected an object")
    return value


def load_bytes(text: str) -> bytes:
    """Bytes from base64. Raises `MalformedError`."""
    try:
        return base64.b64decode(text, validate=True)
    except ValueError:
        raise MalformedError("expected base64") from None


def _jsonable(value: Any) -> Any:
    if isinstance(value, dict):
        return {str(key): _jsonable(item) for key, item in value.items()}
    if isinstance(value, (list, tuple)):
        return [_jsonable(item) for item in value]
    if isinstance(value, bytes):
        return base64.b64encode(value).decode("ascii")
    if isinstance(value, float) and not math.isfinite(value):
        return None
    return value
