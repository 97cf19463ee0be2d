"""The node's keys: are there any, and can the node start with them?"""

from __future__ import annotations

from rass_mav.app.config import RunConfig
from rass_mav.config.keys import in_words
from rass_mav.errors import KeysError

from .finding import Finding, failed, passed


def keys(config: RunConfig) -> Finding:
    """Check the key file, or state that there is none."""
    try:
        keyring = config.open_keys()
    except KeysError as error:
        return failed("keys", error.text, error.remedy)
    return passed("keys", in_words(None if keyring is None else keyring.own.about).removeprefix("keys: "))
