"""What the list of conditions needs besides the data: the base's settings, and what the ground's keys say."""

from __future__ import annotations

import os

from rass_mav.app.config import RunConfig
from rass_mav.errors import KeysError

from .watch import Rules


class RuleBook:
    """The rules, as they are now: keys are revoked while a mission is watched."""

    def __init__(self, rules: Rules | None = None, keys: str | None = None) -> None:
        """`rules`: without what is revoked. `keys`: the file of the ground's keys; None: there is none."""
        self._rules = Rules() if rules is None else rules
        self._keys = keys
        self._seen: tuple[int, ...] | None = None

    @classmethod
    def of(cls, config: RunConfig, keys: str | None = None) -> RuleBook:
        """Those of a node's configuration. `keys`: another key file than it names."""
        own = None if config.keys is None or not config.is_base else config.keys.file
        base = (config.node_id, None if config.base is None else config.base.place) if config.is_base else None
        rules = Rules(config.attention.above, contours=config.attention.contours, base=base)
        return cls(rules, keys or own)

    def renewed(self) -> Rules:
        """The key file is read again when it has changed. One that cannot be read now changes nothing: that
        sealed data cannot be opened is said where they are read."""
        if self._keys is None or (seen := _look(self._keys)) == self._seen:
            return self._rules
        from rass_mav.trust.keys.files import read_ground  # with PyNaCl, which is needed for nothing else here

        self._seen = seen
        try:
            ground = read_ground(self._keys)
        except KeysError:
            return self._rules
        self._rules = self._rules._replace(revoked=ground.revoked)
        return self._rules


def _look(path: str) -> tuple[int, ...] | None:
    try:
        found = os.stat(path)
    except OSError:
        return None
    return found.st_ino, found.st_mtime_ns, found.st_size
