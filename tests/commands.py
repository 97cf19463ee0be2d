"""Commands, as a person or a script calls them in this process."""

from __future__ import annotations

import json
from dataclasses import dataclass
from typing import Any, AnyStr, Generic

import pytest

from rass_mav.cli import main


@dataclass
class Output(Generic[AnyStr]):
    """What a command has printed."""

    out: AnyStr
    err: AnyStr


def output(capture: pytest.CaptureFixture[AnyStr], *words: str, code: int = 0) -> Output[AnyStr]:
    """What a command prints that ends with this exit code."""
    assert main(words) == code
    return Output(*capture.readouterr())


def json_output(capture: pytest.CaptureFixture[AnyStr], *words: str, code: int = 0) -> Any:
    """The one object on stdout that it prints with `--json`; unless it fails nothing is on stderr."""
    printed = output(capture, *words, "--json", code=code)
    assert not printed.err or code
    assert len(printed.out.splitlines()) == 1
    return json.loads(printed.out)
