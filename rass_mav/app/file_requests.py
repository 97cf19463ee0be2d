"""The requests about files on the control socket: `file`, then so many times `piece`, and `done`."""

from __future__ import annotations

from collections.abc import Iterator
from contextlib import contextmanager
from typing import Annotated, Any

from rass_mav.config.sections import Meta
from rass_mav.errors import ControlError, MalformedError
from rass_mav.wire.file import MOST_FILE, MOST_NAME, PACKINGS, PLAIN

from .control import Client, ControlServer, Request, WithTerms, understood
from .jsonlines import load_bytes
from .redundancy import MOST_SHARES
from .spool import Draft
from .staging import About


class FileRequest(WithTerms):
    """Begin a file, one at a time."""

    name: Annotated[str, Meta(min_length=1)]
    size: Annotated[int, Meta(ge=1, le=MOST_FILE)]
    """Bytes."""
    digest: Annotated[str, Meta(min_length=64, max_length=64)]
    """SHA-256, in hexadecimal."""
    packing: Annotated[int, Meta(ge=0, le=max(PACKINGS))]
    length: Annotated[int, Meta(ge=1, le=MOST_FILE)]
    """Bytes when packed."""
    time: float
    """When it was last changed, seconds since 1970."""
    needed: Annotated[int, Meta(ge=0, le=MOST_SHARES)] = 0
    """K: so many of each `shares` data are enough; 0: no redundancy."""
    shares: Annotated[int, Meta(ge=0, le=MOST_SHARES)] = 0
    """N."""

    async def answer(self, control: ControlServer, client: Client) -> dict[str, Any]:
        """With the bytes of a part."""
        with understood():
            about = self._about()
        files = control.files.open()
        control.drop_draft(client)
        client.draft = await files.begin(about, redundancy=(self.needed, self.shares) if self.needed else None)
        return {"part_bytes": client.draft.manifest.cut.part_bytes}

    def _about(self) -> About:
        """Raises `MalformedError`."""
        try:
            digest = bytes.fromhex(self.digest)
        except ValueError:
            raise MalformedError("expected a digest in hexadecimal") from None
        if len(self.name.encode(errors="replace")) > MOST_NAME or len(digest) != 32:
            raise MalformedError(f"expected a name of at most {MOST_NAME} bytes, and a digest of 32")
        if self.needed >= self.shares > 0 or bool(self.needed) != bool(self.shares):
            raise MalformedError("expected more shares than needed")
        if self.packing == PLAIN and self.length != self.size:
            raise MalformedError("expected equal size and length, because the file is not packed")
        return About(self.name, self.size, self.time, digest, self.packing, self.length, self.terms)


class PieceRequest(Request):
    """The next bytes of the file."""

    payload: str
    """1 byte to 64 KiB, in base64."""

    async def answer(self, control: ControlServer, client: Client) -> dict[str, Any]:
        """After an error nothing is left of the file."""
        with understood():
            payload = load_bytes(self.payload)
        with _draft(control, client) as draft:
            await control.files.open().write(draft, payload)
        return {}


class DoneRequest(Request):
    """The file is complete. The answer comes when it is on disk."""

    async def answer(self, control: ControlServer, client: Client) -> dict[str, Any]:
        """The id of its manifest, and how many data it has. After an error nothing is left of the file."""
        with _draft(control, client) as draft:
            id = await control.files.open().finish(draft)
        client.draft = None
        return {"id": str(id), "parts": draft.manifest.cut.data()}


@contextmanager
def _draft(control: ControlServer, client: Client) -> Iterator[Draft]:
    """The file that the client has begun. An error in the block gives it up."""
    if client.draft is None:
        raise ControlError("no file transfer is in progress")
    try:
        yield client.draft
    except BaseException:
        control.drop_draft(client)
        raise
