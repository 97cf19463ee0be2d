"""What a swarm of processes needs: a directory, short paths for sockets, and children that end with the block."""

from __future__ import annotations

import contextlib
import tempfile
from collections.abc import Iterator
from pathlib import Path

from rass_mav.errors import ConfigError, os_errors_as
from rass_mav.lab.fleet.children import Children, orderly_end


@contextlib.contextmanager
def workplace(keep: Path | None) -> Iterator[tuple[Path, Path, Children]]:
    """The directory for files, the one for control sockets, and the children.

    `keep`: a directory, new or empty; None: a temporary one. Raises `ConfigError`: it cannot be used.
    """
    if keep is not None:
        _prepare(keep)
    with contextlib.ExitStack() as stack:
        stack.enter_context(orderly_end())
        # Always a short path: that of a Unix socket may have at most 107 bytes.
        sockets = Path(stack.enter_context(tempfile.TemporaryDirectory(prefix="rass-")))
        children = stack.enter_context(Children())
        yield (keep or sockets).absolute(), sockets, children


def _prepare(directory: Path) -> None:
    with os_errors_as(ConfigError, directory):
        directory.mkdir(parents=True, exist_ok=True)
        used = any(directory.iterdir())
    if used:
        raise ConfigError(f"{directory}: expected a new or empty directory")
